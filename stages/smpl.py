"""frames, sfm (or an SMPL fit of another program) -> body.npz: one body through the clip, in metres in the SfM frame; its floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.estimators.words import listed
from stages.formats.facts import Listing, read_facts, write_facts
from stages.formats.people import folder_of, people_of

if TYPE_CHECKING:
    import numpy as np

    from stages.estimators.bodyfit.evidence import LandmarkEvidence
    from stages.estimators.bodyfit.fit import BodyFit
    from stages.estimators.bodyfit.inputs import Inputs
    from stages.estimators.bodyfit.quality import FitQuality
    from stages.records import BodyModel, BodyPoses, Ground, SeenLandmarks

LOADS = contract.ADAM
STOCKY, EXTREME_BETA = (1.4, 2.15), 5.0  # m; a stature or shape outside these is worth a warning
FLOOR_SPREAD = 0.05  # of the scale, between the frames that agree on it best
BETTER = "look at them in the report; `--smpl-fit` takes a better fit"
OVERLAP_LEAST = 0.5  # mean overlap of an imported body's hull and the mask's below which it is doubtful
JOINTS_OFF = 0.05  # of the person's height, from the joints that the tool itself drew
SEEN_LEAST = 0.1  # share of the frames that must show a person


class Params(contract.Params):
    doubtful: float = Field(0.5, ge=0, le=1)
    """Confidence below which a frame's pose is listed as doubtful."""


def check(params: Params, *, video: Path, smpl_fit: Path | None = None, body_model: Path | None = None) -> None:
    """See `contract.StageModule`."""
    from stages.estimators.bodyfit.inputs import check_given

    check_given(video, smpl_fit, body_model)


def run(
    job: Job, params: Params, *, frames: Path, sfm: Path, smpl_fit: Path | None = None, body_model: Path | None = None
) -> None:
    """Write body.npz, body_model.npz, ground.json, smpl.json, and landmarks.npz if the poses were estimated here.

    Poses come from `smpl_fit`, from the fit that a data set brought along, or from BlazePose landmarks and the masks.
    Frames without a person are filled in between their neighbours with confidence 0. Of further people body.npz, smpl.json and
    landmarks.npz are in people/2 and so on, in the world of the first. Raises StageError if nearly no frame shows a person.
    """
    from stages.estimators.bodyfit.inputs import of_person, read_inputs
    from stages.formats.body_model import write_body_model
    from stages.formats.datasets.capture import given_by
    from stages.formats.ground import write_ground

    listing = read_facts(frames / "frames.json", Listing)
    clip = read_inputs(listing, sfm, body_model)
    smpl_fit = smpl_fit or given_by(frames, "smpl_fit.npz")
    write_body_model(job.out / "body_model.npz", clip.model)
    people = people_of(sfm)
    found: list[BodyPoses] = []
    for person in people:
        folder = folder_of(job.out, person)
        folder.mkdir(parents=True, exist_ok=True)
        one = clip if len(people) == 1 else of_person(clip, sfm, person)
        if len(people) > 1:
            job.note(f"person {person}:")
        found.append(fit_person(job, params, folder, sfm, one, smpl_fit, found[0] if found else None))
    check_apart(found, smpl_fit)
    ground = floor_of(clip, *found)
    write_ground(job.out / "ground.json", ground)
    report_ground(job, ground)


def check_apart(found: list[BodyPoses], smpl_fit: Path | None) -> None:
    """StageError if two people got the same poses of a file."""
    import numpy as np

    for b, two in enumerate(found):
        for a, one in enumerate(found[:b]):
            if smpl_fit is not None and np.array_equal(one.transl, two.transl):
                hint = "give a fit of each of them, or leave it out"
                raise StageError(f"{smpl_fit.name} has one person for persons {a + 1} and {b + 1} of the masks", hint)


