"""frames, sfm (or an SMPL fit of another program) -> body.npz: one body through the clip, in metres in the SfM frame."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import Listing, Sfm, read_facts

if TYPE_CHECKING:
    import numpy as np

    from stages.estimators.bodyfit.quality import FitQuality
    from stages.records import BodyModel, BodyPoses, Cameras

STOCKY, EXTREME_BETA = (1.4, 2.15), 5.0  # m; a stature or shape outside these is worth a warning
FLOOR_SPREAD = 0.05  # of the scale, between the frames that agree on it best
OVERLAP_LEAST = 0.5  # mean overlap of an imported body's hull and the mask's below which it is doubtful
JOINTS_OFF = 0.05  # of the person's height, from the joints that the tool itself drew
SEEN_LEAST = 0.1  # share of the frames that must show a person


class Params(contract.Params):
    doubtful: float = Field(0.5, ge=0, le=1)
    """Confidence under which a frame's pose is named as doubtful."""


def run(
    job: Job, params: Params, *, frames: Path, sfm: Path, smpl_fit: Path | None = None, body_model: Path | None = None
) -> None:
    """Write body.npz, body_model.npz, smpl.json, and landmarks.npz if the poses were estimated here.

    Poses come from `smpl_fit`, from the fit that a data set brought along, or from BlazePose landmarks and the masks.
    Frames without a person are filled in between their neighbours with confidence 0. Raises StageError if nearly no
    frame shows a person.
    """
    import numpy as np

    from stages.estimators.bodyfit.quality import measure_quality
    from stages.formats.body_model import read_body_model, write_body_model
    from stages.formats.cameras import read_cameras
    from stages.formats.datasets.capture import given_by
    from stages.formats.images import read_mask
    from stages.formats.points import read_points
    from stages.formats.poses import write_poses

    model = read_body_model(body_model)
    cameras = read_cameras(sfm / "cameras.npz")
    masks = [read_mask(sfm / "masks" / f"{name}.png") for name in cameras.names]
    points = read_points(sfm / "points.ply")[0].astype(np.float64)
    moving = read_facts(sfm / "sfm.json", Sfm).verdict == "moving"
    listing = read_facts(frames / "frames.json", Listing)
    taken = {frame.name: frame.time_s for frame in listing.frames}
    times = np.array([taken[name] for name in cameras.names], np.float64)
    smpl_fit = smpl_fit or given_by(frames, "smpl_fit.npz")
    if listing.dataset and body_model is None:
        job.warn("the data set's poses and shapes are those of SMPL, the free body is another: give --body-model FILE")
    if smpl_fit is not None:
        pictures = {frame.name: frame.source for frame in listing.frames if frame.source}
        sources = tuple(pictures[name] for name in cameras.names if name in pictures)
        poses, facts = import_poses(job, smpl_fit, model, cameras, times, masks, points, moving, sources)
        verdict = measure_quality(poses, model, cameras, times, masks)
    else:
        poses, facts, evidence, pixels = estimate_poses(job, sfm, model, cameras, times, points, moving, masks)
        verdict = measure_quality(poses, model, cameras, times, masks, evidence, pixels)
    poses = replace(poses, confidence=verdict.confidence)
    write_poses(job.out / "body.npz", poses)
    write_body_model(job.out / "body_model.npz", model)
    warn_of_scale(job, facts["scale"])
    facts = {**facts, **summary(job, params, poses, model, verdict)}
    (job.out / "smpl.json").write_text(json.dumps(facts, indent=1) + "\n")


def import_poses(
    job: Job,
    smpl_fit: Path,
    model: BodyModel,
    cameras: Cameras,
    times: np.ndarray,
    masks: list[np.ndarray],
    points: np.ndarray,
    moving: bool,
    sources: tuple[str, ...],
) -> tuple[BodyPoses, dict[str, Any]]:
    """Poses read from another program's file; says which of its people was taken, and what else is worth knowing."""
    from stages.estimators.bodyfit.given import import_fit
    from stages.formats.given_fits.recognize import read_smpl_fit

    fit = read_smpl_fit(smpl_fit, (cameras.width, cameras.height))
    poses, facts = import_fit(fit, model, cameras, times, masks, points, moving, sources)
    for note in facts.pop("notes"):
        job.warn(note)
    if fit.tool != "npz" and model.name == "free body":
        job.warn(f"{fit.tool} fits SMPL's body, the free body is another: give --body-model FILE")
    overlap, people = facts["overlap"], facts["people"]
    if len(people) > 1:
        others = [f"{who or 'unnamed'} {100 * share:.0f} %" for who, share in people.items() if share is not None]
        job.note(
            f"person {facts['person']} of {fit.tool} is the masked one; overlap with the masks: {', '.join(others)}"
        )
    if overlap is not None and overlap < OVERLAP_LEAST:
        job.warn(f"the fit of {fit.tool} overlaps the masks by only {100 * overlap:.0f} %: is it of this person?")
    if facts.get("tool_joints_off") is not None and facts["tool_joints_off"] > JOINTS_OFF:
        off = 100 * facts["tool_joints_off"]
        job.warn(f"the body's joints are {off:.0f} % of its height from where {fit.tool} drew them: is it SMPL's body?")
    return poses, {"source": smpl_fit.name, **facts}


