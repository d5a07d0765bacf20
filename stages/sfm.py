"""frames, masks (or cameras of another program) -> cameras.npz, points.ply, undistorted images/, masks/, sparse/, sfm.json."""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import Listing, read_facts

if TYPE_CHECKING:
    import numpy as np

    from stages.estimators.cameras.ladder import Matched
    from stages.estimators.cameras.motion import CameraMotion, Pair
    from stages.estimators.cameras.sparse_model import Pinholes
    from stages.estimators.cameras.verdict import Footage
    from stages.formats.datasets.undistorted import Grid

GUESSED_FOCAL = 1.2  # of the longer side: COLMAP's guess, between a phone's wide lens (0.75) and twice its zoom
HUMAN_ONLY = "film while walking a few steps around the person to get the scene too"


class Params(contract.Params):
    camera: Literal["auto", "fixed"] = "auto"
    """auto: measure how the camera moves. fixed: it stands still; nothing is reconstructed, every frame is kept."""
    focal: float | None = Field(None, gt=0)
    """Focal length, if known, in px of the frames that the frames stage wrote. Default: estimated."""
    features: int = Field(2048, ge=256)
    """About how many SIFT features a frame. Matching time grows with the square; 1024 still place a textured room to 1 mm."""
    overlap: int = Field(2, ge=1)
    """Each frame is matched with this many that follow, besides those 1, 2, 4, 8 ... frames later; 1 and 2 add none.

    Time grows with it.
    """
    undistort: Literal["auto", "always", "never"] = "auto"
    """Whether to remove the lens distortion that SfM found. auto: where it moves pixels visibly.

    The distortion of cameras given by `--cameras` is always removed.
    """
    min_share: float = Field(0.5, gt=0, le=1)
    """Share of the frames that must get a pose."""
    cameras_from: Literal["auto", 0, 1] = "auto"
    """Number of the video's first frame in the names of `--cameras`. auto: read from the names where they tell."""


@dataclass
class Solution:
    """Solved cameras: the poses of `names`, the lens, the COLMAP model, and facts for sfm.json."""

    verdict: str
    names: list[str]
    viewmats: np.ndarray
    focal: float
    center: tuple[float, float]
    k: float
    model: Any = None
    facts: dict[str, Any] = field(default_factory=dict)


