"""From frames and masks to cameras: the cheapest verdicts first, then COLMAP's mappers rung by rung."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import Job
from stages.estimators.cameras import colmap
from stages.estimators.cameras.changing import model_changes
from stages.estimators.cameras.intrinsics import Prior, settle, usual
from stages.estimators.cameras.ladder import Matched, best_rung, climb
from stages.estimators.cameras.motion import CameraMotion, Pair, camera_rotations, judge_motion
from stages.estimators.cameras.parts import Parts
from stages.estimators.cameras.sparse_model import write_ignored
from stages.estimators.cameras.stillness import measure_stillness
from stages.estimators.cameras.verdict import Footage, components

GUESSED_FOCAL = 1.2  # of the longer side: COLMAP's guess, between a phone's wide lens (0.75) and twice its zoom
HUMAN_ONLY = "film while walking a few steps around the person to get the scene too"


@dataclass(frozen=True)
class Task:
    """Frames `names` of `size` (width, height) px in `images`, their person in `masks`; settings as in stages/sfm.py.

    `told` is what the file says of its focal length.
    """

    job: Job
    names: list[str]
    size: tuple[int, int]
    images: Path
    masks: Path
    scratch: Path
    parts: Parts
    features: int
    overlap: int
    min_share: float
    focal: float | None = None
    told: Prior | None = None

    @property
    def files(self) -> list[str]:
        """The frames' file names."""
        return [f"{name}.png" for name in self.names]

    @property
    def side(self) -> int:
        """The frames' longer side in px."""
        return max(self.size)

    @property
    def center(self) -> tuple[float, float]:
        """The frames' middle in px."""
        return self.size[0] / 2, self.size[1] / 2

    @property
    def known_focal(self) -> float | None:
        """Focal length in px that the user or the file gives."""
        return self.focal or (self.told.focal if self.told else None)


@dataclass
class Solution:
    """Solved cameras: poses and focal lengths [C] px of `names`, the lens, the COLMAP model, and facts for sfm.json."""

    verdict: str
    names: list[str]
    viewmats: np.ndarray
    focals: np.ndarray
    center: tuple[float, float]
    k: float
    model: Any = None
    facts: dict[str, Any] = field(default_factory=dict)


def solve(task: Task) -> Solution:
    """The verdict on the camera's motion, and the cameras of a clip that stands, turns or walks."""
    job, parts, size = task.job, task.parts, task.size
    ignored, database = task.scratch / "ignored", task.scratch / "database.db"
    job.progress(0, 100)
    with parts.timed("masks"):
        write_ignored(task.names, task.masks, ignored, task.side)
    with parts.timed("still or not"):
        stillness = measure_stillness(task.images, ignored, task.files)
    if stillness is not None and stillness.still:
        measured = {"displacement_px": round(stillness.drift_px, 4), "stays": round(stillness.stays, 3)}
        return stands_still(task, stillness.drift_px, {"motion": measured})
    pairs, facts = match_frames(task, ignored, database)
    need = math.ceil(task.min_share * len(task.names))
    footage = Footage(task.names, task.images, ignored, database, need)
    if not pairs:
        footage.require(job, [], [])  # raises
    with parts.timed("turning or not"):
        motion = judge_motion(pairs, *size, task.focal)
    facts["motion"] = {
        "displacement_px": motion.displacement_px,
        "rotation_residual_px": motion.rotation_residual_px,
        "rotation_limit_px": motion.rotation_limit_px,
    }
    if motion.verdict == "static camera":
        return stands_still(task, motion.displacement_px, facts)
    if motion.verdict == "rotation only":
        return solve_turn(task, footage, motion, pairs, facts)
    job.progress(55, 100)
    fixed = task.focal is not None
    matched = Matched(database, task.images, task.scratch, len(task.names), task.side, need, task.overlap, fixed)
    walk = solve_walk(task, matched, footage, motion, pairs, facts)
    return walk or solve_turn(task, footage, motion, pairs, facts)


def still(task: Task, facts: dict[str, Any]) -> Solution:
    """The cameras of a clip whose camera stands still."""
    count = len(task.names)
    focals = np.full(count, task.known_focal or GUESSED_FOCAL * task.side)
    return Solution("static camera", task.names, fixed_views(count), focals, task.center, 0.0, facts=facts)