def fit_person(
    job: Job,
    params: Params,
    folder: Path,
    sfm: Path,
    clip: Inputs,
    smpl_fit: Path | None,
    first: BodyPoses | None,
) -> BodyPoses:
    """The poses of one person, in the world of the `first` if there are several; writes and reports them."""
    from stages.estimators.bodyfit.quality import measure_quality
    from stages.formats.poses import write_poses

    metres = None if first is None else first.world_from_sfm
    if smpl_fit is not None:
        poses, facts = import_poses(job, smpl_fit, clip, metres)
        quality = measure_quality(poses, clip.model, clip.cameras, clip.times, clip.clear)
    else:
        fit, evidence, facts = estimate_poses(job, folder, sfm, clip, metres)
        poses = fit.poses
        quality = measure_quality(poses, clip.model, clip.cameras, clip.times, clip.clear, evidence, fit.pixels)
    poses = replace(poses, confidence=quality.confidence)
    if metres is not None:  # it was held, but for rounding
        poses = replace(poses, world_from_sfm=metres)
    write_poses(folder / "body.npz", poses)
    warn_of_scale(job, facts["scale"])
    report(job, params, poses, clip.model, quality)
    facts = {**facts, **summary(params, poses, clip.model, quality)}
    write_facts(folder / "smpl.json", facts)
    return poses


def import_poses(job: Job, smpl_fit: Path, clip: Inputs, metres: float | None) -> tuple[BodyPoses, dict[str, Any]]:
    """Poses read from another program's file, and facts for smpl.json; says which of its people was taken."""
    from stages.estimators.bodyfit.given import import_fit
    from stages.formats.frame_names import plain
    from stages.formats.given_fits.recognize import read_smpl_fit

    fit = read_smpl_fit(smpl_fit, (clip.cameras.width, clip.cameras.height))
    poses, facts = import_fit(fit, clip, metres)
    for note in facts.pop("notes"):
        job.warn(note)
    overlap, people = facts["overlap"], facts["people"]
    if clip.others and len(people) < 2:
        hint = "give a fit that holds all of them, leave out --smpl-fit, or choose one with `--person ID`"
        raise StageError(f"{smpl_fit.name} is a fit of one person, and the masks show several", hint)
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
    return poses, {"source": plain(smpl_fit.name), **facts}


