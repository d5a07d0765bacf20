"""Why frames of a clip could not be placed: two separate models, blur, too little texture; by name and with numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import eigh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.contract import Job, StageError
from stages.estimators.cameras import colmap_features
from stages.estimators.cameras.ladder import GOOD_SHARE
from stages.estimators.cameras.motion import Pair
from stages.formats.images import read_image, read_mask, shrink

FEW = 100  # features a frame; a third of them match in the next, and COLMAP wants 30 to place a frame
BLURRED = 1.3  # of `sharpness`; sharp clips have 1.8 to 2.2, a blur of 2 px or a shake of 9 px (of 480) 1.2 to 1.3
SCORE_SIDE = 480  # px: sharpness is compared at this size, as the frames stage does
EXPLAINS = 0.5  # of the frames without a pose: a cause found in fewer is not named
SHOWN = 3  # runs of frames, models and cuts that are listed

ALONE = "go on with the person alone: `--pipeline human_only --set sfm.camera=fixed`"


class NoCameras(StageError):
    """Too few frames could be placed by what their backgrounds show; `placed` of them were."""

    def __init__(self, problem: str, hint: str, facts: list[str], placed: int):
        super().__init__(problem, hint, facts)
        self.placed = placed


@dataclass(frozen=True)
class CameraVerdict:
    """Why frames have no pose: the `name` of the cause, or None if none was found; facts with numbers; a hint."""

    name: str | None
    facts: list[str]
    hint: str


@dataclass(frozen=True)
class Footage:
    """The frames that COLMAP saw: `images` and `ignored` masks by name, the `database`; `need` must get a pose."""

    names: list[str]
    images: Path
    ignored: Path
    database: Path
    need: int

    def require(self, job: Job, posed: list[np.ndarray], tried: list[str]) -> str | None:
        """Raise NoCameras with the verdict if the best model placed fewer than `need` frames; warn if it lacks many.

        `posed` [C] bool of each model, the best first; `tried` are more facts for the error. Returns the verdict's name.
        """
        count, have = len(self.names), int(posed[0].sum()) if posed else 0
        if have == count:
            return None
        if have >= max(self.need, GOOD_SHARE * count):
            job.note(f"left out, because their cameras could not be found: {name_frames(self.names, ~posed[0])}")
            return None
        files = [f"{name}.png" for name in self.names]
        pairs, features = colmap_features.read_pairs(self.database, files)
        verdict = judge_cameras(self.names, posed, features, sharpness(self.images, self.ignored, files), pairs)
        why = f": {verdict.name}" if verdict.name else ""
        if have >= self.need:
            job.warn(f"SfM placed only {have} of {count} frames{why}; {'; '.join(verdict.facts)}")
            return verdict.name
        problem = f"SfM placed only {have} of {count} frames (needs {self.need})"
        if not posed:
            problem = "no model could be made from the matches"
        if not pairs:
            problem = "no two frames match outside the person"
        found = [
            f"{count} frames, verified pairs: {len(pairs)}",
            f"features a frame: {features.min()} at least, {np.median(features):.0f} median",
        ]
        raise NoCameras(problem + why, verdict.hint, [*verdict.facts, *found, *tried], have)


def judge_cameras(
    names: list[str], posed: list[np.ndarray], features: np.ndarray, sharpness: np.ndarray, pairs: list[Pair]
) -> CameraVerdict:
    """Name the cause that keeps frames from being placed.

    `posed` [C] bool says of each model, the best first, which frames it placed; `features` [C] and `sharpness` [C]
    describe the frames, `pairs` are the verified matches. A cause is named if it holds for half of the frames that
    the best model lacks.
    """
    placed = posed[0] if posed else np.zeros(len(names), bool)
    lacking = ~placed
    others = sorted((model & lacking for model in posed[1:] if (model & lacking).any()), key=np.sum, reverse=True)
    few, blurred = features < FEW, sharpness < BLURRED
    facts = [f"longest run: {longest_run(names, placed)}" if placed.any() else "no frame was placed"]
    if few.any():
        facts.append(f"fewer than {FEW} features: {name_frames(names, few)}")
    if blurred.any():
        facts.append(f"blurred: {name_frames(names, blurred)}")

    def explains(cause: np.ndarray) -> bool:
        return bool((cause & lacking).sum() >= max(EXPLAINS * lacking.sum(), 1))

    if others and explains(np.any(others, axis=0)):
        facts[:1] = [f"a model of {name_frames(names, model)}" for model in [placed, *others][:SHOWN]]
        facts.append(describe_cut(names, placed, others[0], pairs))
        return CameraVerdict(
            f"{'two' if len(others) == 1 else 1 + len(others)} separate models",
            facts,
            "the clip jumps or turns too fast at the cut: give one side of it as a clip of its own, or more frames with "
            "`--set frames.count=160`; `--set sfm.min_share=0.3` goes on with the larger side",
        )
    if explains(blurred):
        return CameraVerdict("too blurred", facts, f"film in more light and turn more slowly; or {ALONE}")
    if explains(few):
        return CameraVerdict(
            "too little texture",
            facts,
            f"blank walls and floors have no texture to match: film with more objects in view around the person; or {ALONE}",
        )
    return CameraVerdict(
        None,
        facts,
        "the camera may turn too fast for its frames: try `--set frames.count=160` or `--set sfm.overlap=24`; or it "
        f"hardly moves: {ALONE}",
    )


def sharpness(images: Path, ignored: Path, files: list[str]) -> np.ndarray:
    """How sharp each frame is outside the person [C]: fine against coarse detail, in the direction that has least.

    The smallest ratio of gradient energies at 0.7 and 1.4 px over all directions (structure tensors: Foerstner and
    Guelch 1987). 1 = nothing finer than the coarse; NaN where nothing can be seen. Unlike the variance of the
    Laplacian it does not fall with the amount of texture, and it sees a blur in one direction.
    """
    found = []
    for file in files:
        grey = cv2.cvtColor(shrink(read_image(images / file), SCORE_SIDE), cv2.COLOR_RGB2GRAY).astype(np.float32)
        mask = cv2.resize(read_mask(ignored / file), grey.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        fine, coarse = (_gradient_tensor(grey, sigma, mask) for sigma in (0.7, 1.4))
        seen = np.linalg.eigvalsh(coarse)[0] > 1e-3
        found.append(eigh(fine, coarse, eigvals_only=True)[0] if seen else np.nan)
    return np.array(found)


def _gradient_tensor(grey: np.ndarray, sigma: float, mask: np.ndarray) -> np.ndarray:
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order)[mask].astype(np.float64) for order in ((1, 0), (0, 1)))
    return np.array([[x @ x, x @ y], [x @ y, y @ y]]) / max(len(x), 1)


def runs(chosen: np.ndarray) -> list[tuple[int, int]]:
    """First and last position of each run of true values [C]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(int), [0]])))
    return [(int(start), int(end) - 1) for start, end in edges.reshape(-1, 2)]


