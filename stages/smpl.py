"""frames, sfm (or a fit, or landmarks, of another program) -> body.npz: one body through the clip, in metres in the SfM frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.estimators.words import listed
from stages.formats.facts import Listing, Smpl, read_facts, write_facts
from stages.formats.lengths import Heights, Scale
from stages.formats.people import folder_of, job_of, people_of

if TYPE_CHECKING:
    from stages.estimators.bodyfit.evidence import LandmarkEvidence
    from stages.estimators.bodyfit.fit import BodyFit
    from stages.estimators.bodyfit.inputs import Inputs
    from stages.estimators.bodyfit.metre import Metre
    from stages.estimators.bodyfit.reporting import Fitted
    from stages.gestures import HandPoses
    from stages.records import BodyPoses, Ground

LOADS = contract.ADAM
OVERLAP_LEAST = 0.5  # mean overlap of an imported body's hull and the mask's below which it is doubtful
JOINTS_OFF = 0.05  # of the person's height, from the joints that the tool itself drew


class Params(contract.Params):
    doubtful: float = Field(0.5, ge=0, le=1)
    """Confidence below which a frame's pose is listed as doubtful."""
    height: Heights = None
    """Height of the person, barefoot: 1.85, 185cm or 6ft1; for several people a list in order, or by number: [2=1.70]."""
    scale: Scale = None
    """A length on the page and its true length in m, 2.31=2.00; or cameras: the given cameras are in metres."""


def check(
    params: Params,
    *,
    video: Path,
    smpl_fit: Path | None = None,
    landmarks: Path | None = None,
    face: Path | None = None,
    body_model: Path | None = None,
) -> None:
    """See `contract.StageModule`."""
    from stages.estimators import assets
    from stages.estimators.bodyfit.given_face import check_face
    from stages.estimators.bodyfit.inputs import check_given
    from stages.formats.body_model import read_body_model
    from stages.formats.hands_face import read_hands_face

    check_given(video, smpl_fit, body_model, landmarks)
    model = read_body_model(body_model)
    if face is not None:
        check_face(face, model)
    if read_hands_face(model) is not None:
        assets.path("hand_landmark_full.tflite")


def run(
    job: Job,
    params: Params,
    *,
    frames: Path,
    sfm: Path,
    smpl_fit: Path | None = None,
    landmarks: Path | None = None,
    face: Path | None = None,
    body_model: Path | None = None,
) -> None:
    """Write body.npz, hands.npz, body_model.npz, ground.json, smpl.json, pictures of the fit in overlays/, and landmarks.npz if
    poses are estimated here.

    Poses come from `smpl_fit`, from the fit that a data set brought along, or from `landmarks`, else BlazePose's, and the masks.
    Frames without a person are filled in between their neighbours with confidence 0. A `face` is that of the only person. Results
    of further people are in people/2 and so on, in the world of the first. Raises StageError if nearly no frame shows a person.
    """
    import numpy as np

    from stages.estimators.bodyfit.floor import floor_of
    from stages.estimators.bodyfit.given_face import check_alone, with_face
    from stages.estimators.bodyfit.inputs import of_person, read_inputs
    from stages.estimators.bodyfit.metre import find_metre, stature_of
    from stages.estimators.bodyfit.reporting import report_ground
    from stages.formats.body_model import write_body_model
    from stages.formats.datasets.capture import given_by
    from stages.formats.ground import write_ground

    clip = read_inputs(read_facts(frames / "frames.json", Listing), sfm, body_model)
    smpl_fit = smpl_fit or (None if landmarks else given_by(frames, "smpl_fit.npz"))
    people, heights = people_of(sfm), params.height or {}
    if face is not None:
        check_alone(face, people)
    fits: list[Fitted] = []
    statures: list[float] = []
    jobs = [job if len(people) == 1 else job_of(job, person) for person in people]
    for person, own in zip(people, jobs, strict=True):
        folder_of(job.out, person).mkdir(parents=True, exist_ok=True)
        one = clip if len(people) == 1 else of_person(clip, sfm, person)
        if fits and not smpl_fit and {1, person} <= set(heights):  # in the metre of the first, as tall from the start
            tall = statures[0] * heights[person] / heights[1]
            one = replace(one, model=clip.model.sized(tall / float(np.ptp(clip.model.v_template[:, 1]))))
        metres = fits[0].poses.world_from_sfm if fits else None
        fits.append(fit_person(own, folder_of(job.out, person), sfm, one, (smpl_fit, landmarks), metres))
        statures.append(stature_of(fits[-1].model, fits[-1].poses))
    check_apart([fit.poses for fit in fits], smpl_fit)
    metre = find_metre(statures, fits[0].poses.world_from_sfm, clip.moving, heights, params.scale)
    if metre.given:
        world = metre.factors[0] * fits[0].poses.world_from_sfm
        fits = [in_metres(fit, k, world, clip) for fit, k in zip(fits, metre.factors, strict=True)]
    if face is not None:
        fits = [with_face(job, face, fits[0], clip.times)]
    for person, own, fit, stature in zip(people, jobs, fits, statures, strict=True):
        if person == 1 or fit.model is not fits[0].model:
            write_body_model(folder_of(job.out, person) / "body_model.npz", fit.model)
        write_person(own, params, folder_of(job.out, person), fit, metre, stature)
    for doubt in metre.doubts:
        job.warn(doubt)
    ground = floor_of(clip, *((fit.model, fit.poses) for fit in fits))
    write_ground(job.out / "ground.json", ground)
    report_ground(job, ground)
    draw_fits(sfm, job.out, ground)


