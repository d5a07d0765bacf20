"""The folder that training leaves: the avatar, the scene, how the clip was taken, and the person's poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.effects import read_effects
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar, read_scene
from stages.records import Avatar, Effects, Scene


def read_trained(train: Path) -> tuple[Avatar, Scene | None, Effects]:
    """The avatar, the scene, or None where only the person was trained, and the effects."""
    scene = read_scene(train / "scene.npz") if (train / "scene.npz").exists() else None
    return read_avatar(train / "avatar.npz"), scene, read_effects(train / "effects.npz")


def read_trained_poses(train: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By frame name: global_orient [3] and body_pose [69] in rad, transl [3] in m."""
    body = read_poses(train / "body.npz")
    return dict(zip(body.names, zip(body.global_orient, body.body_pose, body.transl, strict=True), strict=True))


def check_scene(train: Path) -> None:
    """StageError where only the person was trained."""
    if not (train / "scene.npz").exists():
        raise StageError(
            "this clip has a person only, no scene",
            "add `--only human`",
            [f"no scene.npz in {train}: the camera did not move, or the scene was switched off"],
        )
