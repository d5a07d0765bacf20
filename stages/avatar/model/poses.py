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
    points = torch.stack([person.means, person.normals])
    arrays = [part.detach().contiguous().numpy() for part in (person.weights, points, torch.stack(turned))]
    for some, places in zip(bones.split(TOGETHER), transl.split(TOGETHER)):
        rows = some[:, :, :3].transpose(0, 1).contiguous().detach().numpy()
        carried = np.empty((2, len(some), len(person.means), 3), np.float32)
        moved = np.empty((len(turned), len(some), len(person.means), 3, 3), np.float32)
        _skin(*arrays, rows.reshape(len(rows), -1), carried, moved)
        for number, place in enumerate(places.detach()):
            parts = *carried[:, number], *moved[:, number]
            at, normals, axes, *rotations = (torch.from_numpy(part) for part in parts)
            axes = axes if stretch is None else stretch.gained(axes, at)
            turns = rotations[0] if colours else None
            yield Splats(at + place, axes, person.opacities, person.sh, turns, normals=normals)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _skin(
    weights: np.ndarray,
    points: np.ndarray,
    turned: np.ndarray,
    rows: np.ndarray,
    carried: np.ndarray,
    moved: np.ndarray,
) -> None:
    """Fill carried [2,P,N,3] and moved [C,P,N,3,3] from weights [N,J], points [2,N,3], which are means and normals, turned
    [C,N,3,3] and rows [J,12P].
    """
    count, wide = len(weights), rows.shape[1]
    for chunk in prange(CHUNKS):
        blend = np.empty(wide, np.float32)
        for i in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            blend[:] = ZERO
            for j in range(weights.shape[1]):
                share = weights[i, j]
                if share != ZERO:
                    for k in range(wide):
                        blend[k] += share * rows[j, k]
            x, y, z = points[0, i, 0], points[0, i, 1], points[0, i, 2]
            u, v, w = points[1, i, 0], points[1, i, 1], points[1, i, 2]
            for p in range(carried.shape[1]):
                for row in range(3):
                    at = 12 * p + 4 * row
                    a, b, c = blend[at], blend[at + 1], blend[at + 2]
                    carried[0, p, i, row] = a * x + b * y + c * z + blend[at + 3]
                    carried[1, p, i, row] = a * u + b * v + c * w
                    for kind in range(len(turned)):
                        axes, out = turned[kind, i], moved[kind, p, i, row]
                        out[0] = a * axes[0, 0] + b * axes[1, 0] + c * axes[2, 0]
                        out[1] = a * axes[0, 1] + b * axes[1, 1] + c * axes[2, 1]
                        out[2] = a * axes[0, 2] + b * axes[1, 2] + c * axes[2, 2]