def stands_still(task: Task, displacement: float, facts: dict[str, Any]) -> Solution:
    """`still`, said to the user, of a clip whose background moves by `displacement` px."""
    task.job.warn(
        f"the camera stands still (the background moves {displacement:.2f} px between frames): "
        f"its clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
    )
    return still(task, facts)


def match_frames(task: Task, ignored: Path, database: Path) -> tuple[list[Pair], dict[str, Any]]:
    """The verified pairs of frames, and the first facts for sfm.json; features and matches go to `database`."""
    count, known = len(task.names), task.known_focal
    camera = [known, *task.center, 0.0] if known else []

    def extracted(done: int) -> None:
        task.job.progress(30 * done // count, 100)

    with task.parts.timed("features"):
        colmap.extract(database, task.images, ignored, task.files, task.features, camera, extracted=extracted)
    with task.parts.timed("matches"):
        colmap.match(database, count.bit_length(), growing=True, side=task.side)
        if task.overlap > 2:
            colmap.match(database, task.overlap, growing=False, side=task.side)
        pairs, counts = colmap.read_pairs(database, task.files)
    features = {"min": int(counts.min()), "median": float(np.median(counts))}
    return pairs, {"features": features, "verified_pairs": len(pairs)}


def solve_walk(
    task: Task,
    matched: Matched,
    footage: Footage,
    motion: CameraMotion,
    pairs: list[Pair],
    facts: dict[str, Any],
) -> Solution | None:
    """The cameras of the best model of all rungs, its lens settled; None if no model is reliable and a turn may stand in."""
    job, names = task.job, footage.names
    rungs = climb(job, matched)
    task.parts.seconds |= {rung.how: rung.seconds for rung in rungs}
    facts["rungs"] = [rung.facts() for rung in rungs]
    rung = best_rung(matched, rungs)
    joined = components(pairs, len(names))[0].sum() >= footage.need
    if motion.nearly_turns and joined and not any(matched.usable(model) for model in rung.models):
        return None
    tried = [f"the background moves {motion.displacement_px:.0f} px", *(rung.describe(matched) for rung in rungs)]
    facts["mapper"] = rung.how
    facts["trouble"] = footage.require(job, [model.placed_frames(names) for model in rung.models], tried)
    best = rung.models[0]
    if not matched.fixed_focal:
        with task.parts.timed("lens"):
            prior = task.told or usual(task.side)
            changed = model_changes(job, best, *task.size, prior)
            best, facts["lens"] = changed or (best, settle(job, best, *task.size, prior))
    poses, lenses = best.poses, best.lenses
    if doubts := matched.doubts(best):
        job.warn(f"the best reconstruction looks unreliable: {', '.join(doubts)}")
    kept = [name for name in names if name in poses]
    viewmats = fixed_views(len(kept))
    viewmats[:, :3] = [poses[name] for name in kept]
    focals = np.array([lenses[name][0] for name in kept])
    cx, cy, k = (float(value) for value in lenses[kept[0]][1:])
    return Solution("moving", kept, viewmats, focals, (cx, cy), k, best.reconstruction, facts)


def solve_turn(
    task: Task, footage: Footage, motion: CameraMotion, pairs: list[Pair], facts: dict[str, Any]
) -> Solution:
    """The rotations of a camera that only turns, or that hardly does more and cannot be mapped.

    Raises ValueError if `motion` was not measured well enough to know the lens.
    """
    if motion.focal_px is None or motion.k is None:
        raise ValueError("a turn needs the focal length and lens that judge_motion fits")
    job, names = task.job, footage.names
    turns, known = camera_rotations(pairs, len(names), motion.focal_px, motion.k, *task.size)
    others = [part for part in components(pairs, len(names)) if not (part & known).any()]
    facts["trouble"] = footage.require(job, [known, *others], [])
    only = motion.verdict == "rotation only"
    job.warn(
        f"the camera {'only turns' if only else 'hardly does more than turn, and nothing could be mapped'} "
        f"(a turn explains the {motion.displacement_px:.0f} px by which the background moves to "
        f"{motion.rotation_residual_px:.2f} px): its clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
    )
    views = fixed_views(len(names))
    views[:, :3, :3] = turns
    kept = [name for name, there in zip(names, known, strict=True) if there]
    focals = np.full(len(kept), motion.focal_px)
    return Solution("rotation only", kept, views[known], focals, task.center, motion.k, facts=facts)


def fixed_views(count: int) -> np.ndarray:
    """`count` cameras at the origin that look along z [count,4,4]."""
    return np.tile(np.eye(4), (count, 1, 1))