def longest_run(names: list[str], chosen: np.ndarray) -> str:
    """The longest run of chosen frames, in words."""
    start, end = max(runs(chosen), key=lambda run: run[1] - run[0])
    return f"frames {names[start]} to {names[end]}"


def name_frames(names: list[str], chosen: np.ndarray) -> str:
    """Which frames are chosen, in words: their number and the first runs of their names."""
    parts = [names[a] if a == b else f"{names[a]} to {names[b]}" for a, b in runs(chosen)]
    more = f" and {len(parts) - SHOWN} more" if len(parts) > SHOWN else ""
    return f"{chosen.sum()} of {len(names)} frames ({', '.join(parts[:SHOWN])}{more})"


def describe_cut(names: list[str], first: np.ndarray, second: np.ndarray, pairs: list[Pair]) -> str:
    """Where the clip changes from one model's frames to the other's, and how many matches join the two."""
    owner = np.flatnonzero(first | second)
    changes = [(a, b) for a, b in zip(owner, owner[1:]) if first[a] != first[b]]
    where = ", ".join(f"between {names[a]} and {names[b]}" for a, b in changes[:SHOWN])
    across = [p for p in pairs if (first[p.first] & second[p.second]) | (second[p.first] & first[p.second])]
    inside = [p for p in pairs if (first[p.first] & first[p.second]) | (second[p.first] & second[p.second])]
    usual = np.median([len(pair.a) for pair in inside]) if inside else 0
    joining = sum(len(pair.a) for pair in across)
    return f"cut {where}: {joining} matches join the two sides; a pair of frames on one side has {usual:.0f}"


def components(pairs: list[Pair], count: int) -> list[np.ndarray]:
    """Sets of frames [count] bool that pairs of matches join, directly or not, the largest first; no single frames."""
    ends = np.array([(pair.first, pair.second) for pair in pairs]).reshape(-1, 2).T
    number, label = connected_components(
        coo_array((np.ones(ends.shape[1]), ends), shape=(count, count)), directed=False
    )
    sets = [label == i for i in range(number)]
    return sorted((chosen for chosen in sets if chosen.sum() > 1), key=np.sum, reverse=True)