def estimate_poses(
    job: Job, folder: Path, sfm: Path, clip: Inputs, metres: float | None
) -> tuple[BodyFit, LandmarkEvidence, dict[str, Any]]:
    """Fit poses to BlazePose landmarks and the masks; writes landmarks.npz into `folder`.

    Also gives the evidence, facts for smpl.json.
    """
    from stages.estimators.bodyfit.evidence import drop_cut, drop_strangers, gather, model_landmarks, vote_sides
    from stages.estimators.bodyfit.fit import fit_body
    from stages.formats.images import read_image
    from stages.formats.landmarks import write_landmarks

    frames, (names, regressor) = clip.cameras.names, model_landmarks(clip.model)
    job.progress(0, 100)
    images = [read_image(sfm / "images" / f"{name}.png") for name in frames]
    tracks = follow(sfm, clip, images)
    job.progress(40, 100)
    evidence, strangers = drop_strangers(gather(tracks, names), clip.masks)
    evidence, swapped = vote_sides(drop_cut(evidence, (clip.cameras.width, clip.cameras.height)))
    count = int(evidence.seen.sum())
    if count < max(2, SEEN_LEAST * len(tracks)):
        who = "a person"
        hint = "use a clip that shows one whole person, or give a fit of your own with --smpl-fit FIT.npz"
        if clip.others:
            who = f"person {clip.person}"
            hint = "leave them out: follow one with `--person ID`, or give masks of the others alone with --masks"
        more = [f"{int(strangers.sum())} more frames showed somebody else than the masked person"]
        raise StageError(f"{who} was found in only {count} of {len(tracks)} frames", hint, more)
    write_landmarks(folder / "landmarks.npz", frames, tracks)
    others, exchanged = select(frames, strangers), select(frames, swapped)
    if others:
        job.warn(f"left out {count_names(others)}: the landmarks are somebody else's, not the masked person's")
    if exchanged:
        job.note(f"left and right exchanged in {count_names(exchanged)}")

    def show(done: int, total: int, cost: float) -> None:
        job.progress(40 + 55 * done // total, 100, cost=round(cost, 2))

    clear, moving = clip.clear, clip.moving
    fit = fit_body(
        clip.model, regressor, evidence, clip.cameras, clip.times, clear, clip.points, moving, images, show, metres
    )
    if fit.hidden:
        job.note(f"doubtful: wide clothes hide {listed(fit.hidden)}, where outlines say nothing of the body")
    facts = {
        "source": "blazepose",
        "scale": fit.scale,
        "cloth_off": [known(off) for off in fit.cloth_off],
        "expected_error_mm": {
            name: {"along": along, "across": across}
            for name, (along, across) in zip(
                frames, (1000 * fit.expected_error).round().astype(int).transpose(0, 2, 1).tolist()
            )
        },
        "hidden_by_clothes": fit.hidden,
        "not_seen": select(frames, ~evidence.seen),
        "strangers": others,
        "sides_exchanged": exchanged,
    }
    return fit, evidence, facts


def follow(sfm: Path, clip: Inputs, images: Sequence[np.ndarray]) -> Sequence[SeenLandmarks | None]:
    """The person's landmarks in each frame: those by which the masks were made, else BlazePose's of whom the masks show."""
    from stages.estimators.person.blazepose import BlazePose, pick_masked
    from stages.formats.landmarks import read_landmarks

    if (sfm / "landmarks.npz").exists():
        known = read_landmarks(sfm / "landmarks.npz")
        return [known[name] for name in clip.cameras.names]
    network = BlazePose()
    if clip.others:
        from stages.estimators.person.identities import track_masked

        return track_masked(network, images, clip.masks, clip.others)
    masked = [i for i, mask in enumerate(clip.masks) if (mask > 127).any()]
    return network.track(images, pick_masked(network.sightings(images, masked), clip.masks))


def select(names: Sequence[str], chosen: np.ndarray) -> list[str]:
    """The names where `chosen` bool [F] is true."""
    return [name for name, taken in zip(names, chosen, strict=True) if taken]


def warn_of_scale(job: Job, scale: dict[str, Any]) -> None:
    """Warn where the size of the person against the scene is hardly known, the plane below the feet is not theirs, or it slopes."""
    if "floor_refused" in scale:
        plane = f"{scale['floor_refused']:.3g} m per SfM unit, differing by {100 * scale['floor_spread']:.0f} %"
        job.warn(
            f"the person does not stand on the plane below their feet in the picture: it gives {plane}, the standing feet"
            f" give {scale['initial']:.3g}; is there a table, a stage, stairs, a jump or a moving board?"
        )
    if (slope := scale.get("floor_slope_degrees")) is not None:
        job.warn(f"the floor slopes by about {slope:.0f} degrees: upright is taken from camera and person instead")
    if scale["how"].startswith("not found"):
        job.warn("the person's scale in the scene is unknown: no floor below the feet and no standing foot was found")
    elif "floor_refused" not in scale and scale.get("floor_spread", 0) > FLOOR_SPREAD:
        job.warn(f"the feet meet the floor at scales that differ by {100 * scale['floor_spread']:.0f} %")


def report(job: Job, params: Params, poses: BodyPoses, model: BodyModel, quality: FitQuality) -> None:
    """Note how large the body is and how well it fits; warn of doubtful poses, jumps and unusual shapes."""
    import numpy as np

    stature = stature_of(model, poses)
    doubtful = select(poses.names, quality.confidence < params.doubtful)
    error, iou = mean_known(quality.error_px), mean_known(quality.iou)
    parts = [f"body {stature:.2f} m tall, {poses.world_from_sfm:.4g} m per SfM unit"]
    parts += [f"landmarks {error:.1f} px off"] if error is not None else []
    parts += [f"outline IoU {iou:.2f}"] if iou is not None else []
    job.note(", ".join(parts))
    if doubtful:
        job.warn(f"the body's pose is doubtful in {count_names(doubtful)}: {BETTER}")
    if fast := fast_frames(poses, quality):
        job.warn(f"the body jumps at {count_names(fast)}: {BETTER}")
    if not STOCKY[0] < stature < STOCKY[1] or np.abs(poses.betas).max() > EXTREME_BETA:
        job.warn(f"an unusual shape: {stature:.2f} m tall, betas up to {np.abs(poses.betas).max():.1f}")


def floor_of(clip: Inputs, *people: BodyPoses) -> Ground:
    """The floor under the placed bodies, from SfM's points and the soles of the frames that show somebody."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from stages.avatar.cameras.pinhole import rescale_viewmats
    from stages.avatar.motion.placing import Soles
    from stages.estimators.ground import find_ground

    turns, points, stood = [], [], []
    for poses in people:
        seen = poses.confidence > 0
        if not seen.any():
            seen = ~seen
        turns.append(Rotation.from_rotvec(poses.global_orient[seen]).as_matrix())
        soles = Soles.of_model(clip.model, poses.betas)
        feet, joints = soles.at(poses.global_orient[seen], poses.body_pose[seen], poses.transl[seen])
        points.append(feet)
        stood.append((joints[len(joints) // 2, 0], turns[-1][len(joints) // 2]))
    most = max(feet.shape[1] for feet in points)  # a body's shape decides how many points its soles have
    all_feet = np.concatenate([np.pad(feet, ((0, 0), (0, most - feet.shape[1]), (0, 0)), "edge") for feet in points])
    metres = people[0].world_from_sfm
    viewmats = rescale_viewmats(clip.cameras.viewmats, metres)
    return find_ground(clip.points * metres, all_feet, np.concatenate(turns), *stood[0], viewmats, metres)


def report_ground(job: Job, ground: Ground) -> None:
    """Note how sure the floor is; warn where it is guessed."""
    sure = f"within {100 * ground.height_error:.1f} cm and {math.degrees(ground.tilt_error):.1f} degrees"
    if ground.points:
        job.note(f"floor: {ground.points} points of the scene lie in it, {sure}")
    else:
        job.warn(f"no floor is found in the scene under the person: it is guessed from the bodies, {sure}")


def summary(params: Params, poses: BodyPoses, model: BodyModel, quality: FitQuality) -> dict[str, Any]:
    """What smpl.json says about the result."""
    each = zip(poses.names, quality.error_px, quality.iou, quality.confidence, strict=True)
    return {
        "body_model": model.name,
        "world_from_sfm": poses.world_from_sfm,
        "stature_m": round(stature_of(model, poses), 4),
        "betas": [round(float(b), 4) for b in poses.betas],
        "mean_error_px": mean_known(quality.error_px),
        "mean_iou": mean_known(quality.iou),
        "doubtful": select(poses.names, quality.confidence < params.doubtful),
        "fast": fast_frames(poses, quality),
        "frames": {n: {"error_px": known(e), "iou": known(u), "confidence": known(c)} for n, e, u, c in each},
    }


def stature_of(model: BodyModel, poses: BodyPoses) -> float:
    """Height in m of the body at rest."""
    import numpy as np

    shape = model.v_template + model.shapedirs @ poses.betas
    return float(np.ptp(shape[:, 1]))


def fast_frames(poses: BodyPoses, quality: FitQuality) -> list[str]:
    """The frames at which a joint turns faster than a person's can, each with the joint."""
    return [f"{name} ({joint})" for name, joint in zip(poses.names, quality.fast, strict=True) if joint]


def mean_known(values: np.ndarray) -> float | None:
    """The mean of those `values` that are finite, to 4 digits; None if none is."""
    import numpy as np

    finite = values[np.isfinite(values)]
    return round(float(finite.mean()), 4) if len(finite) else None


def known(value: float) -> float | None:
    """A value to 4 digits for JSON, None for one that is not finite."""
    return round(float(value), 4) if math.isfinite(value) else None


def count_names(names: list[str]) -> str:
    """How many frames, and the first of their names."""
    return f"{len(names)} frame{'s' if len(names) > 1 else ''}: {listed(names, 5)}"
