"""A sequence of a data set, and what the frames stage of a data set leaves of it for the stages after it.

images/%06d.png, frames.json    as the frames stage writes them; each frame also has `source`, `moment` and `split`
given/masks/<source>.png        255 = person, in the data set's own size
given/cameras.npz, lenses.npz   cameras at the frames' size; `distortion` [C,5] k1 k2 p1 p2 k3 of each (OpenCV's model)
given/points.ply, sfm.json      sparse points in the cameras' units, and what is known of them
given/smpl_fit.npz              body poses, as formats.given_fits reads them
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, take, write_npz
from stages.formats.cameras import write_cameras
from stages.formats.facts import write_facts
from stages.formats.images import read_image, shrink, write_image, write_mask
from stages.formats.kinds import names_in
from stages.formats.points import write_points
from stages.records import Cameras

Purpose = Literal["train", "heldout", "unused"]
GIVEN = "given"
LEAST_TRAINING = 4


@dataclass(frozen=True)
class Shot:
    """One picture: its name in the data set, its file, its mask files, when it was taken and what it is for."""

    source: str
    image: Path
    masks: tuple[Path, ...]
    moment: int
    """Pictures of one moment show one pose."""
    split: Purpose


@dataclass(frozen=True)
class Capture:
    """S pictures, with cameras for pictures of `width` x `height` in the data set's own units.

    `viewmats` [S,4,4] camera_from_world; `Ks` [S,3,3] px, first pixel centre at (0.5, 0.5); `lenses` [S,5] OpenCV
    distortion; `points` [P,3], `colors` [P,3] uint8; `fit` a family of formats.given_fits, one row a shot; `rule` says
    in words how the pictures were split; `person` gives the mask uint8 [H,W] of a shot; `facts` go into sfm.json.
    """

    dataset: str
    sequence: str
    rule: str
    shots: tuple[Shot, ...]
    viewmats: np.ndarray
    Ks: np.ndarray
    lenses: np.ndarray
    width: int
    height: int
    points: np.ndarray
    colors: np.ndarray
    fit: dict[str, np.ndarray]
    person: Callable[[Shot], np.ndarray]
    facts: dict[str, float | None] = field(default_factory=dict)


def write_capture(out: Path, capture: Capture, max_side: int) -> Iterator[int]:
    """Write the files named above, the longer side of the pictures at most `max_side` px; yields how many are done.

    Raises StageError for a picture whose size is not its camera's, and for too few to train on.
    """
    training = sum(shot.split == "train" for shot in capture.shots)
    if training < LEAST_TRAINING:
        fact = f"{len(capture.shots)} pictures, {training} of them to train on; at least {LEAST_TRAINING} are needed"
        raise StageError(f"too few pictures in {capture.sequence}", "give a whole sequence of the data set", [fact])
    given = out / GIVEN
    names: list[str] = []
    rows: list[dict[str, Any]] = []
    for folder in (out / "images", given / "masks"):
        folder.mkdir(parents=True, exist_ok=True)
    for i, shot in enumerate(capture.shots):
        image = read_image(shot.image)
        if image.shape[:2] != (capture.height, capture.width):
            fact = f"picture {image.shape[1]}x{image.shape[0]}, camera {capture.width}x{capture.height}"
            hint = "cameras and pictures must belong together: unpack the data set again"
            raise StageError(f"{shot.image} does not have the size of its camera", hint, [fact])
        small = shrink(image, max_side)
        name = f"{i:06d}"
        names.append(name)
        write_image(out / "images" / f"{name}.png", small)
        write_mask(given / "masks" / f"{shot.source}.png", capture.person(shot))
        rows.append({"name": name, "index": i, "time_s": float(shot.moment), "source": shot.source}
                    | {"moment": shot.moment, "split": shot.split})  # fmt: skip
        yield i + 1
    height, width = small.shape[:2]
    Ks = capture.Ks * np.array([[width / capture.width], [height / capture.height], [1.0]])
    write_cameras(given / "cameras.npz", Cameras(tuple(names), capture.viewmats, Ks, width, height))
    np.savez(given / "lenses.npz", distortion=np.asarray(capture.lenses, np.float64))
    write_points(given / "points.ply", capture.points, capture.colors)
    write_npz(given / "smpl_fit.npz", {"names": np.array(names, np.str_)} | capture.fit)
    write_facts(given / "sfm.json", capture.facts)
    moments = len({shot.moment for shot in capture.shots})
    video = {"path": capture.sequence, "width": capture.width, "height": capture.height, "fps": 1.0,
             "frames": len(rows), "duration_s": float(moments), "rotation": 0}  # fmt: skip
    dataset = {"name": capture.dataset, "sequence": capture.sequence, "rule": capture.rule}
    facts = {"video": video, "dataset": dataset, "width": width, "height": height, "frames": rows, "dropped": {}}
    write_facts(out / "frames.json", facts)


def given_by(frames: Path, name: str) -> Path | None:
    """A file or folder that the data set behind the frames brought along, or None for a video's frames."""
    path = frames / GIVEN / name
    return path if path.exists() else None


def read_lenses(path: Path, count: int) -> np.ndarray:
    """OpenCV distortion [count,5] of each camera."""
    hint = "run the frames stage again: `hugs run FOLDER frames --force`"
    return checked(take(read_npz(path, hint), "distortion", path, hint), (count, 5), "distortion", path, hint)


def require(folder: Path, wanted: tuple[str, ...], what: str, pipeline: str) -> None:
    """Raise StageError unless `folder` has all of `wanted`, which make it `what`."""
    missing = [name for name in wanted if not (folder / name).exists()]
    if missing:
        kind = "there is no such folder" if not folder.exists() else "a file" if folder.is_file() else "a folder with "
        if folder.is_dir():
            kind += names_in(folder)
        hint = f"`hugs run FOLDER --pipeline {pipeline}` takes the folder that holds {' and '.join(wanted)}"
        raise StageError(f"{folder} is not {what}", hint, [f"missing: {', '.join(missing)}", f"found: {kind}"])
