"""hands.npz: how the fingers of a person are bent in every frame, and how they are for the avatar."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, take, write_npz
from stages.gestures import HandPoses
from stages.records import BodyPoses

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


def hands_in(folder: Path) -> HandPoses | None:
    """The fingers of a person in their `folder` of the stage `smpl`; None without hands.npz, and where no hand was read."""
    path = folder / "hands.npz"
    hands = read_hands(path) if path.is_file() else None
    return hands if hands is not None and hands.read.any() else None


def with_hands(poses: BodyPoses, hands: HandPoses | None) -> BodyPoses:
    """The poses with the fingers of the same frames; as they are without. StageError for frames that `hands` lacks."""
    if hands is None:
        return poses
    rows = {name: row for row, name in enumerate(hands.names)}
    missing = [name for name in poses.names if name not in rows]
    if missing:
        facts = [f"first: {', '.join(missing[:5])}"]
        raise StageError(f"hands.npz lacks {len(missing)} of {len(poses)} frames of the body", HINT, facts)
    return replace(poses, hands=hands.turns[[rows[name] for name in poses.names]])
