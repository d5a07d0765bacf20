"""`hugs.train` does the work of the stage train, on arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hugs.progress import Hear, console_for
from hugs_cli.device import device_of
from stages.contract import Job, StageError
from stages.estimators.perceptual import network
from stages.formats.body_model import read_body_model
from stages.formats.clip import Clip
from stages.formats.splits import every_fifth
from stages.records import BETAS, BodyPoses, Cameras, Split
from stages.training import files
from stages.training.beginning.start import Task
from stages.training.results import Result
from stages.training.run import LOOK, Breakdown
from stages.training.run import run as learn
from stages.training.settings import Params

HINT = "see `help(hugs.train)` for shapes and units"


@dataclass(frozen=True)
class _Arrays(Clip):
    """A clip whose pictures [C,H,W,3] and masks [C,H,W], uint8, are in memory, and held-out frames bool [C]."""

    pictures: np.ndarray = field(kw_only=True)
    outlines: np.ndarray = field(kw_only=True)
    measured: np.ndarray | None = field(kw_only=True)

    @cached_property
    def split(self) -> Split:
        if self.measured is None:
            return every_fifth(len(self.names))
        return Split(~self.measured, self.measured, np.arange(len(self.names)), "Given.")

    def images(self, i: int) -> np.ndarray:
        return self.pictures[i]

    def own_mask(self, i: int) -> np.ndarray:
        return self.outlines[i]

    def mask(self, i: int) -> np.ndarray:
        return self.outlines[i]


def train(
    images: ArrayLike,
    masks: ArrayLike,
    viewmats: ArrayLike,
    Ks: ArrayLike,
    body_pose: ArrayLike,
    global_orient: ArrayLike,
    transl: ArrayLike,
    betas: ArrayLike | None = None,
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    heldout: ArrayLike | None = None,
    confidence: ArrayLike | None = None,
    body_model: str | PathLike[str] | None = None,
    effects: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: Hear | None = None,
) -> Result:
    """Train a person and the scene behind on arrays, as the stage `train` does on files.

    All C frames show one person. Cameras, poses and points are in one world, in metres.

    - `images` [C,H,W,3] uint8 without lens distortion, `masks` [C,H,W] bool, or uint8 with 255 for the person.
    - `viewmats` [C,4,4] camera_from_world, OpenCV axes (x right, y down, z forward), m; `Ks` [C,3,3] px, the centre of the first
      pixel at (0.5, 0.5).
    - `body_pose` [C,69] or [C,23,3], `global_orient` [C,3] rad, `transl` [C,3] m, `betas` [10]: poses and shape of SMPL.
      `body_model`: the file of their body model; the free body by default. `confidence` [C]: 0 excludes a frame from training.
    - `points` [P,3] m and `colors` [P,3] uint8 of the scene, for example from SfM; without points the person is trained alone.
    - `heldout` bool [C]: frames on which accuracy is measured; by default every 5th.
    - `effects`: those to learn, "shadow", "clothing", "view_dependence", "exposure", "camera_refinement" and others of
      docs/effects.md; no detector decides.
    - `settings`: of the stage, for example {"steps": 400}; `hugs stages train` lists them.
    - `seed`: of all random numbers. `device`: "auto", "cpu" or "cuda". `progress`: called with a `Progress`.

    The training runs in this process. StageError, with facts and a hint, if the arrays do not fit each other or the training
    breaks down; pydantic's ValidationError, a ValueError, for wrong settings.

        result = hugs.train(images, masks, viewmats, Ks, body_pose, global_orient, transl, settings={"steps": 400})
    """
    views = {"images": images, "masks": masks, "viewmats": viewmats, "Ks": Ks, "heldout": heldout}
    body = {"body_pose": body_pose, "global_orient": global_orient, "transl": transl, "betas": betas}
    clip = _clip(views | body | {"confidence": confidence, "points": points, "colors": colors}, body_model)
    params, (place, _) = Params(**(settings or {})), device_of(device)
    perceptual = network(params.perceptual_net, place) if params.perceptual_every else None
    console = console_for(progress)
    task = Task([clip], params, dict.fromkeys(effects, True), seed=seed, device=place, perceptual=perceptual)
    try:
        return learn(task, Job(Path(), place, seed, console.listens("train")))
    except Breakdown as broken:
        facts = [f"step {broken.step}, frame {broken.frame}: {broken}"]
        raise StageError("training broke down", LOOK, facts) from broken


def _clip(given: Mapping[str, ArrayLike | None], body_model: str | PathLike[str] | None) -> _Arrays:
    """The clip made of the arguments of `train`, by name; StageError if one does not fit."""
    images = _array("images", given["images"], None, None, None, 3, kinds="u")
    count, height, width, _ = images.shape
    masks = _array("masks", given["masks"], count, height, width, kinds="bu")
    viewmats = _array("viewmats", given["viewmats"], count, 4, 4).astype(np.float64)
    Ks = _array("Ks", given["Ks"], count, 3, 3).astype(np.float64)
    turns = np.asarray(given["body_pose"])
    body_pose = _array("body_pose", turns.reshape(len(turns), -1) if turns.ndim == 3 else turns, count, 69)
    one = {"points": np.zeros((0, 3)), "betas": np.zeros(BETAS), "confidence": np.ones(count)}
    have = {name: value if given[name] is None else given[name] for name, value in one.items()}
    points = _array("points", have["points"], None, 3)
    grey = np.full(points.shape, 128, np.uint8) if given["colors"] is None else given["colors"]
    measured = None if given["heldout"] is None else _array("heldout", given["heldout"], count, kinds="b")
    names = tuple(f"{i:06d}" for i in range(count))
    body = BodyPoses(
        names=names,
        betas=_array("betas", have["betas"], BETAS),
        global_orient=_array("global_orient", given["global_orient"], count, 3),
        body_pose=body_pose,
        transl=_array("transl", given["transl"], count, 3),
        confidence=_array("confidence", have["confidence"], count),
    )
    return _Arrays(
        folder=Path(),
        cameras=Cameras(names, viewmats, Ks, width, height),
        viewmats=viewmats,
        points=points.astype(np.float64),
        colors=_array("colors", grey, len(points), 3, kinds="u"),
        body=body,
        body_model=read_body_model(None if body_model is None else Path(body_model)),
        pictures=images,
        outlines=masks.astype(np.uint8) * 255 if masks.dtype == bool else masks,
        measured=measured,
    )


def _array(name: str, given: ArrayLike | None, *shape: int | None, kinds: str = "fiu") -> np.ndarray:
    """`given` as an array; StageError if it is not finite or has another shape (None: any length) or kind of numbers."""
    array = np.asarray(given)
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in kinds or ("f" not in kinds and array.dtype.itemsize > 1):
        wanted = ",".join("any" if one is None else str(one) for one in shape)
        types = " or ".join({"f": "float", "i": "integer", "u": "uint8", "b": "bool"}[one] for one in kinds)
        raise StageError(
            f"{name} does not fit", HINT, [f"{array.dtype} {list(array.shape)}, wanted {types} [{wanted}]"]
        )
    if not np.isfinite(array).all():
        rows = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(1))
        raise StageError(f"{name} has numbers that are not finite", HINT, [f"{len(rows)} rows, the first is {rows[0]}"])
    return array


def save(result: Result, folder: str | PathLike[str]) -> Path:
    """Write a `result` of `hugs.train` to a `folder` (avatar.npz, scene.npz, body.npz, curve.csv, train.json); returns the folder.

    `hugs.load` and the commands read avatar.npz, `hugs.load_scene` reads scene.npz. OSError if the folder cannot be written.

        hugs.save(result, "mine")
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    files.write(out, result)
    return out
