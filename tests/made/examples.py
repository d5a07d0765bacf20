"""What examples for Python need when they are run: themselves as modules, and the arrays that one trains on."""

import importlib.util
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from stages.formats.clip import Clip
from tests.made.command import ROOT

EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    """An example as a module."""
    found = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert found and found.loader
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def write_arrays(file: Path, clip: Clip, share: int = 1) -> None:
    """Write the arrays of a clip that `train_on_arrays.py` reads, with pictures of a whole `share` of their sides."""
    frames, body, size = range(len(clip.names)), clip.body, (clip.width // share, clip.height // share)

    def smaller(picture: np.ndarray) -> np.ndarray:
        return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)

    np.savez(
        file,
        images=np.stack([smaller(clip.images(i)) for i in frames]),
        masks=np.stack([smaller(clip.mask(i)) > 127 for i in frames]),
        viewmats=clip.viewmats,
        Ks=clip.Ks / [[share], [share], [1]],
        **{name: getattr(body, name) for name in ("body_pose", "global_orient", "transl")},
        points=clip.points,
        colors=clip.colors,
    )
