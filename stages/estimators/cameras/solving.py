"""From frames and masks to cameras: the cheapest verdicts first, then COLMAP's mappers rung by rung."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stages.estimators.cameras import colmap_features, colmap_lens, short_walk
from stages.estimators.cameras.changing import model_changes
from stages.estimators.cameras.colmap import Model, refine
from stages.estimators.cameras.intrinsics import settle, spreads
from stages.estimators.cameras.ladder import GOOD_SHARE, Matched, best_rung, climb
from stages.estimators.cameras.motion import CameraMotion, Pair, camera_rotations, judge_motion
from stages.estimators.cameras.plain import judge, look
from stages.estimators.cameras.short_walk import TurnOrWalk
from stages.estimators.cameras.sparse_model import write_ignored
from stages.estimators.cameras.standing import HUMAN_ONLY, stands_still, taken_to_stand, zooms
from stages.estimators.cameras.stillness import measure_stillness
from stages.estimators.cameras.task import Solution, Task, fixed_views
from stages.estimators.cameras.verdict import Footage, NoCameras, components
from stages.estimators.cameras.zooming import zoom_alone, zoom_of_edges

CLEARLY = 1.25  # times the error of a short walk: a mapper's model with more gives way to it


def solve(task: Task) -> Solution:
    """The verdict on the camera's motion, and the cameras of a clip that stands, turns or walks."""
    job, parts = task.job, task.parts
    ignored, need = task.scratch / "ignored", math.ceil(task.min_share * len(task.names))
    footage = Footage(task.names, task.images, ignored, task.scratch / "database.db", need)
    job.progress(0, 100)
    with parts.timed("masks"):
        write_ignored(task.names, task.masks, ignored, task.side)
    if task.moves:
        return solve_moving(task, footage)
    with parts.timed("still or not"):
        stillness = measure_stillness(task.images, ignored, task.files)
    if stillness is not None and stillness.still:
        measured = {"displacement_px": round(stillness.drift_px, 4), "stays": round(stillness.stays, 3)}
        return stands_still(task, stillness.drift_px, {"motion": measured})
    with parts.timed("edges"):
        views = look(task.images, ignored, task.files)
        edges = judge(views)
    if edges.still:
        return stands_still(task, edges.drift_px, {"motion": edges.facts()})
    try:
        return solve_moving(task, footage)
    except NoCameras as refusal:
        with parts.timed("zoom"):
            zoom = zoom_of_edges(task.images, ignored, task.files)
        if zoom is not None and np.isfinite(zoom).sum() >= footage.need:
            return zooms(task, footage, zoom, {"motion": edges.facts()})
        return taken_to_stand(task, views, edges, refusal)


def solve_moving(task: Task, footage: Footage) -> Solution:
    """The cameras of a clip by its features; raises NoCameras where they place too few frames."""
    job, parts, size = task.job, task.parts, task.size
    pairs, facts = match_frames(task, footage)
    if not pairs:
        footage.require(job, [], [])  # raises
    with parts.timed("turning or not"):
        motion = judge_motion(pairs, *size, task.focal)
    facts["motion"] = {
        "displacement_px": motion.displacement_px,
        "rotation_residual_px": motion.rotation_residual_px,
        "rotation_limit_px": motion.rotation_limit_px,
    }
    if motion.verdict == "static camera" and not task.moves:
        if components(pairs, len(task.names))[0].sum() < GOOD_SHARE * len(task.names):
            footage.require(job, [], [])  # raises: nothing shows that the others stand where these do
        return stands_still(task, motion.displacement_px, facts)
    zoom = zoom_alone(pairs, len(task.names), *size) if motion.verdict == "moving" and not task.moves else None
    if zoom is not None:
        return zooms(task, footage, zoom, facts)
    compared = None
    if motion.nearly_turns or motion.verdict == "rotation only":
        compared = turn_or_walk(task, motion, pairs, facts)
        if motion.verdict == "rotation only" and compared is not None and compared.walks:
            return short_walk_of(task, footage, compared, pairs, facts, [])
        if motion.verdict == "rotation only" or (compared is not None and compared.turns):
            return solve_turn(task, footage, motion, compared, pairs, facts)
    job.progress(55, 100)
    fixed = task.focal is not None
    count, database = len(task.names), footage.database
    matched = Matched(database, task.images, task.scratch, count, task.side, footage.need, task.overlap, fixed)
    walk = solve_walk(task, matched, footage, motion, compared, pairs, facts)
    return walk or solve_turn(task, footage, motion, compared, pairs, facts)


