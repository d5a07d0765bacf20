"""Ideas that the eye decided: `python -m tests.tools.eye work/kitchen/preview` writes docs/benchmarks/eye.webp.

The training of a finished run is done again, once as it is and once for each idea the other way, and drawn where the two differ.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

import hugs
from hugs_cli.cache.workspace import Stamp
from stages import train
from stages.contract import Job
from stages.training.finishing import bake, hidden, settle
from tests.made.command import ROOT
from tests.tools.gallery import QUALITY, beside, sheet

PLACE = ROOT / "docs" / "benchmarks" / "eye.webp"
SIZE = 240, 360  # px of a picture
GREEN = np.array([0.2, 0.8, 0.3], np.float32)  # behind the person: what shines through is seen


def telea(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """OpenCV's inpainting in place of patches."""
    there = np.rint(255 * picture.clip(0, 1)).astype(np.uint8)
    return cv2.inpaint(there, hole.astype(np.uint8), 5, cv2.INPAINT_TELEA).astype(np.float32) / 255


def as_they_are(person: Any, *rest: Any) -> Any:
    """No colour is taken from elsewhere."""
    return person, RECOLOR(person, *rest)[1]


RECOLOR = bake.recolor
Drawn = Callable[[hugs.Avatar], np.ndarray]


def turned(
    avatar: hugs.Avatar, pose: np.ndarray, angle: float, focal: float = 480, target: tuple[float, ...] = (0, -0.25, 0)
) -> np.ndarray:
    """The person [H,W,3] before GREEN in a pose [69] rad, seen from `angle` rad beside the front."""
    eye = (2.9 * np.sin(angle), -0.1, 2.9 * np.cos(angle))
    person = avatar.pose(pose, np.zeros(3), np.zeros(3))
    camera = hugs.camera(eye=eye, target=target, focal=focal, width=SIZE[0], height=SIZE[1])
    return np.asarray(hugs.draw(person, camera, background=GREEN).image)


def kick(avatar: hugs.Avatar, **close: Any) -> np.ndarray:
    """A knee lifted and both arms up, from aside."""
    pose = np.zeros((23, 3))
    for joint, turn in {"left_hip": (-1.5, 0, 0.3), "left_knee": (1.4, 0, 0), "left_shoulder": (0, 0, 0.9)}.items():
        pose[hugs.JOINT_NAMES.index(joint) - 1] = turn
    pose[hugs.JOINT_NAMES.index("right_shoulder") - 1] = 0, 0, -0.9
    return turned(avatar, pose.reshape(69), 0.9, **close)


def knee(avatar: hugs.Avatar) -> np.ndarray:
    """That knee."""
    return kick(avatar, focal=1700, target=(0.1, -0.55, 0.1))


def thigh(avatar: hugs.Avatar) -> np.ndarray:
    """A thigh from the side, which no frame shows straight."""
    return turned(avatar, np.zeros(69), 1.2, 1500, (0.05, -0.5, 0))


def behind(avatar: hugs.Avatar) -> np.ndarray:
    """The back."""
    return turned(avatar, np.zeros(69), np.pi)


def room(avatar: hugs.Avatar) -> np.ndarray:
    """The scene alone, in the clip's middle frame."""
    assert avatar.scene is not None
    image = np.asarray(hugs.draw(None, avatar.cameras[len(avatar.cameras) // 2], avatar.scene).image)
    return cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)


IDEAS: dict[str, tuple[Any, dict[str, Any], Drawn]] = {
    "lining": (bake, {"add_lining": lambda person, *rest: person}, kick),
    "surface": (bake, {"snap_to_surface": lambda person, *rest: (person, Counter())}, knee),
    "even colours": (settle, {"EVEN": 0.0}, thigh),
    "recolouring": (bake, {"recolor": as_they_are}, behind),
    "patches": (hidden, {"complete": telea}, room),
}


@contextmanager
def trained(run: Path, owner: Any, other: dict[str, Any]) -> Iterator[hugs.Avatar]:
    """The avatar of a training with functions of `owner` in the place of its own."""
    with tempfile.TemporaryDirectory() as folder:
        for stage in ("frames", "sfm", "smpl", "survey"):
            (Path(folder) / stage).symlink_to((run / stage).resolve())
        out = Path(folder) / "train"
        out.mkdir()
        stamp = Stamp.read(run / "train")
        assert stamp is not None
        names = {name: run / name for name in ("sfm", "smpl", "survey")}
        with mock.patch.multiple(owner, **other) if other else mock.MagicMock():
            train.run(Job(out, seed=stamp.seed), train.Params(**stamp.params), **names)
        yield hugs.load(folder)


def main(run: Path) -> None:
    """Draw each idea's pair: as it is, and the other way."""
    with trained(run, bake, {}) as avatar:
        usual = {name: drawn(avatar) for name, (_, _, drawn) in IDEAS.items()}
    pairs = []
    for name, (owner, other, drawn) in IDEAS.items():
        with trained(run, owner, other) as avatar:
            pairs += [usual[name], drawn(avatar)]
    picture = sheet([beside([np.rint(255 * one.clip(0, 1)).astype(np.uint8) for one in pairs])])
    if not cv2.imwrite(str(PLACE), picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        sys.exit(f"cannot write {PLACE}")
    print(json.dumps({"pictures": list(IDEAS), "bytes": PLACE.stat().st_size}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
