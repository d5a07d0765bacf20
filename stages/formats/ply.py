"""3D Gaussians as the .ply file that other viewers and editors read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.splats import Scene

REST = 15  # higher coefficients a channel: many viewers take degree 3 only, so lower degrees are padded with zeros
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
    n, known = len(splats), splats.shN.shape[1]
    rest = np.zeros((n, 3, REST), np.float32)
    rest[:, :, :known] = splats.shN.transpose(0, 2, 1)
    with np.errstate(divide="ignore"):
        logits = np.log(splats.opacities.astype(np.float64)) - np.log1p(-splats.opacities.astype(np.float64))
    bounded = np.clip(logits, -OPACITY_LOGIT, OPACITY_LOGIT)
    columns = [
        splats.means,
        np.zeros((n, 3)),
        splats.sh0,
        rest.reshape(n, -1),
        bounded[:, None],
        np.log(splats.scales),
        splats.quats,
    ]
    table = np.concatenate([np.asarray(c, "<f4") for c in columns], 1)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    head += [f"property float {name}" for name in _names()]
    Path(path).write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + table.astype("<f4").tobytes())
    return int((bounded != logits).sum())
