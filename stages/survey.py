"""frames, masks, sfm, smpl -> survey.json: what was measured on this clip, and which effects it calls for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from stages import contract
from stages.contract import Job

if TYPE_CHECKING:
    import numpy as np

    from stages.formats.clip import Clip

Effect = Literal["auto", "always", "never"]

# Where a finding changes a decision or is worth a warning.
MIN_PARALLAX_DEG = 1.0  # below this SfM depth is mostly noise
MIN_POINTS = 100  # fewer points start no scene
EXPOSURE_STD = 0.02  # of the log gain over the clip
EXPOSURE_STEP = 0.05  # of the log gain between neighbouring frames
MAX_SHIFT_PX = 0.5  # lens displacement worth correcting; sfm has corrected it
MAX_REPROJECTION_PX = 1.0
MIN_FIT_IOU = (
    0.95  # of posed body and mask: clothes and hair alone cost 0.05 to 0.1, a wrong pose more; refining is cheap
)
MIN_COVERAGE = 0.02  # of the picture; below it the person is too small to learn a face or hands from
FIT_FRAMES = 24  # enough for a median, 2 s of work
MIN_SAMPLES = 30  # points that must be seen in a frame before its exposure is believed


class Params(contract.Params):
    scene: Effect = "auto"
    """Model the scene around the person. auto: when SfM found a moving camera and enough points."""
    exposure: Effect = "auto"
    """Learn a gain per frame. auto: when the background's brightness drifts or jumps."""
    pose_refinement: Effect = "auto"
    """Let training correct the body's poses. auto: when the posed body does not cover the mask."""


def run(job: Job, params: Params, *, frames: Path, masks: Path, sfm: Path, smpl: Path) -> None:
    """Measure the clip and decide, with reasons, what training models."""
    from stages.formats.clip import load_clip
    from stages.formats.facts import read_facts

    facts = read_facts(sfm / "sfm.json", {"verdict": str, "distortion": {"max_shift_px": float}})
    clip = load_clip(sfm, smpl)
    job.progress(0, 3)
    measures = camera_measures(facts, clip)
    job.progress(1, 3)
    measures |= exposure_measures(clip)
    job.progress(2, 3)
    measures |= person_measures(clip)
    job.progress(3, 3)
    decisions, reasons = decide(params, facts, measures)
    for text in reasons:
        job.note(text)
    for name in ("camera_parallax", "reprojection", "coverage"):
        if measures[name]["verdict"] in ("weak", "loose", "small"):
            job.warn(f"{name.replace('_', ' ')} is {measures[name]['verdict']}: {said(measures[name])}")
    found = {"measures": measures, "decisions": decisions, "reasons": reasons}
    (job.out / "survey.json").write_text(json.dumps(found, indent=1) + "\n")


def measure(value: float | None, unit: str, threshold: float, verdict: str, frames: list[str] | None = None) -> dict:
    """One entry of survey.json; `value` None means that there was too little to measure, and the verdict "unknown"."""
    if value is None:
        verdict = "unknown"
    return {"value": value, "unit": unit, "threshold": threshold, "verdict": verdict, "frames": frames or []}


def said(entry: dict) -> str:
    """A measure in words: value, unit and threshold."""
    return "too little to measure" if entry["value"] is None else f"{entry['value']:.3g} {entry['unit']}".strip()


