"""The folder that training leaves: the avatar, the scene, how the clip was taken, and the person's poses."""

from __future__ import annotations

from pathlib import Path

from stages.contract import StageError
from stages.formats.effects import read_effects
from stages.formats.people import PEOPLE, folder_of
from stages.formats.splats import read_avatar, read_scene
from stages.records import Avatar, Effects, Scene


def trained_of(train: Path, who: int) -> Path:
    """The folder of one of the people whom a training left, the first is 1; StageError where there are not as many."""
    folder = folder_of(train, who)
    if not (folder / "avatar.npz").is_file():
        people = 1 + len(list((train / PEOPLE).glob("*/avatar.npz")))
        facts = [f"it has {people} {'person' if people == 1 else 'people'}"]
        raise StageError(f"there is no person {who} in {train}", "choose another with `who`", facts)
    return folder


def read_trained(train: Path, who: int = 1) -> tuple[Avatar, Scene | None, Effects]:
    """The avatar of one of the people, the scene, or None where only people were trained, and the effects."""
    scene = read_scene(train / "scene.npz") if (train / "scene.npz").exists() else None
    return read_avatar(trained_of(train, who) / "avatar.npz"), scene, read_effects(train / "effects.npz")


def check_scene(train: Path) -> None:
    """StageError where only the person was trained."""
    if not (train / "scene.npz").exists():
        raise StageError(
            "this clip has a person only, no scene",
            "add `--only human`",
            [f"no scene.npz in {train}: the camera did not move, or the scene was switched off"],
        )