def estimate_poses(
    job: Job,
    sfm: Path,
    model: BodyModel,
    cameras: Cameras,
    times: np.ndarray,
    points: np.ndarray,
    moving: bool,
    masks: list[np.ndarray],
):
    """Poses fitted to BlazePose landmarks and the masks; writes landmarks.npz. Also gives evidence and pixels."""
    import numpy as np

    from stages.estimators.bodyfit import evidence as evidences
    from stages.estimators.bodyfit.fit import fit_body
    from stages.estimators.person.blazepose import BlazePose, pick_masked
    from stages.formats.images import read_image

    names, regressor = evidences.model_landmarks(model)
    job.progress(0, 100)
    network, images = BlazePose(), [read_image(sfm / "images" / f"{name}.png") for name in cameras.names]
    tracks = network.track(images, pick_masked(network.sightings(images), masks))
    job.progress(40, 100)
    evidence, strangers = evidences.drop_strangers(evidences.gather(tracks, names), masks)
    evidence, swapped = evidences.vote_sides(evidence)
    count = int(evidence.seen.sum())
    if count < max(2, SEEN_LEAST * len(tracks)):
        raise StageError(
            f"a person was found in only {count} of {len(tracks)} frames",
            "use a clip that shows one whole person, or give a fit of your own with --smpl-fit FIT.npz",
            [f"{int(strangers.sum())} more frames showed somebody else than the masked person"],
        )
    blank = np.zeros((33, 6))
    found = np.stack([blank if t is None else np.c_[t.xy, t.visibility, t.world] for t in tracks])
    np.savez(
        job.out / "landmarks.npz",
        names=np.array(cameras.names),
        xy=found[..., :2],
        visibility=found[..., 2],
        world=found[..., 3:],
    )
    named = lambda chosen: [n for n, c in zip(cameras.names, chosen, strict=True) if c]  # noqa: E731
    if strangers.any():
        job.warn(f"somebody else than the masked person was found in {_some(named(strangers))}; left out")
    if swapped.any():
        job.note(f"left and right exchanged in {_some(named(swapped))}")
    shown = lambda done, total, cost: job.progress(40 + 55 * done // total, 100, cost=round(cost, 2))  # noqa: E731
    fit = fit_body(model, regressor, evidence, cameras, times, masks, points, moving, shown)
    facts = {
        "source": "blazepose",
        "scale": fit.scale,
        "not_seen": named(~evidence.seen),
        "strangers": named(strangers),
        "sides_exchanged": named(swapped),
    }
    return fit.poses, facts, evidence, fit.pixels


def warn_of_scale(job: Job, scale: dict[str, Any]) -> None:
    """Say so where the size of the person against the scene is weakly known."""
    if scale["how"].startswith("not found"):
        job.warn(
            "the size of the person against the scene is unknown: no floor under the feet, and no foot that stands"
        )
    elif scale.get("floor_spread", 0) > FLOOR_SPREAD:
        job.warn(f"the feet meet the floor at scales that differ by {100 * scale['floor_spread']:.0f} %")


def summary(job: Job, params: Params, poses: BodyPoses, model: BodyModel, verdict: FitQuality) -> dict[str, Any]:
    """What smpl.json says about the result, and the notes and warnings a user should see."""
    import numpy as np

    def mean(values: np.ndarray) -> float | None:
        known = values[~np.isnan(values)]
        return round(float(known.mean()), 4) if len(known) else None

    shape = model.v_template + model.shapedirs @ poses.betas
    stature = float(np.ptp(shape[:, 1]))
    doubtful = [n for n, c in zip(poses.names, verdict.confidence, strict=True) if c < params.doubtful]
    fast = [f"{n} ({joint})" for n, joint in zip(poses.names, verdict.fast, strict=True) if joint]
    error, iou = mean(verdict.error_px), mean(verdict.iou)
    told = [f"body {stature:.2f} m tall, {poses.world_from_sfm:.4g} m per SfM unit"]
    told += [f"landmarks {error:.1f} px off"] if error is not None else []
    told += [f"outline IoU {iou:.2f}"] if iou is not None else []
    job.note(", ".join(told))
    if doubtful:
        job.warn(f"the body's pose is doubtful in {_some(doubtful)}")
    if fast:
        job.warn(f"the body jumps at {_some(fast)}")
    if not STOCKY[0] < stature < STOCKY[1] or np.abs(poses.betas).max() > EXTREME_BETA:
        job.warn(f"an unusual shape: {stature:.2f} m tall, betas up to {np.abs(poses.betas).max():.1f}")
    rounded = lambda value: None if np.isnan(value) else round(float(value), 4)  # noqa: E731
    each = zip(poses.names, verdict.error_px, verdict.iou, verdict.confidence, strict=True)
    return {
        "body_model": model.name,
        "world_from_sfm": poses.world_from_sfm,
        "stature_m": round(stature, 4),
        "betas": [round(float(b), 4) for b in poses.betas],
        "mean_error_px": error,
        "mean_iou": iou,
        "doubtful": doubtful,
        "fast": fast,
        "frames": {n: {"error_px": rounded(e), "iou": rounded(u), "confidence": rounded(c)} for n, e, u, c in each},
    }


def _some(names: list[str]) -> str:
    """A few names and how many there are."""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{len(names)} frame{'s' if len(names) > 1 else ''}: {', '.join(names[:5])}{more}"