def draw_fits(sfm: Path, smpl: Path, ground: Ground) -> None:
    """Write pictures of the fit of each person, for the report."""
    from stages.estimators.bodyfit.overlay import overlays
    from stages.formats.clip import load_people
    from stages.formats.images import write_image

    for clip in load_people(sfm, smpl):
        folder = folder_of(smpl, clip.person)
        (folder / "overlays").mkdir(exist_ok=True)
        for name, picture in overlays(clip, ground, read_facts(folder / "smpl.json", Smpl)):
            write_image(folder / "overlays" / f"{name}.png", picture)


def check_apart(found: list[BodyPoses], smpl_fit: Path | None) -> None:
    """StageError if two people got the same poses of a file."""
    import numpy as np

    for b, two in enumerate(found):
        for a, one in enumerate(found[:b]):
            if smpl_fit is not None and np.array_equal(one.transl, two.transl):
                hint = "give a fit of each of them, or leave it out"
                raise StageError(f"{smpl_fit.name} has one person for persons {a + 1} and {b + 1} of the masks", hint)


def fit_person(
    job: Job, folder: Path, sfm: Path, clip: Inputs, given: tuple[Path | None, Path | None], metres: float | None
) -> Fitted:
    """The fit of one person, in the world of the first, of `metres` per SfM unit, if there are several; `given` are a fit and
    landmarks of another program."""
    from stages.estimators.bodyfit.quality import measure_quality
    from stages.estimators.bodyfit.reporting import Fitted

    smpl_fit, landmarks = given
    if smpl_fit is not None:
        poses, facts = import_poses(job, smpl_fit, clip, metres)
        poses, hands = look_at_hands(sfm, clip, poses, held=True)
        quality = measure_quality(poses, clip.model, clip.cameras, clip.times, clip.clear)
    else:
        fit, evidence, facts = estimate_poses(job, folder, sfm, clip, landmarks, metres)
        poses, hands = look_at_hands(sfm, clip, fit.poses, held=False)
        quality = measure_quality(poses, clip.model, clip.cameras, clip.times, clip.clear, evidence, fit.pixels)
    poses = replace(poses, confidence=quality.confidence)
    if metres is not None:  # it was held, but for rounding
        poses = replace(poses, world_from_sfm=metres)
    return Fitted(clip.model, poses, quality, facts, hands)


def in_metres(fit: Fitted, factor: float, world: float, clip: Inputs) -> Fitted:
    """The fit `factor` times as large, in a world of `world` m per SfM unit, with all of its lengths."""
    from stages.estimators.bodyfit.metre import resized

    model, poses = resized(fit.model, fit.poses, factor, world, clip.cameras.centers.mean(0))
    scale, facts = fit.facts["scale"], dict(fit.facts)
    lengths = scale.keys() & {"initial", "from_still_feet", "floor_refused", "world_from_sfm"}
    facts["scale"] = scale | {name: factor * scale[name] for name in lengths}
    if errors := facts.get("expected_error_mm"):
        facts["expected_error_mm"] = {
            name: {way: [round(factor * mm) for mm in each] for way, each in frame.items()}
            for name, frame in errors.items()
        }
    hands = fit.hands and replace(fit.hands, error=factor * fit.hands.error)
    return replace(fit, model=model, poses=poses, facts=facts, hands=hands)


