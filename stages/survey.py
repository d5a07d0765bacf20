"""frames, masks, sfm, smpl -> survey.json: measures of the clip, and the effects that training should model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stages import contract
from stages.contract import Job
from stages.formats.facts import Sfm, read_facts, write_facts

if TYPE_CHECKING:
    from stages.estimators.detectors.finding import Finding
    from stages.formats.clip import Clip

Effect = Literal["auto", "always", "never"]
LOADS = contract.TORCH
OF_PERSON = ("pose_refinement", "face", "clothing", "shading")
"""Effects that are looked for in each of several people alone."""
MISSED = ("clothing", "face")
"""Effects whose lack is seen in the avatar: the run prints why they are off."""

# Limits at which a measure changes a decision or causes a warning.
MIN_PARALLAX_DEG = 1.0  # below this SfM depth is mostly noise
MIN_POINTS = 100  # fewer points start no scene
MAX_REPROJECTION_PX = 1.0
MIN_COVERAGE = 0.02  # of the picture; below it the person is too small to learn a face or hands from


class Params(contract.Params):
    """Which effects to model. auto: those that the detectors in stages/estimators/detectors find; if unknown, off.

    The lens has no setting: `sfm` removes distortion of 0.1 px or more; the survey reports the rest.
    """

    scene: Effect = "auto"
    """Model the scene around the person. auto: when SfM found a moving camera and enough points."""
    view_dependence: Effect = "auto"
    """Colours of the scene that depend on the viewing direction. auto: when points change with the view."""
    exposure: Effect = "auto"
    """Learn a gain per frame. auto: when the background's brightness drifts or jumps."""
    rolling_shutter: Effect = "auto"
    """The camera reads a frame row by row. auto: when points move within a frame that way."""
    motion_blur: Effect = "auto"
    """Frames are blurred while the shutter is open. auto: when edges across the motion are wider."""
    shadow: Effect = "auto"
    """The person's shadow on the floor. auto: when the floor darkens where the body takes the light."""
    shading: Effect = "auto"
    """The clip's light on the person. auto: when places on the body brighten or darken as they turn."""
    clothing: Effect = "auto"
    """Clothes and hair with bones of their own. auto: when masks from all sides agree on something off the body."""
    pose_refinement: Effect = "auto"
    """Let training correct the body's poses. auto: when the posed body does not cover the mask."""
    face: Effect = "auto"
    """How the face moves in each frame. auto: when it is large enough, and not hidden, where it looks at the camera."""
    camera_refinement: Effect = "auto"
    """Let training correct the cameras. auto: when they contradict what is seen in several frames."""
    sky: Effect = "auto"
    """A background infinitely far away. auto: when part of the picture stays in place however the camera moves."""
    transients: Effect = "auto"
    """Leave out passers-by. auto: when neighbouring frames contradict each other outside the person."""
    antialias: Effect = "auto"
    """Keep Gaussians from flickering at other distances. auto: when things are seen at very different sizes."""


def run(job: Job, params: Params, *, frames: Path, masks: Path, sfm: Path, smpl: Path) -> None:
    """Measure the clip and decide, with reasons, what training models."""
    from stages.estimators.detectors.every import DETECTORS
    from stages.estimators.detectors.evidence import ClipEvidence
    from stages.formats.clip import load_people
    from stages.formats.images import Kept

    facts = read_facts(sfm / "sfm.json", Sfm)
    kept = Kept()
    people = [replace(clip, kept=kept) for clip in load_people(sfm, smpl)]
    clip = people[0]
    evidence = ClipEvidence(clip, facts)
    each = [evidence]
    if len(people) > 1:
        each = [ClipEvidence(apart(one, people), facts) for one in people]
    measures, findings = camera_measures(facts, clip) | person_measures(clip), {}
    for done, (name, detect) in enumerate(DETECTORS.items()):
        job.progress(done, len(DETECTORS))
        findings[name] = strongest([detect(one) for one in each]) if name in OF_PERSON else detect(evidence)
    job.progress(len(DETECTORS), len(DETECTORS))
    effects = {name: decide(getattr(params, name, "auto"), finding) for name, finding in findings.items()}
    scene, why = decide_scene(params.scene, facts.verdict, len(clip.points))
    for text in [f"scene {'on' if scene else 'off'} ({why})", *reasons(effects)]:
        job.note(text)
    for name in ("camera_parallax", "reprojection", "coverage"):
        if measures[name]["verdict"] in ("weak", "loose", "small"):
            job.warn(f"{name.replace('_', ' ')} is {measures[name]['verdict']}: {describe(measures[name])}")
    decisions = {"scene": scene} | {name: effect["on"] for name, effect in effects.items()}
    starts = {name: list(finding.start) for name, finding in findings.items() if finding.start}
    found = {"measures": measures, "effects": effects, "decisions": decisions, "starts": starts}
    write_facts(job.out / "survey.json", found)


