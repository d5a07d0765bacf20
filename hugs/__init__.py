"""Avatars from Python: load one, pose it, draw it. See docs/python.md; these names stay as they are.

Nothing heavy is imported before a name is used for the first time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same as HOMES, for type checkers
    from hugs.front import Avatar as Avatar
    from hugs.front import Gaussians as Gaussians
    from hugs.front import camera as camera
    from hugs.front import draw as draw
    from hugs.front import load_avatar as load_avatar
    from hugs.front import load_scene as load_scene
    from hugs.front import write_image as write_image
    from hugs.learning import save as save
    from hugs.learning import train as train
    from hugs.making import animate as animate
    from hugs.making import compose as compose
    from hugs.making import export as export
    from hugs.progress import Progress as Progress
    from stages.avatar.rasterize import Camera as Camera
    from stages.contract import StageError as StageError
    from stages.records import JOINT_NAMES as JOINT_NAMES
    from stages.training.results import Result as Result

HOMES = {
    "hugs.front": ("Avatar", "Gaussians", "camera", "draw", "load_avatar", "load_scene", "write_image"),
    "hugs.learning": ("save", "train"),
    "hugs.making": ("animate", "compose", "export"),
    "hugs.progress": ("Progress",),
    "stages.avatar.rasterize": ("Camera",),
    "stages.contract": ("StageError",),
    "stages.records": ("JOINT_NAMES",),
    "stages.training.results": ("Result",),
}
"""The public names, by the module that holds them."""

_HOME = {name: home for home, names in HOMES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hugs' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