def look_at_hands(sfm: Path, clip: Inputs, poses: BodyPoses, held: bool) -> tuple[BodyPoses, HandPoses | None]:
    """The fingers of a body that has some, and the poses with arms turned to the palms that are seen, unless they are `held`."""
    from stages.estimators.hands.arms import arms_to_palms
    from stages.estimators.hands.clip import hands_of
    from stages.formats.hands_face import read_hands_face
    from stages.formats.images import read_image

    if (rig := read_hands_face(clip.model)) is None:
        return poses, None
    pictures = [sfm / "images" / f"{name}.png" for name in clip.cameras.names]
    looks = (lambda i: read_image(pictures[i])), clip.masks.__getitem__
    hands, palms = hands_of(rig, clip.model, poses, clip.cameras, clip.times, *looks)
    if palms.read.any() and not held:
        poses = arms_to_palms(clip.model, poses, clip.cameras, clip.times, palms)
    return poses, hands


def write_person(job: Job, params: Params, folder: Path, fit: Fitted, metre: Metre, looks: float) -> None:
    """Write body.npz, hands.npz and smpl.json of a person and report them, who `looks` so many m tall without a given length."""
    from stages.estimators.bodyfit.reporting import report, summary, warn_of_scale
    from stages.estimators.hands.clip import facts_of, what_is_read
    from stages.formats.hands import write_hands
    from stages.formats.poses import write_poses

    write_poses(folder / "body.npz", fit.poses)
    warn_of_scale(job, fit.facts["scale"])
    report(job, params.doubtful, fit, metre, looks)
    size = {"how": metre.how, "error": metre.error, "times_fit": metre.factors[0], "stature_of_fit_m": round(looks, 4)}
    facts = {**fit.facts, **summary(params.doubtful, fit), "metre": size}
    if fit.hands is not None:
        write_hands(folder / "hands.npz", fit.hands)
        job.note(what_is_read(fit.hands))
        facts["hands"] = facts_of(fit.hands)
    write_facts(folder / "smpl.json", facts)


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
    job: Job, folder: Path, sfm: Path, clip: Inputs, given: Path | None, metres: float | None
) -> tuple[BodyFit, LandmarkEvidence, dict[str, Any]]:
    """Fit poses to BlazePose landmarks, or those in the file `given`, and the masks; writes landmarks.npz into `folder`.

    Also gives the evidence, facts for smpl.json.
    """
    from stages.estimators.bodyfit.evidence import model_landmarks
    from stages.estimators.bodyfit.fit import fit_body
    from stages.estimators.bodyfit.reporting import count_names, known, select
    from stages.estimators.bodyfit.seen_landmarks import evidence_of
    from stages.formats.frame_names import plain
    from stages.formats.images import read_image
    from stages.formats.landmarks import write_landmarks

    frames, (names, regressor) = clip.cameras.names, model_landmarks(clip.model)
    job.progress(0, 100)
    images = [read_image(sfm / "images" / f"{name}.png") for name in frames]
    tracks, evidence, marked, found = evidence_of(sfm, clip, images, names, given, job.warn)
    job.progress(40, 100)
    write_landmarks(folder / "landmarks.npz", frames, tracks)
    if given is not None:
        where = f"in {found['frames']} of {len(tracks)} frames, off by {found['off']}"
        job.note(f"landmarks of {plain(given.name)}: {found['skeleton']} {where}")
    odd = {kind: select(frames, marks) for kind, marks in marked.items()}
    if odd["strangers"]:
        job.warn(
            f"left out {count_names(odd['strangers'])}: the landmarks are somebody else's, not the masked person's"
        )
    if odd["sides_exchanged"]:
        job.note(f"left and right exchanged in {count_names(odd['sides_exchanged'])}")
    if odd["turned"]:
        job.warn(f"left out {count_names(odd['turned'])}: the landmarks face another way than in the frames around")

    def show(done: int, total: int, cost: float) -> None:
        job.progress(40 + 55 * done // total, 100, cost=round(cost, 2))

    clear, moving = clip.clear, clip.moving
    fit = fit_body(
        clip.model, regressor, evidence, clip.cameras, clip.times, clear, clip.points, moving, images, show, metres
    )
    if fit.hidden:
        job.note(f"doubtful: wide clothes hide {listed(fit.hidden)}: outlines do not show the body there")
    facts = {
        "source": "blazepose" if given is None else plain(given.name),
        **({"landmarks": found} if found else {}),
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
        **odd,
    }
    return fit, evidence, facts