def decide(params: Params, facts: dict, measures: dict[str, dict]) -> tuple[dict[str, bool], list[str]]:
    """What training shall model, and why, in plain words; a setting of always or never wins over the measures."""
    points = measures["points"]["value"]
    moving = facts["verdict"] == "moving"
    iou, exposure = measures["body_fit"], measures["exposure_drift"]
    auto = {
        "scene": (
            moving and points >= MIN_POINTS,
            f"{points} points from a moving camera" if moving else f"{facts['verdict']}, so the clip shows no depth",
        ),
        "pose_refinement": (
            iou["verdict"] != "good",
            f"body and mask overlap {said(iou)}, good from {MIN_FIT_IOU}",
        ),
        "exposure": (
            exposure["verdict"] == "drifts",
            f"log gain {said(exposure)}, steps {said(measures['exposure_step'])}",
        ),
    }
    decisions, reasons = {}, []
    for name, (wanted, why) in auto.items():
        setting = getattr(params, name)
        decisions[name] = wanted if setting == "auto" else setting == "always"
        why = why if setting == "auto" else f"as set; measured: {why}"
        if name == "scene" and decisions[name] and not points:
            decisions[name], why = False, "asked for, but SfM left no points to start it from"
        reasons.append(f"{name.replace('_', ' ')} {'on' if decisions[name] else 'off'} ({why})")
    return decisions, reasons


def camera_measures(facts: dict, clip: Clip) -> dict[str, dict]:
    """Parallax, baseline against depth, reprojection error and lens shift; from sfm.json, in the clip's world."""
    import numpy as np

    from stages.avatar.cameras import camera_centers, project

    angle, error = facts.get("median_triangulation_deg"), facts.get("reprojection_px")
    shift = facts["distortion"]["max_shift_px"]
    ratio = None
    if len(clip.points):
        centers = camera_centers(clip.viewmats)
        depth = np.median([np.median(project(clip.points, view, K)[1]) for view, K in zip(clip.viewmats, clip.Ks)])
        reach = np.linalg.norm(centers - np.median(centers, 0), axis=1)
        ratio = float(2 * np.quantile(reach, 0.9) / depth)
    return {
        "camera_parallax": measure(
            angle, "deg", MIN_PARALLAX_DEG, "good" if angle and angle >= MIN_PARALLAX_DEG else "weak"
        ),
        "baseline": measure(ratio, "of the median depth", 0.05, "good" if ratio and ratio >= 0.05 else "short"),
        "reprojection": measure(
            error, "px", MAX_REPROJECTION_PX, "good" if error and error <= MAX_REPROJECTION_PX else "loose"
        ),
        "points": measure(len(clip.points), "", MIN_POINTS, "enough" if len(clip.points) >= MIN_POINTS else "too few"),
        "lens_distortion": measure(
            shift, "px", MAX_SHIFT_PX, "corrected by sfm" if shift > MAX_SHIFT_PX else "negligible"
        ),
    }


def exposure_measures(clip: Clip) -> dict[str, dict]:
    """Drift and largest step of the background's brightness, from the colours of SfM points outside the person."""
    import numpy as np

    from stages.avatar.cameras import project

    logs = np.full((len(clip.names), len(clip.points)), np.nan)
    for i in range(len(clip.names) if len(clip.points) else 0):
        pixels, z = project(clip.points, clip.viewmats[i], clip.Ks[i])
        logs[i] = point_logs(clip.images(i), clip.mask(i), pixels, z)
    gains = robust_gains(logs)
    seen = np.isfinite(gains)
    steps = np.abs(np.diff(gains[seen]))
    std = float(np.std(gains[seen])) if seen.sum() > 2 else None
    step = float(steps.max()) if len(steps) > 1 else None
    names = [name for name, there in zip(clip.names, seen) if there]
    worst = [names[i] for i in np.argsort(-np.abs(gains[seen]))[:3]] if std else []
    jump = [names[i + 1] for i in np.argsort(-steps)[:3]] if step else []
    drifts = std is not None and (std > EXPOSURE_STD or step > EXPOSURE_STEP)
    return {
        "exposure_drift": measure(std, "std of log gain", EXPOSURE_STD, "drifts" if drifts else "steady", worst),
        "exposure_step": measure(step, "log gain", EXPOSURE_STEP, "jumps" if drifts else "steady", jump),
    }


