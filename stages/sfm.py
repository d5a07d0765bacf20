"""frames, masks -> cameras.npz, points.ply, undistorted images/ and masks/, sparse/ (COLMAP), sfm.json."""

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
from stages.formats.facts import NAME, read_facts

if TYPE_CHECKING:
    import numpy as np

GUESSED_FOCAL = 1.2  # of the longer side: COLMAP's guess, between a phone's wide lens (0.75) and twice its zoom
PERSON = 64  # mask value from which a pixel counts as the person when features are looked for
DILATION = 0.01  # of the longer side: descriptors reach beyond their keypoint, and masks miss hair and hands
NO_SHIFT = 0.1  # px: a lens that moves nothing farther is left alone; resampling would cost more than it mends
GOOD_SHARE = 0.9  # of the frames: below this the second mapper gets its chance too
MIN_TRACK, MAX_ERROR = 3, 2.0  # frames that must see a point; px it may be off on average
PERSON_SHARE = 0.8  # a point that falls on the person in more of its views than this is taken for the person's
FLAT = 0.02  # thickness over width of the points: below it focal length and depth are poorly fixed
HUMAN_ONLY = "film while walking a few steps around the person to get the scene too"

LISTING = {"width": int, "height": int, "frames": [{"name": NAME}]}
"""What is taken from frames.json."""


class Params(contract.Params):
    camera: Literal["auto", "fixed"] = "auto"
    """auto: find out how the camera moved. fixed: it stood still; nothing is reconstructed, every frame is kept."""
    focal: float | None = Field(None, gt=0)
    """Focal length in px of the frames as the frames stage wrote them, if it is known; else it is estimated."""
    features: int = Field(2048, ge=256)
    """SIFT features a frame, about. Matching time grows with its square; 1024 still place a textured room to 1 mm."""
    overlap: int = Field(2, ge=1)
    """Each frame is matched with this many that follow, besides those 1, 2, 4, 8 ... frames later. Time grows with it."""
    min_share: float = Field(0.5, gt=0, le=1)
    """Share of the frames that must get a pose."""


@dataclass
class Solution:
    """What was found out about the cameras: poses of `names`, the lens, the COLMAP model, numbers for sfm.json."""

    verdict: str
    names: list[str]
    viewmats: np.ndarray
    focal: float
    center: tuple[float, float]
    k: float
    model: Any = None
    facts: dict = field(default_factory=dict)


