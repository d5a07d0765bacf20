"""effects.npz of the train stage: how the clip was taken and lit, as training learned it; absent if no effect is on."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, write_npz
from stages.records import Effects

HINT = "train again: `hugs run VIDEO train --force`"
SHADOW = ("light", "darkness", "softness", "density", "size")
OLDER = {"middles", "covariances"}  # of who casts: in avatar.npz since 0.3.0
_SHAPES = {"light": (3,), "shading": (8, 3)}
_LIMITS = {
    "darkness": (0, 1),
    "softness": (0, 1e3),
    "density": (0, 1e6),
    "size": (0, 1e3),
    "shutter": (0, 1),
    "readout": (-1, 1),
}


def write_effects(path: Path, effects: Effects) -> None:
    """Write the known values as .npz of float64, without pickles."""
    _check(effects.known(), path)
    write_npz(path, effects.known())


def read_effects(path: Path) -> Effects:
    """Read an effects.npz; where there is none, all effects are off. StageError for an incomplete shadow or impossible values."""
    if not path.exists():
        return Effects()
    found = {name: array for name, array in read_npz(path, HINT).items() if name not in OLDER}
    names = [f.name for f in fields(Effects)]
    unknown = sorted(found.keys() - set(names))
    if unknown:
        raise StageError(f"{path} holds unknown effects", HINT, [f"found {', '.join(unknown)}"])
    arrays = {n: checked(a, _SHAPES.get(n, ()), n, path, HINT).astype(np.float64) for n, a in found.items()}
    _check(arrays, path)
    values: dict[str, Any] = {name: array if name in _SHAPES else float(array) for name, array in arrays.items()}
    return Effects(**values)


def _check(arrays: dict[str, np.ndarray], path: Path) -> None:
    missing = [name for name in SHADOW if name not in arrays]
    if 0 < len(missing) < len(SHADOW):
        raise StageError(f"{path} has an incomplete shadow", HINT, [f"missing: {', '.join(missing)}"])
    wrong = [n for n, (low, high) in _LIMITS.items() if n in arrays and not low <= arrays[n] <= high]
    if "light" in arrays and not abs(np.linalg.norm(arrays["light"]) - 1) < 1e-3:
        wrong.append("light")
    if wrong:
        facts = [f"{name}: {arrays[name].tolist()}, wanted {_LIMITS.get(name, 'a length of 1')}" for name in wrong]
        raise StageError(f"{path} has impossible effect values", HINT, facts)