def point_logs(image: np.ndarray, mask: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Log brightness [P] of a frame at `pixels` [P,2]; NaN outside it, on the person, and where clipped or dark."""
    import cv2
    import numpy as np

    height, width = mask.shape
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.5)
    person = cv2.dilate(mask, np.ones((9, 9), np.uint8)) > 64
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
    x, y = np.where(inside[:, None], pixels, 0).astype(int).T
    value = grey[y, x]
    usable = inside & ~person[y, x] & (value > 20) & (value < 235)
    return np.where(usable, np.log(np.where(usable, value, 1.0)), np.nan)


def robust_gains(logs: np.ndarray) -> np.ndarray:
    """Log gain [F] of each frame from log brightness [F,P] with NaN gaps: medians in turn, the mean gain being 0.

    NaN for a frame with fewer than MIN_SAMPLES points. Median polish (Tukey 1977) copes with hidden points.
    """
    import numpy as np

    gains = np.full(len(logs), np.nan)
    enough = np.isfinite(logs).sum(1) >= MIN_SAMPLES
    logs = logs[enough]
    logs = logs[:, np.isfinite(logs).sum(0) >= 3]
    if not logs.size or (np.isfinite(logs).sum(1) == 0).any():
        return gains
    found = np.zeros(len(logs))
    for _ in range(10):
        level = np.nanmedian(logs - found[:, None], axis=0)
        found = np.nanmedian(logs - level, axis=1)
        found -= found.mean()
    gains[enough] = found
    return gains


def person_measures(clip: Clip) -> dict[str, dict]:
    """How much of the picture the person covers, and how well the posed body covers the person."""
    import numpy as np

    masks = [clip.mask(i) > 127 for i in range(len(clip.names))]
    coverage = np.array([mask.mean() for mask in masks])
    nobody = [name for name, share in zip(clip.names, coverage) if share == 0]
    median = float(np.median(coverage))
    usable = [i for i in range(len(masks)) if coverage[i] > 0 and clip.body.confidence[i] > 0]
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, FIT_FRAMES).astype(int))] if usable else []
    overlaps = np.array([overlap(drawn, masks[i]) for i, drawn in zip(chosen, outlines(clip, chosen))])
    iou = float(np.median(overlaps)) if chosen else None
    worst = [clip.names[chosen[i]] for i in np.argsort(overlaps)[:3]] if chosen else []
    return {
        "coverage": measure(median, "of the picture", MIN_COVERAGE, "good" if median >= MIN_COVERAGE else "small"),
        "frames_without_person": measure(len(nobody), "frames", 0, "some" if nobody else "none", nobody),
        "body_fit": measure(
            iou, "IoU of body and mask", MIN_FIT_IOU, "good" if iou and iou >= MIN_FIT_IOU else "loose", worst
        ),
    }


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boolean masks, 0 if both are empty."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def outlines(clip: Clip, chosen: list[int]) -> Any:
    """Boolean silhouettes [H,W] of the posed body in the frames `chosen`, one after the other."""
    import cv2
    import numpy as np
    import torch

    from stages.avatar.body import Body
    from stages.avatar.cameras import project

    body, poses = Body(clip.body_model), clip.body
    for i in chosen:
        rows = (torch.as_tensor(part[[i]]).float() for part in (poses.global_orient, poses.body_pose, poses.transl))
        with torch.no_grad():
            vertices, _ = body(torch.as_tensor(poses.betas).float(), *rows)
        pixels, z = project(vertices[0].double().numpy(), clip.viewmats[i], clip.Ks[i])
        drawn = np.zeros((clip.height, clip.width), np.uint8)
        faces = clip.body_model.faces[(z[clip.body_model.faces] > 0.05).all(1)]
        for triangle in np.round(np.clip(pixels, -1e4, 1e4)[faces] * 16 - 8).astype(np.int32):
            cv2.fillConvexPoly(drawn, triangle, 1, shift=4)
        yield drawn > 0
