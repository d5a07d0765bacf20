"""Avatars and scenes in any of the formats we read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from stages.contract import StageError
from stages.formats.clothes import has_old_clothes
from stages.formats.exchange.ply import CONVERT, read_ply
from stages.formats.exchange.splats_glb import read_avatar_glb
from stages.formats.exchange.spz import read_spz
from stages.formats.splats import read_avatar, read_scene
from stages.formats.trained import read_trained
from stages.records import Avatar, Effects, Scene

AVATARS: dict[str, Callable[[Path], Avatar]] = {".npz": read_avatar, ".glb": read_avatar_glb}
SCENES: dict[str, Callable[[Path], Scene]] = {".npz": read_scene, ".ply": read_ply, ".spz": read_spz}
T = TypeVar("T")


def read_any_avatar(path: Path) -> Avatar:
    """Read avatar.npz or avatar_splats.glb of the export stage, of this version or an earlier one."""
    return _read(path, AVATARS, "avatar that can be posed", "give avatar.npz or avatar_splats.glb of the export stage")


def read_any_scene(path: Path) -> Scene:
    """Read a scene of Gaussians, ours or another trainer's."""
    return _read(path, SCENES, "scene", f"give a .ply or .spz of 3D Gaussians, or scene.npz; {CONVERT}")


def read_given(
    train: Path | None, avatar: Path | None, scene: Path | None, who: int = 1
) -> tuple[Avatar, Scene | None, Effects]:
    """What training left in `train` of person `who`, or the avatar file alone; a scene file takes the place of the trained one."""
    found: tuple[Avatar, Scene | None, Effects]
    if avatar is not None:
        found = read_any_avatar(avatar), None, Effects()
    elif train is not None:
        found = read_trained(train, who)
    else:
        raise ValueError("neither a trained folder nor an avatar")
    return found if scene is None else (found[0], read_any_scene(scene), found[2])


def lacks(avatar: Path | None, scene: Path | None, antialias: bool = False) -> list[str]:
    """What these files do not hold, or no longer say to us, in words; `antialias`: as the scene was read."""
    found = []
    if avatar is not None and avatar.suffix.lower() == ".glb":
        found.append(f"{avatar.name} holds eight bones for each Gaussian; avatar.npz holds all")
    if avatar is not None and avatar.suffix.lower() == ".npz" and has_old_clothes(avatar):
        found.append(
            f"{avatar.name} was made before clothes had bones: they follow the skin; train again for clothes that swing"
        )
    if scene is not None and scene.suffix.lower() == ".ply" and not antialias:
        found.append(f"{scene.name} has no mark that it was learned with anti-aliasing: drawn without")
    return found


def _read(path: Path, readers: dict[str, Callable[[Path], T]], what: str, hint: str) -> T:
    read = readers.get(path.suffix.lower())
    if read is None:
        raise StageError(f"{path} is no {what}", hint, [f"it ends in {path.suffix!r}"])
    return read(path)
