"""Clothes that leave the body as the pose changes: offsets that are linear in a few features of the pose.

Features are principal components of the training poses, held within what training saw, so that no new pose makes clothes
explode. Each of a few nodes on the body at rest has an offset per feature; a Gaussian moves with the nodes near it, before
it is skinned. So posing stays linear algebra. SMPL's pose blend shapes (https://smpl.is.tue.mpg.de) are linear likewise.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stages import records
from stages.avatar.model.person import Resting
from stages.avatar.splats.neighbours import farthest_points

NODES = 160  # about 0.1 m apart on a body
REACH = 0.07  # m: a node's Gaussian sigma
FEATURES = 6
FLOOR = 1e-6  # of the weights' sum: far from all nodes nothing moves, and nothing is divided by 0
PRIOR = 0.1  # weight of the mean squared offset / LOOSE; a 20th of it, at 3 times the rate, cost the person 1.1 dB
LOOSE = 0.05  # m


class Clothing(nn.Module):
    """Offsets [M,3,K] m of nodes[M,3] for features of body poses: (pose - mean[69]) @ axes[69,K], within low and high[K].

    Nodes and offsets are in the rest pose of the skeleton, from which every pose starts.
    """

    nodes: Tensor
    mean: Tensor
    axes: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, nodes: Tensor, mean: Tensor, axes: Tensor, low: Tensor, high: Tensor, offsets: Tensor):
        super().__init__()
        for name, value in {"nodes": nodes, "mean": mean, "axes": axes, "low": low, "high": high}.items():
            self.register_buffer(name, value)
        self.offsets = nn.Parameter(offsets)
        self.known: tuple[Tensor, Tensor] | None = None

    @classmethod
    def start(cls, points: Tensor, poses: Tensor) -> Clothing:
        """Clothes at offset 0 for points[P,3] of a body at rest and the training frames' body poses[F,69] in rad."""
        mean = poses.mean(0)
        _, spread, axes = torch.linalg.svd((poses - mean).double(), full_matrices=False)
        kept = (spread[:FEATURES] > 1e-3 * len(poses) ** 0.5).sum()
        axes = (axes[:kept] / spread[:kept, None] * len(poses) ** 0.5).T.to(poses)  # features of variance 1
        features = (poses - mean) @ axes
        nodes = points[farthest_points(points, NODES)]
        offsets = torch.zeros(len(nodes), 3, int(kept)).to(points)
        return cls(nodes, mean, axes, features.amin(0), features.amax(0), offsets)

    @classmethod
    def of(cls, clothes: records.Clothes) -> Clothing:
        """Trained clothes, float32, as constants."""
        arrays = (clothes.nodes, clothes.mean, clothes.axes, clothes.low, clothes.high, clothes.offsets)
        return cls(*(torch.as_tensor(array, dtype=torch.float32) for array in arrays)).requires_grad_(False)

    def features(self, body_pose: Tensor) -> Tensor:
        """Features [K] of a pose [69] in rad, clamped to the limits of training."""
        return ((body_pose - self.mean) @ self.axes).clamp(self.low, self.high)

    @torch.no_grad()
    def weights(self, means: Tensor) -> Tensor:
        """Weights [N,M] of the nodes' offsets for rest-pose means[N,3]; rows sum to 1 at most. Kept for the next call."""
        if self.known is None or self.known[0] is not means:
            away = torch.cdist(means, self.nodes, compute_mode="donot_use_mm_for_euclid_dist")
            bells = torch.exp(-0.5 * (away / REACH).square())
            self.known = means, bells / (bells.sum(1, keepdim=True) + FLOOR)
        return self.known[1]

    def forward(self, person: Resting, body_pose: Tensor) -> Resting:
        """The person at rest with their clothes moved as in one pose [69]."""
        away = self.weights(person.means) @ (self.offsets @ self.features(body_pose))
        return person._replace(means=person.means + away)

    def prior(self) -> Tensor:
        """The regularizer PRIOR x mean squared offset in units of LOOSE, 0 without features: it pulls clothes to the body."""
        return PRIOR * (self.offsets / LOOSE).square().sum() / max(1, self.offsets.numel())
