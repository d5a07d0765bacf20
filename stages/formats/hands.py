"""hands.npz: how the fingers of a person are bent in every frame, and how they are for the avatar."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from stages.formats.arrays import checked, read_npz, take, write_npz
from stages.gestures import HandPoses

HINT = "run the smpl stage again: `hugs run VIDEO smpl --force`"


def write_hands(path: Path, hands: HandPoses) -> None:
    """Write `hands` as .npz without pickles."""
    values = {field.name: np.asarray(getattr(hands, field.name)) for field in fields(hands)}
    write_npz(path, values | {"names": np.array(hands.names, dtype=np.str_)})


def read_hands(path: Path) -> HandPoses:
    """Read a hands.npz; StageError with key, found and wanted shape, or first bad index."""
    arrays = read_npz(path, HINT)
    names = tuple(map(str, take(arrays, "names", path, HINT)))
    each = (len(names), 2)
    shapes = {"turns": (*each, 15, 3), "shape": (2, 15, 3), "read": each, "error": each, "length": each}
    parts = {key: checked(take(arrays, key, path, HINT), shape, key, path, HINT) for key, shape in shapes.items()}
    return HandPoses(names, **parts)