def match_frames(task: Task, footage: Footage) -> tuple[list[Pair], dict[str, Any]]:
    """The verified pairs of frames, and the first facts for sfm.json; features and matches go to the footage's database."""
    count, known, database = len(task.names), task.known_focal, footage.database
    camera = [known, *task.center, 0.0] if known else []

    def extracted(done: int) -> None:
        task.job.progress(30 * done // count, 100)

    with task.parts.timed("features"):
        colmap_features.extract(
            database, task.images, footage.ignored, task.files, task.features, camera, extracted=extracted
        )
    with task.parts.timed("matches"):
        colmap_features.match(database, count.bit_length(), growing=True, side=task.side)
        if task.overlap > 2:
            colmap_features.match(database, task.overlap, growing=False, side=task.side)
        pairs, counts = colmap_features.read_pairs(database, task.files)
    features = {"min": int(counts.min()), "median": float(np.median(counts))}
    return pairs, {"features": features, "verified_pairs": len(pairs)}


def solve_walk(
    task: Task,
    matched: Matched,
    footage: Footage,
    motion: CameraMotion,
    compared: TurnOrWalk | None,
    pairs: list[Pair],
    facts: dict[str, Any],
) -> Solution | None:
    """The cameras of the best model of all rungs, its lens settled; None if no model is reliable and a turn may stand in.

    Where `compared` found a short walk only the first rung is tried, and what leaves less is taken.
    """
    job, names = task.job, footage.names
    short = compared is not None and compared.walks
    rungs = climb(job, matched, 1 if short else None)
    task.parts.seconds |= {rung.how: rung.seconds for rung in rungs}
    facts["rungs"] = [rung.facts() for rung in rungs]
    rung = best_rung(matched, rungs)
    tried = [f"the background moves {motion.displacement_px:.0f} px", *(rung.describe(matched) for rung in rungs)]
    if compared is not None and short:
        usable = [model for model in rung.models[:1] if matched.usable(model)]
        if not usable or usable[0].middle_error > CLEARLY * np.median(compared.walk.off):
            return short_walk_of(task, footage, compared, pairs, facts, tried)
    joined = components(pairs, len(names))[0].sum() >= footage.need
    if motion.nearly_turns and joined and not any(matched.usable(model) for model in rung.models):
        return None
    facts["mapper"] = rung.how
    facts["trouble"] = footage.require(job, [model.placed_frames(names) for model in rung.models], tried)
    best = rung.models[0]
    with task.parts.timed("refined"):
        refine(best, matched.fixed_focal)
    if not matched.fixed_focal:
        with task.parts.timed("lens"):
            changed = model_changes(job, best, *task.size, task.prior)
            best, facts["lens"] = changed or (best, settle(job, best, *task.size, task.prior))
    if doubts := matched.doubts(best):
        job.warn(f"the best reconstruction looks unreliable: {', '.join(doubts)}; `--cameras` takes better ones")
    return moving(task, best, facts)


def moving(task: Task, model: Model, facts: dict[str, Any]) -> Solution:
    """The cameras of a model, in the order of the frames."""
    poses, lenses = model.poses, model.lenses
    kept = [name for name in task.names if name in poses]
    viewmats = fixed_views(len(kept))
    viewmats[:, :3] = [poses[name] for name in kept]
    focals = np.array([lenses[name][0] for name in kept])
    cx, cy, k = (float(value) for value in lenses[kept[0]][1:])
    return Solution("moving", kept, viewmats, focals, (cx, cy), k, model.reconstruction, facts)


def turn_or_walk(task: Task, motion: CameraMotion, pairs: list[Pair], facts: dict[str, Any]) -> TurnOrWalk | None:
    """The best turn and the best walk of a camera that nearly turns; None if too few matches tell."""
    if motion.focal_px is None or motion.k is None:
        return None
    with task.parts.timed("turn or walk"):
        largest = components(pairs, len(task.names))[0]
        joined = [pair for pair in pairs if largest[pair.first]]
        turns, _ = camera_rotations(joined, len(task.names), motion.focal_px, motion.k, *task.size)
        compared = short_walk.compare(joined, turns, motion.focal_px, motion.k, task.size, task.prior)
    if compared is not None:
        facts["motion"] |= compared.facts()
    return compared


def short_walk_of(
    task: Task, footage: Footage, compared: TurnOrWalk, pairs: list[Pair], facts: dict[str, Any], tried: list[str]
) -> Solution:
    """The cameras of a walk of a step or less, with which no mapper can begin: those that `short_walk` found.

    `tried` says what was before, for the error if too few frames are placed.
    """
    with task.parts.timed("short walk"):
        walk, seen = short_walk.all_tracks(compared, task.prior)
    placed = np.bincount(seen.frame, minlength=len(task.names)) >= short_walk.ENOUGH
    others = [part for part in components(pairs, len(task.names)) if not (part & placed).any()]
    facts["trouble"] = footage.require(task.job, [placed, *others], tried)
    facts["mapper"] = "short walk"
    best = Model(colmap_lens.model_of(task.files, np.zeros((len(walk.bundle.points), 3)), walk.bundle, seen))
    for i in np.flatnonzero(~placed):
        best.reconstruction.deregister_frame(best.reconstruction.images[int(i) + 1].frame_id)
    best.reconstruction.extract_colors_for_all_images(task.images, 1)
    if task.focal is None:
        with task.parts.timed("lens"):
            changed = model_changes(task.job, best, *task.size, task.prior)
            best, facts["lens"] = changed or (best, spreads(walk, task.side))
    task.job.note(
        f"the camera takes a short walk: a pure turn would leave {compared.wins:.1f} times as much of the background's motion "
        "unexplained; distances are known only roughly"
    )
    return moving(task, best, facts)


def solve_turn(
    task: Task,
    footage: Footage,
    motion: CameraMotion,
    compared: TurnOrWalk | None,
    pairs: list[Pair],
    facts: dict[str, Any],
) -> Solution:
    """The rotations of a camera that only turns, or that hardly does more and cannot be mapped.

    The lens is that of `compared`, if there is one. Where a turn does not explain the clip, it is known no better than
    before. Raises ValueError if `motion` was not measured well enough to know the lens.
    """
    if motion.focal_px is None or motion.k is None:
        raise ValueError("a turn needs the focal length and lens that judge_motion fits")
    job, names = task.job, footage.names
    turns, known = camera_rotations(pairs, len(names), motion.focal_px, motion.k, *task.size)
    others = [part for part in components(pairs, len(names)) if not (part & known).any()]
    facts["trouble"] = footage.require(job, [known, *others], [])
    focals, k = np.full(len(names), motion.focal_px), motion.k
    facts["lens"] = {"focal_spread_px": round(task.prior.spread * motion.focal_px, 3)}
    if compared is not None:
        bundle = compared.turn.bundle
        turns, focals, k = bundle.viewmats[:, :3, :3], bundle.focals, bundle.k
        turns = turns @ turns[np.argmax(known)].T
        facts["lens"] |= spreads(compared.turn, task.side) if compared.turns else {}
    only = compared.turns if compared is not None else motion.verdict == "rotation only"
    job.warn(
        f"the camera {'only turns' if only else 'hardly does more than turn, and no walk explains it'} (the background "
        f"moves by {motion.displacement_px:.0f} px, a turn explains all but {motion.rotation_residual_px:.2f} px): "
        f"the clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
    )
    views = fixed_views(len(names))
    views[:, :3, :3] = turns
    kept = [name for name, there in zip(names, known, strict=True) if there]
    return Solution("rotation only", kept, views[known], focals[known], task.center, k, facts=facts)
