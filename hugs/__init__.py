"""Avatars from Python: load one, pose it, draw it. See docs/python.md; these names are stable.

A name's module, and torch with it, is imported when the name is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same as HOMES, for type checkers
    from hugs.avatar import Avatar as Avatar
    from hugs.avatar import load as load
    from hugs.drawing import Picture as Picture
    from hugs.drawing import camera as camera
    from hugs.drawing import draw as draw
    from hugs.drawing import write_image as write_image
    from hugs.gaussians import Gaussians as Gaussians
    from hugs.gaussians import Person as Person
    from hugs.gaussians import load_scene as load_scene
    from hugs.learning import save as save
    from hugs.learning import train as train
    from hugs.making import animate as animate
    from hugs.making import compose as compose
    from hugs.making import export as export
    from hugs.motion import Motion as Motion
    from hugs.motion import Pose as Pose
    from hugs.progress import Progress as Progress
    from hugs.runs import run as run
    from stages.avatar.rasterize import Camera as Camera
    from stages.contract import StageError as StageError
    from stages.gestures import FACE_NAMES as FACE_NAMES
    from stages.gestures import FINGER_NAMES as FINGER_NAMES
    from stages.records import JOINT_NAMES as JOINT_NAMES
    from stages.training.results import Result as Result

HOMES = {
    "hugs.avatar": ("Avatar", "load"),
    "hugs.drawing": ("Picture", "camera", "draw", "write_image"),
    "hugs.gaussians": ("Gaussians", "Person", "load_scene"),
    "hugs.learning": ("save", "train"),
    "hugs.making": ("animate", "compose", "export"),
    "hugs.motion": ("Motion", "Pose"),
    "hugs.progress": ("Progress",),
    "hugs.runs": ("run",),
    "stages.avatar.rasterize": ("Camera",),
    "stages.contract": ("StageError",),
    "stages.gestures": ("FACE_NAMES", "FINGER_NAMES"),
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