def run(job: Job, params: Params, *, frames: Path, masks: Path) -> None:
    """Find out where each frame was taken from, with the person masked out, and undistort the frames once.

    A camera that stood still or only turned is named in sfm.json `verdict` and by a warning, never mapped.
    """
    import numpy as np

    from stages.avatar import lens
    from stages.estimators import colmap
    from stages.formats.cameras import Cameras, write_cameras
    from stages.formats.undistorted import write_undistorted

    listing = read_facts(frames / "frames.json", LISTING)
    names = [frame["name"] for frame in listing["frames"]]
    width, height = listing["width"], listing["height"]
    check_masks(names, masks, width, height)
    with tempfile.TemporaryDirectory(dir=job.out) as scratch:
        if params.camera == "fixed":
            focal = params.focal or GUESSED_FOCAL * max(width, height)
            solution = Solution("static camera", names, fixed_views(len(names)), focal, (width / 2, height / 2), 0.0)
            job.note("the camera is taken to stand still, as asked")
        else:
            solution = solve(job, params, names, frames, masks, width, height, Path(scratch))
    shift = lens.max_shift(solution.focal, solution.k, width, height)
    pinhole = solution.focal
    if shift >= NO_SHIFT:
        pinhole = lens.pinhole_focal(solution.focal, np.array(solution.center), solution.k, width, height)
    K = np.array([[pinhole, 0, width / 2], [0, pinhole, height / 2], [0, 0, 1.0]])
    center = np.array(solution.center)
    grid = lens.remap_grid(solution.focal, center, solution.k, pinhole, width, height) if shift >= NO_SHIFT else None
    for done in write_undistorted(frames, masks, job.out, solution.names, lambda name: grid):
        job.progress(85 + 14 * done // len(solution.names), 100)
    Ks = np.tile(K, (len(solution.names), 1, 1))
    write_cameras(job.out / "cameras.npz", Cameras(tuple(solution.names), solution.viewmats, Ks, width, height))
    sparse = job.out / "sparse"
    sparse.mkdir()
    if solution.model is None:
        files = [f"{name}.png" for name in solution.names]
        solution.model = colmap.empty_model(files, solution.viewmats, K, width, height)
    else:
        colmap.make_pinhole(solution.model, pinhole)
    solution.facts |= write_points(job, solution, K)
    solution.model.write_binary(sparse)
    guessed = solution.verdict == "static camera" and params.focal is None
    if guessed:
        job.warn(
            f"the focal length is a guess ({solution.focal:.0f} px, {GUESSED_FOCAL} x the longer side); "
            "if you know it, give it with --set sfm.focal=PX"
        )
    facts = {
        "verdict": solution.verdict,
        "registered": len(solution.names),
        "of": len(names),
        "dropped": [name for name in names if name not in set(solution.names)],
        "focal_px": solution.focal,
        "focal_source": "guessed" if guessed else "given" if params.focal else "estimated",
        "pinhole_focal_px": pinhole,
        "distortion": {"model": "SIMPLE_RADIAL", "params": [solution.k], "max_shift_px": shift},
        **solution.facts,
    }
    (job.out / "sfm.json").write_text(json.dumps(facts, indent=1) + "\n")


def solve(
    job: Job, params: Params, names: list[str], frames: Path, masks: Path, width: int, height: int, scratch: Path
) -> Solution:
    """Features, matches, the verdict on the camera's motion, and for a moving camera the best model."""
    import numpy as np

    from stages.avatar.camera_motion import camera_rotations, judge_motion
    from stages.estimators import colmap

    files, images, database = [f"{name}.png" for name in names], frames / "images", scratch / "database.db"
    job.progress(0, 100)
    side = max(width, height)
    write_ignored(names, masks, scratch / "ignored", side)
    camera = [params.focal, width / 2, height / 2, 0.0] if params.focal else []
    colmap.extract(database, images, scratch / "ignored", files, params.features, camera)
    job.progress(30, 100)
    colmap.match(database, len(names).bit_length(), growing=True, side=side)
    if params.overlap > 2:
        colmap.match(database, params.overlap, growing=False, side=side)
    pairs, counts = colmap.read_pairs(database, files)
    facts: dict = {
        "features": {"min": int(counts.min()), "median": float(np.median(counts))},
        "verified_pairs": len(pairs),
    }
    found = [f"{len(names)} frames", f"features a frame: {counts.min()} at least, {np.median(counts):.0f} median"]
    if not pairs:
        raise StageError(
            "no two frames show the same thing outside the person",
            "the background may be blank or blurred; go on without it with `--pipeline human_only`",
            [*found, "verified pairs: 0"],
        )
    motion = judge_motion(pairs, width, height, params.focal)
    facts["motion"] = {
        "displacement_px": motion.displacement_px,
        "rotation_residual_px": motion.rotation_residual_px,
        "rotation_limit_px": motion.rotation_limit_px,
    }
    center = (width / 2, height / 2)
    if motion.verdict == "static camera":
        job.warn(
            f"the camera stands still (the background moves {motion.displacement_px:.2f} px between frames): "
            f"its clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
        )
        focal = params.focal or GUESSED_FOCAL * max(width, height)
        return Solution(motion.verdict, names, fixed_views(len(names)), focal, center, 0.0, facts=facts)
    if motion.verdict == "rotation only":
        turns, known = camera_rotations(pairs, len(names), motion.focal_px, motion.k, width, height)
        require_share(params, names, known, found)
        job.warn(
            f"the camera only turns (that explains the {motion.displacement_px:.0f} px by which the background "
            f"moves to {motion.rotation_residual_px:.2f} px): its clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
        )
        views = fixed_views(len(names))
        views[:, :3, :3] = turns
        kept = [name for name, there in zip(names, known, strict=True) if there]
        return Solution(motion.verdict, kept, views[known], motion.focal_px, center, motion.k, facts=facts)
    job.progress(55, 100)
    models = map_all(job, params, database, images, scratch, len(names))
    if not models:
        raise StageError(
            "no model could be made from the matches",
            "film with more sideways motion and more texture, or go on without the scene: `--pipeline human_only`",
            [*found, f"verified pairs: {len(pairs)}", f"the background moves {motion.displacement_px:.0f} px"],
        )
    best = models[0]
    posed = {image.name.removesuffix(".png"): image for image in best.reconstruction.images.values() if image.has_pose}
    require_share(params, names, np.array([name in posed for name in names]), found)
    kept = [name for name in names if name in posed]
    viewmats = fixed_views(len(kept))
    viewmats[:, :3] = [posed[name].cam_from_world().matrix() for name in kept]
    focal, cx, cy, k = (float(value) for value in next(iter(best.reconstruction.cameras.values())).params)
    facts |= {"mapper": best.how, "models": [model.facts() for model in models]}
    if not 0.3 < focal / max(width, height) < 3:
        job.warn(f"the estimated focal length, {focal:.0f} px for frames of {width}x{height}, is hard to believe")
    return Solution("moving", kept, viewmats, focal, (cx, cy), k, best.reconstruction, facts)


def map_all(job: Job, params: Params, database: Path, images: Path, scratch: Path, count: int) -> list:
    """All models, the best first: most frames, then a believable focal length, then the smaller error.

    The global mapper goes first: on halves and quarters of one real clip it found the same focal length within 1 %,
    where the incremental one, in twice the time, was up to 50 % off and stopped short of the best fit.
    """
    from stages.estimators import colmap

    placed = 0

    def step() -> None:
        nonlocal placed
        placed = min(placed + 1, count)
        job.progress(60 + 25 * placed // count, 100, frames=placed)

    def rank(model: colmap.Model) -> tuple:
        camera = next(iter(model.reconstruction.cameras.values()))
        sane = 0.3 < model.focal / max(camera.width, camera.height) < 3
        return model.registered, sane, -model.reconstruction.compute_mean_reprojection_error()

    fixed_focal = params.focal is not None
    models = colmap.map_global(database, images, scratch / "global", fixed_focal)
    if not any(rank(model) >= (GOOD_SHARE * count, True, -MAX_ERROR) for model in models):
        job.note("the global mapper left frames out; trying the incremental one too")
        models += colmap.map_incremental(database, images, scratch / "incremental", fixed_focal, step)
    return sorted(models, key=rank, reverse=True)


def require_share(params: Params, names: list[str], posed: np.ndarray, found: list[str]) -> None:
    """Raise StageError with the longest run of posed frames, if fewer than `min_share` have a pose."""
    need, have = math.ceil(params.min_share * len(names)), int(posed.sum())
    if have >= need:
        return
    runs = "".join("x" if there else " " for there in posed).split(" ")
    longest = max(map(len, runs))
    start = "".join("x" if there else " " for there in posed).index("x" * longest)
    where = f"longest run: frames {names[start]} to {names[start + longest - 1]}" if longest else "no frame was placed"
    raise StageError(
        f"SfM placed only {have} of {len(names)} frames (needs {need})",
        "the clip may turn too fast for its frames; try `--set frames.count=160` or `--set sfm.overlap=24`, "
        "or go on without the scene with `--pipeline human_only`",
        [where, *found],
    )


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


def write_ignored(names: list[str], masks: Path, out: Path, side: int) -> None:
    """Write COLMAP's masks, 0 = ignore: the person, made a little larger."""
    import cv2
    import numpy as np

    from stages.formats.images import read_mask, write_mask

    out.mkdir()
    reach = max(2, round(DILATION * side))
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    for name in names:
        person = (read_mask(masks / "masks" / f"{name}.png") >= PERSON).astype(np.uint8)
        write_mask(out / f"{name}.png", 255 * (1 - cv2.dilate(person, brush)))


def write_points(job: Job, solution: Solution, K: np.ndarray) -> dict:
    """Drop weak points from the model, write the rest as points.ply, and say how many went and how the rest lie."""
    import numpy as np

    from stages.avatar.cameras import project
    from stages.estimators import colmap
    from stages.formats.images import read_mask
    from stages.formats.points import write_points as write

    ids, xyz, rgb, tracks, errors = colmap.points_and_tracks(solution.model)
    on_person, in_view = np.zeros(len(ids)), np.zeros(len(ids))
    for name, viewmat in zip(solution.names, solution.viewmats, strict=True) if len(ids) else ():
        mask = read_mask(job.out / "masks" / f"{name}.png")
        pixels, z = project(xyz, viewmat, K)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < mask.shape[::-1]).all(1)
        x, y = pixels[inside].astype(int).T
        in_view += inside
        on_person[inside] += mask[y, x] > 127
    short, loose = tracks < MIN_TRACK, errors > MAX_ERROR
    person = on_person > PERSON_SHARE * np.maximum(in_view, 1)
    keep = ~(short | loose | person)
    for i in ids[~keep]:
        solution.model.delete_point3D(i)
    write(job.out / "points.ply", xyz[keep], rgb[keep])
    facts: dict = {
        "points": int(keep.sum()),
        "points_dropped": {"short_track": int(short.sum()), "error": int(loose.sum()), "on_person": int(person.sum())},
    }
    if not keep.any():
        return facts
    angles = colmap.triangulation_angles(solution.model)
    spread = np.linalg.svd((xyz - np.median(xyz, 0))[keep & (errors < MAX_ERROR)], compute_uv=False)
    flatness = float(spread[2] / spread[0])
    if flatness < FLAT:
        job.warn(f"the points lie on a plane (thickness {flatness:.3f} of their width): the focal length is uncertain")
    return facts | {
        "reprojection_px": float(errors[keep].mean()),
        "median_track": float(np.median(tracks[keep])),
        "median_triangulation_deg": float(np.median(angles)),
        "flatness": flatness,
    }