def run(job: Job, params: Params, *, frames: Path, masks: Path, cameras: Path | None = None) -> None:
    """Solve the camera of each frame, with the person masked out, and undistort the frames.

    `cameras` of another program (a COLMAP model, transforms.json) take the place of mapping; where they have no points,
    COLMAP triangulates them. A camera that stood still or only turned is named in sfm.json `verdict` and by a warning.
    """
    from stages.estimators.cameras.check import compare_colors, triangulate
    from stages.estimators.cameras.given import import_cameras
    from stages.estimators.cameras.sparse_model import write_model
    from stages.formats.cameras import write_cameras
    from stages.formats.datasets.undistorted import write_undistorted
    from stages.records import Cameras

    listing = read_facts(frames / "frames.json", Listing)
    names, size = [frame.name for frame in listing.frames], (listing.width, listing.height)
    check_masks(names, masks, *size)
    with tempfile.TemporaryDirectory(dir=job.out) as scratch:
        if cameras is None:
            found = map_cameras(job, params, names, frames, masks, size, Path(scratch))
        else:
            found = import_cameras(job, Path(cameras), listing, params.min_share, params.cameras_from)
        for done in write_undistorted(frames, masks, job.out, found.names, found.grids.get):
            job.progress(85 + 14 * done // len(found.names), 100)
        write_cameras(job.out / "cameras.npz", Cameras(tuple(found.names), found.viewmats, found.Ks, *size))
        if found.cloud is not None:
            compare_colors(job, found, found.cloud)
        elif cameras is not None and found.verdict == "moving":
            triangulate(job, found, size, params.features, Path(scratch))
    facts = {
        "verdict": found.verdict,
        "registered": len(found.names),
        "of": len(names),
        "dropped": [name for name in names if name not in set(found.names)],
        **found.facts,
        **write_model(job, found, size),
    }
    (job.out / "sfm.json").write_text(json.dumps(facts, indent=1) + "\n")


def map_cameras(
    job: Job, params: Params, names: list[str], frames: Path, masks: Path, size: tuple[int, int], scratch: Path
) -> Pinholes:
    """Cameras found by COLMAP, and the pinhole that replaces their lens."""
    import numpy as np

    from stages.avatar.cameras import lens
    from stages.avatar.cameras.pinhole import pinhole
    from stages.estimators.cameras import colmap
    from stages.estimators.cameras.sparse_model import Pinholes

    width, height = size
    if params.camera == "fixed":
        focal = params.focal or GUESSED_FOCAL * max(size)
        solution = Solution("static camera", names, fixed_views(len(names)), focal, (width / 2, height / 2), 0.0)
        job.note("the camera is taken to stand still, as set")
    else:
        solution = solve(job, params, names, frames, masks, width, height, scratch)
    shift, focal = lens.max_shift(solution.focal, solution.k, width, height), solution.focal
    grids: dict[str, Grid | None] = dict.fromkeys(solution.names)
    if params.undistort == "never":
        shift = 0.0  # as if there were no lens, and sfm.json says so
    if params.undistort == "always" or shift >= lens.NO_SHIFT:
        center = np.array(solution.center)
        focal = lens.pinhole_focal(solution.focal, center, solution.k, width, height)
        grid = lens.remap_grid(solution.focal, center, solution.k, focal, width, height)
        grids = dict.fromkeys(solution.names, grid)
    if solution.model is not None:
        colmap.make_pinhole(solution.model, focal)
    guessed = solution.verdict == "static camera" and params.focal is None
    if guessed:
        job.warn(
            f"the focal length is a guess ({solution.focal:.0f} px, {GUESSED_FOCAL} x the longer side); "
            "if you know it, give it with --set sfm.focal=PX"
        )
    facts = {
        "focal_px": solution.focal,
        "focal_source": "guessed" if guessed else "given" if params.focal else "estimated",
        "pinhole_focal_px": focal,
        "distortion": {"model": "SIMPLE_RADIAL", "params": [solution.k], "max_shift_px": shift},
        **solution.facts,
    }
    Ks = np.tile(pinhole(focal, width, height), (len(solution.names), 1, 1))
    return Pinholes(solution.verdict, solution.names, solution.viewmats, Ks, grids, facts, solution.model)


def solve(
    job: Job, params: Params, names: list[str], frames: Path, masks: Path, width: int, height: int, scratch: Path
) -> Solution:
    """Features, matches, the verdict on the camera's motion, and the cameras of a clip that stands, turns or walks."""
    from stages.estimators.cameras.ladder import Matched
    from stages.estimators.cameras.motion import judge_motion
    from stages.estimators.cameras.verdict import Footage

    side, images, database = max(width, height), frames / "images", scratch / "database.db"
    pairs, facts = match_frames(job, params, names, frames, masks, width, height, scratch)
    need = math.ceil(params.min_share * len(names))
    footage = Footage(names, images, scratch / "ignored", database, need)
    if not pairs:
        footage.require(job, [], [])  # raises
    motion = judge_motion(pairs, width, height, params.focal)
    facts["motion"] = {
        "displacement_px": motion.displacement_px,
        "rotation_residual_px": motion.rotation_residual_px,
        "rotation_limit_px": motion.rotation_limit_px,
    }
    if motion.verdict == "static camera":
        job.warn(
            f"the camera stands still (the background moves {motion.displacement_px:.2f} px between frames): "
            f"its clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
        )
        focal, center = params.focal or GUESSED_FOCAL * side, (width / 2, height / 2)
        return Solution(motion.verdict, names, fixed_views(len(names)), focal, center, 0.0, facts=facts)
    if motion.verdict == "rotation only":
        return solve_turn(job, footage, motion, pairs, width, height, facts)
    job.progress(55, 100)
    fixed_focal = params.focal is not None
    matched = Matched(database, images, scratch, len(names), side, need, params.overlap, fixed_focal)
    walk = solve_walk(job, matched, footage, motion, pairs, (width, height), facts)
    return walk or solve_turn(job, footage, motion, pairs, width, height, facts)


def match_frames(
    job: Job, params: Params, names: list[str], frames: Path, masks: Path, width: int, height: int, scratch: Path
) -> tuple[list[Pair], dict[str, Any]]:
    """The verified pairs of frames, and the first facts for sfm.json; features and matches go to scratch/database.db."""
    import numpy as np

    from stages.estimators.cameras import colmap
    from stages.estimators.cameras.sparse_model import write_ignored

    files, database, side = [f"{name}.png" for name in names], scratch / "database.db", max(width, height)
    job.progress(0, 100)
    write_ignored(names, masks, scratch / "ignored", side)
    camera = [params.focal, width / 2, height / 2, 0.0] if params.focal else []
    colmap.extract(database, frames / "images", scratch / "ignored", files, params.features, camera)
    job.progress(30, 100)
    colmap.match(database, len(names).bit_length(), growing=True, side=side)
    if params.overlap > 2:
        colmap.match(database, params.overlap, growing=False, side=side)
    pairs, counts = colmap.read_pairs(database, files)
    features = {"min": int(counts.min()), "median": float(np.median(counts))}
    return pairs, {"features": features, "verified_pairs": len(pairs)}


def solve_walk(
    job: Job,
    matched: Matched,
    footage: Footage,
    motion: CameraMotion,
    pairs: list[Pair],
    size: tuple[int, int],
    facts: dict[str, Any],
) -> Solution | None:
    """The cameras of the best model of all rungs, its lens settled; None if no model is reliable and a turn may stand in."""
    from stages.estimators.cameras.intrinsics import settle
    from stages.estimators.cameras.ladder import best_rung, climb
    from stages.estimators.cameras.verdict import components

    names = footage.names
    rungs = climb(job, matched)
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
        facts["lens"] = settle(job, best, *size)
    poses = best.poses
    if doubts := matched.doubts(best):
        job.warn(f"the best reconstruction looks unreliable: {', '.join(doubts)}")
    kept = [name for name in names if name in poses]
    viewmats = fixed_views(len(kept))
    viewmats[:, :3] = [poses[name] for name in kept]
    focal, cx, cy, k = (float(value) for value in next(iter(best.reconstruction.cameras.values())).params)
    return Solution("moving", kept, viewmats, focal, (cx, cy), k, best.reconstruction, facts)


def solve_turn(
    job: Job,
    footage: Footage,
    motion: CameraMotion,
    pairs: list[Pair],
    width: int,
    height: int,
    facts: dict[str, Any],
) -> Solution:
    """The rotations of a camera that only turns, or that hardly does more and cannot be mapped.

    Raises ValueError if `motion` was not measured well enough to know the lens.
    """
    from stages.estimators.cameras.motion import camera_rotations
    from stages.estimators.cameras.verdict import components

    if motion.focal_px is None or motion.k is None:
        raise ValueError("a turn needs the focal length and lens that judge_motion fits")
    names = footage.names
    turns, known = camera_rotations(pairs, len(names), motion.focal_px, motion.k, width, height)
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
    center = (width / 2, height / 2)
    return Solution("rotation only", kept, views[known], motion.focal_px, center, motion.k, facts=facts)


def fixed_views(count: int) -> np.ndarray:
    """`count` cameras at the origin that look along z [count,4,4]."""
    import numpy as np

    return np.tile(np.eye(4), (count, 1, 1))


def check_masks(names: list[str], masks: Path, width: int, height: int) -> None:
    """Raise StageError unless each frame has a mask of the frame's size; COLMAP would ignore it without a word."""
    from stages.formats.images import read_mask

    hint = "run the masks stage again: `hugs run VIDEO masks --force`"
    missing = [name for name in names if not (masks / "masks" / f"{name}.png").is_file()]
    if missing:
        raise StageError(f"{len(missing)} of {len(names)} frames have no mask", hint, [f"the first is {missing[0]}"])
    for name in names:
        shape = read_mask(masks / "masks" / f"{name}.png").shape
        if shape != (height, width):
            fact = f"mask {shape[1]}x{shape[0]}, frame {width}x{height}"
            raise StageError(f"the mask of frame {name} has another size", hint, [fact])
