"""What a body fit of a clip says of itself: notes and warnings for the user, and facts for smpl.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.contract import Job
from stages.estimators.bodyfit.metre import BY_BODY, Metre, stature_of
from stages.estimators.bodyfit.quality import FitQuality
from stages.estimators.words import listed
from stages.gestures import HandPoses
from stages.records import BodyModel, BodyPoses, Ground

STOCKY, EXTREME_BETA = (1.4, 2.15), 5.0  # m; a stature or shape outside these is worth a warning
FLOOR_SPREAD = 0.05  # of the scale, between the frames that agree on it best
BETTER = "look at them in the report; `--smpl-fit` takes a better fit"


@dataclass(frozen=True)
class Fitted:
    """One person's fit: `facts` are those of smpl.json; `hands` are None where the body has no fingers."""

    model: BodyModel
    poses: BodyPoses
    quality: FitQuality
    facts: dict[str, Any]
    hands: HandPoses | None = None


def warn_of_scale(job: Job, scale: dict[str, Any]) -> None:
    """Warn where the size of the person against the scene is hardly known, the plane below the feet is not theirs, or it slopes."""
    if "floor_refused" in scale:
        plane = f"{scale['floor_refused']:.3g} m per SfM unit, differing by {100 * scale['floor_spread']:.0f} %"
        job.warn(
            f"the person does not stand on the plane below their feet in the picture: it gives {plane}, the standing feet"
            f" give {scale['initial']:.3g}; is there a table, a stage, stairs, a jump or a moving board?"
        )
    if (slope := scale.get("floor_slope_degrees")) is not None:
        job.warn(f"the floor slopes by about {slope:.0f} degrees: the vertical is taken from camera and person instead")
    if scale["how"].startswith("not found"):
        job.warn("the person's scale in the scene is unknown: no floor below the feet and no standing foot was found")
    elif "floor_refused" not in scale and scale.get("floor_spread", 0) > FLOOR_SPREAD:
        job.warn(f"the feet meet the floor at scales that differ by {100 * scale['floor_spread']:.0f} %")


def select(names: Sequence[str], chosen: np.ndarray) -> list[str]:
    """The names where `chosen` bool [F] is true."""
    return [name for name, taken in zip(names, chosen, strict=True) if taken]


def report(job: Job, least: float, fit: Fitted, metre: Metre, looks: float) -> None:
    """Note how large the body is, how surely, and how well it fits; warn of doubtful poses, jumps and unusual shapes.

    Poses of less confidence than `least` are doubtful; without a given length the body `looks` so many m tall.
    """
    poses, quality = fit.poses, fit.quality
    stature, error, iou = stature_of(fit.model, poses), mean_known(quality.error_px), mean_known(quality.iou)
    parts = [f"body {stature:.2f} m tall, {poses.world_from_sfm:.4g} m per SfM unit"]
    parts += [f"landmarks {error:.1f} px off"] if error is not None else []
    parts += [f"outline IoU {iou:.2f}"] if iou is not None else []
    job.note(", ".join(parts))
    job.note(sureness(metre, looks))
    if doubtful := select(poses.names, quality.confidence < least):
        job.warn(f"the body's pose is doubtful in {count_names(doubtful)}: {BETTER}")
    if fast := fast_frames(poses, quality):
        job.warn(f"the body jumps at {count_names(fast)}: {BETTER}")
    odd = not metre.given and not STOCKY[0] < stature < STOCKY[1]
    if odd or np.abs(poses.betas).max() > EXTREME_BETA:
        job.warn(f"an unusual shape: {stature:.2f} m tall, betas up to {np.abs(poses.betas).max():.1f}")


def sureness(metre: Metre, looks: float) -> str:
    """How large a metre is, how surely, and for a body that `looks` so many m tall what that means."""
    sure = "" if metre.error is None else f" to +-{100 * metre.error:.0f} %"
    if metre.given:
        return f"a metre is known{sure}, {metre.how}; by its look the body was {looks:.2f} m tall"
    low, high = looks / (1 + BY_BODY), looks * (1 + BY_BODY)
    return f"a metre is known{sure} only: the body may be {low:.2f} to {high:.2f} m tall; `--height` sets it"


def report_ground(job: Job, ground: Ground) -> None:
    """Note how sure the floor is; warn where it is guessed."""
    sure = f"within {100 * ground.height_error:.1f} cm and {math.degrees(ground.tilt_error):.1f} degrees"
    if ground.points:
        job.note(f"floor: {ground.points} points of the scene lie in it, {sure}")
    else:
        job.warn(f"no floor is found in the scene under the person: it is guessed from the bodies, {sure}")


def summary(least: float, fit: Fitted) -> dict[str, Any]:
    """What smpl.json says about the result."""
    poses, quality = fit.poses, fit.quality
    each = zip(poses.names, quality.error_px, quality.iou, quality.confidence, strict=True)
    return {
        "body_model": fit.model.name,
        "world_from_sfm": poses.world_from_sfm,
        "stature_m": round(stature_of(fit.model, poses), 4),
        "betas": [round(float(b), 4) for b in poses.betas],
        "mean_error_px": mean_known(quality.error_px),
        "mean_iou": mean_known(quality.iou),
        "doubtful": select(poses.names, quality.confidence < least),
        "fast": fast_frames(poses, quality),
        "frames": {n: {"error_px": known(e), "iou": known(u), "confidence": known(c)} for n, e, u, c in each},
    }


def fast_frames(poses: BodyPoses, quality: FitQuality) -> list[str]:
    """The frames at which a joint turns faster than a person's can, each with the joint."""
    return [f"{name} ({joint})" for name, joint in zip(poses.names, quality.fast, strict=True) if joint]


def mean_known(values: np.ndarray) -> float | None:
    """The mean of those `values` that are finite, to 4 digits; None if none is."""
    finite = values[np.isfinite(values)]
    return round(float(finite.mean()), 4) if len(finite) else None


def known(value: float) -> float | None:
    """A value to 4 digits for JSON, None for one that is not finite."""
    return round(float(value), 4) if math.isfinite(value) else None


def count_names(names: list[str]) -> str:
    """How many frames, and the first of their names."""
    return f"{len(names)} frame{'s' if len(names) > 1 else ''}: {listed(names, 5)}"