def apart(clip: Clip, people: list[Clip]) -> Clip:
    """The clip of one of several people, with their own masks, and without their body where another touches or hides them."""
    from stages.estimators.bodyfit.inputs import touch

    others = [one for one in people if one.person != clip.person]
    confidence = clip.body.confidence.copy()
    for i in range(len(clip.names)):
        if any(touch(clip.own_mask(i), other.own_mask(i)) for other in others):
            confidence[i] = 0
    return replace(clip, alone=True, body=replace(clip.body, confidence=confidence))


def strongest(findings: list[Finding]) -> Finding:
    """The finding of the largest value among those of several people; one that calls for a model goes first."""
    return max(
        findings, key=lambda found: (found.called_for, -1.0 if found.value is None else found.value / found.threshold)
    )


def decide(setting: Effect, finding: Finding) -> dict:
    """The entry of an effect in survey.json: the finding, whether training models it, and why."""
    on = finding.called_for if setting == "auto" else setting == "always"
    measured = finding.verdict
    if finding.value is not None:
        measured += f": {finding.value:.3g} {finding.unit}, limit {finding.threshold:g}"
    return finding.entry() | {"on": on, "why": measured if setting == "auto" else f"as set; {measured}"}


def reasons(effects: dict[str, dict]) -> list[str]:
    """The effects that are on and why, why those of MISSED are off, those that could not be measured, and the names of the rest."""
    lines = [f"{name.replace('_', ' ')} on ({effect['why']})" for name, effect in effects.items() if effect["on"]]
    off = {name: effect for name, effect in effects.items() if not effect["on"]}
    why = {name: name in MISSED or effect["value"] is None for name, effect in off.items()}
    lines += [f"{name.replace('_', ' ')} off ({effect['why']})" for name, effect in off.items() if why[name]]
    quiet = [name.replace("_", " ") for name in off if not why[name]]
    return lines + ([f"off: {', '.join(quiet)}"] if quiet else [])


def decide_scene(setting: Effect, verdict: str, points: int) -> tuple[bool, str]:
    """Whether the scene is modelled, and why: it takes a moving camera and points to start from."""
    moving = verdict == "moving"
    why = f"{points} points from a moving camera" if moving else f"{verdict}, so the clip shows no depth"
    on = moving and points >= MIN_POINTS if setting == "auto" else setting == "always"
    if on and not points:
        return False, "set to always, but SfM left no points to start from"
    return on, why if setting == "auto" else f"as set; measured: {why}"


def measure(value: float | None, unit: str, threshold: float, verdict: str, frames: list[str] | None = None) -> dict:
    """One of the measures of survey.json; `value` None or not finite: too little to measure, and the verdict "unknown"."""
    if value is None or not math.isfinite(value):
        value, verdict = None, "unknown"
    return {"value": value, "unit": unit, "threshold": threshold, "verdict": verdict, "frames": frames or []}


def describe(entry: dict) -> str:
    """A measure in words: value and unit."""
    return "too little to measure" if entry["value"] is None else f"{entry['value']:.3g} {entry['unit']}".strip()


def camera_measures(facts: Sfm, clip: Clip) -> dict[str, dict]:
    """Parallax, baseline against depth, reprojection error and points; from sfm.json, in the clip's world."""
    import numpy as np

    from stages.avatar.cameras.pinhole import camera_centers, project

    angle, error = facts.median_triangulation_deg, facts.reprojection_px
    ratio = None
    if len(clip.points):
        centers = camera_centers(clip.viewmats)
        depth = np.median([np.median(project(clip.points, view, K)[1]) for view, K in zip(clip.viewmats, clip.Ks)])
        reach = np.linalg.norm(centers - np.median(centers, 0), axis=1)
        ratio = float(2 * np.quantile(reach, 0.9) / depth) if depth > 0 else None
    return {
        "camera_parallax": measure(
            angle, "deg", MIN_PARALLAX_DEG, "good" if angle and angle >= MIN_PARALLAX_DEG else "weak"
        ),
        "baseline": measure(ratio, "of the median depth", 0.05, "good" if ratio and ratio >= 0.05 else "short"),
        "reprojection": measure(
            error, "px", MAX_REPROJECTION_PX, "good" if error and error <= MAX_REPROJECTION_PX else "loose"
        ),
        "points": measure(len(clip.points), "", MIN_POINTS, "enough" if len(clip.points) >= MIN_POINTS else "too few"),
    }


def person_measures(clip: Clip) -> dict[str, dict]:
    """How much of the picture the person covers, and in which frames nobody is."""
    import numpy as np

    coverage = np.array([(clip.mask(i) > 127).mean() for i in range(len(clip.names))])
    nobody = [name for name, share in zip(clip.names, coverage) if share == 0]
    median = float(np.median(coverage))
    return {
        "coverage": measure(median, "of the picture", MIN_COVERAGE, "good" if median >= MIN_COVERAGE else "small"),
        "frames_without_person": measure(len(nobody), "frames", 0, "some" if nobody else "none", nobody),
    }
