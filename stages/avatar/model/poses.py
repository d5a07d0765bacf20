"""A person in many poses at once, without gradients: the weights of a Gaussian are read once for several poses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.stretch import Stretch
from stages.avatar.kernels import njit, prange
from stages.avatar.model.person import Resting
from stages.avatar.splats.gaussians import Splats

TOGETHER = 8  # poses in one pass over the Gaussians
CHUNKS = 16  # ranges of rows, each by one thread
ZERO = np.float32(0)


def pose_together(person: Resting, bones: Tensor, transl: Tensor, stretch: Stretch | None = None) -> Iterator[Splats]:
    """As `person.pose`, one after the other, for each of bones[P,J,4,4] and transl[P,3] m; float32 on a CPU, no gradients."""
    colours, own = person.sh.shape[1] > 1, person.axes if stretch is None else stretch.axes
    turned = [own, person.rotations] if colours else [own]
    arrays = [part.detach().contiguous().numpy() for part in (person.weights, person.means, torch.stack(turned))]
    for some, places in zip(bones.split(TOGETHER), transl.split(TOGETHER)):
        rows = some[:, :, :3].transpose(0, 1).contiguous().detach().numpy()
        means = np.empty((len(some), len(person.means), 3), np.float32)
        moved = np.empty((len(turned), len(some), len(person.means), 3, 3), np.float32)
        _skin(*arrays, rows.reshape(len(rows), -1), means, moved)
        for number, place in enumerate(places.detach()):
            at, axes, *rotations = (torch.from_numpy(part) for part in (means[number], *moved[:, number]))
            axes = axes if stretch is None else stretch.gained(axes, at)
            yield Splats(at + place, axes, person.opacities, person.sh, rotations[0] if colours else None)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _skin(
    weights: np.ndarray, points: np.ndarray, turned: np.ndarray, rows: np.ndarray, means: np.ndarray, moved: np.ndarray
) -> None:
    """Fill means [P,N,3] and moved [C,P,N,3,3] from weights [N,J], points [N,3], turned [C,N,3,3] and rows [J,12P]."""
    count, wide = len(points), rows.shape[1]
    for chunk in prange(CHUNKS):
        blend = np.empty(wide, np.float32)
        for i in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            blend[:] = ZERO
            for j in range(weights.shape[1]):
                share = weights[i, j]
                if share != ZERO:
                    for k in range(wide):
                        blend[k] += share * rows[j, k]
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for p in range(means.shape[0]):
                for row in range(3):
                    at = 12 * p + 4 * row
                    a, b, c = blend[at], blend[at + 1], blend[at + 2]
                    means[p, i, row] = a * x + b * y + c * z + blend[at + 3]
                    for kind in range(len(turned)):
                        axes, out = turned[kind, i], moved[kind, p, i, row]
                        out[0] = a * axes[0, 0] + b * axes[1, 0] + c * axes[2, 0]
                        out[1] = a * axes[0, 1] + b * axes[1, 1] + c * axes[2, 1]
                        out[2] = a * axes[0, 2] + b * axes[1, 2] + c * axes[2, 2]
