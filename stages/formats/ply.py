"""avatar.ply and scene.ply: 3D Gaussians in the layout that viewers and editors read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.records import Scene

REST = 15  # higher coefficients a channel: many viewers take degree 3 only, so lower degrees are padded with zeros
CHUNK = 1 << 14  # rows made at a time, so that ten million need no more memory than these
OPACITY_LOGIT = 15.0  # float32 cannot hold the logits of 0 and 1


def _names() -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * REST)]
    return [*names, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: Path, splats: Scene) -> int:
    """Write Gaussians as binary PLY in the layout of 3DGS; returns how many opacities were bounded.

    Opacity is stored as its logit (bounded at +-15), scales as logarithms, rotation as w x y z, higher harmonics
    channel by channel. Raises StageError when a scale is not positive or an opacity not in 0..1.
    """
    if not ((splats.opacities >= 0) & (splats.opacities <= 1)).all():
        row = int(np.flatnonzero(~((splats.opacities >= 0) & (splats.opacities <= 1)))[0])
        raise StageError(
            "a Gaussian has an opacity that is not between 0 and 1",
            "train again: `hugs run VIDEO train --force`",
            [f"row {row}: {splats.opacities[row]}"],
        )
    if not (splats.scales > 0).all():
        row = int(np.argwhere(~(splats.scales > 0))[0, 0])
        raise StageError(
            "a Gaussian has a scale that is not positive",
            "train again: `hugs run VIDEO train --force`",
            [f"row {row}: {splats.scales[row].tolist()}"],
        )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    head += [f"property float {name}" for name in _names()]
    bounded = 0
    with Path(path).open("wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode())
        for start in range(0, len(splats), CHUNK):
            table, more = _table(splats, slice(start, start + CHUNK))
            file.write(table.tobytes())
            bounded += more
    return bounded


def _table(splats: Scene, rows: slice) -> tuple[np.ndarray, int]:
    """The file's columns of some rows, float32, and how many opacities were bounded."""
    higher, opacities = splats.shN[rows], splats.opacities[rows].astype(np.float64)
    rest = np.zeros((len(opacities), 3, REST), np.float32)
    rest[:, :, : higher.shape[1]] = higher.transpose(0, 2, 1)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)
    bounded = np.clip(logits, -OPACITY_LOGIT, OPACITY_LOGIT)
    columns = [
        splats.means[rows],
        np.zeros((len(opacities), 3)),
        splats.sh0[rows],
        rest.reshape(len(opacities), -1),
        bounded[:, None],
        np.log(splats.scales[rows]),
        splats.quats[rows],
    ]
    return np.concatenate([np.asarray(c, "<f4") for c in columns], 1), int((bounded != logits).sum())
