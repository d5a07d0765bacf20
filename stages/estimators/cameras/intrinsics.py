"""Focal length and lens as evidence: how well the clip fixes them, and what cameras have where it does not.

A small reprojection error is no proof: where the camera hardly travels, a longer focal length and a bent lens explain the
frames as well. So what SfM found is weighed against what phones and cameras have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.avatar.cameras import lens
from stages.contract import Job
from stages.estimators.cameras import colmap_lens
from stages.estimators.cameras.adjustment import Adjusted
from stages.estimators.cameras.colmap import Model

USUAL_FOCAL, FOCAL_SPREAD = 0.85, 0.35  # of the longer side, and of its logarithm: 24 mm to 85 mm lie within two of it
K_SPREAD = 0.02  # phones and cameras straighten their films; what is left is small
TRACK_ERROR = 0.001  # of the longer side: tracks drift together, so a lens is known no better than by points so far off
# px of bend, and share of the focal length: lenses that differ by less take the same pictures
CORNERS, FOCAL = 1.0, 0.01
DOUBT = 2.0  # spreads of k: a weaker lens is taken for none


@dataclass(frozen=True)
class Intrinsics:
    """Focal length in px and k of a SIMPLE_RADIAL lens, with standard deviations."""

    focal: float
    k: float
    focal_spread: float
    k_spread: float

    def same_pictures(self, other: Intrinsics, width: int, height: int) -> bool:
        """Whether both lenses take nearly the same pictures."""
        bent = [lens.max_shift(one.focal, one.k, width, height) for one in (self, other)]
        return abs(bent[0] - bent[1]) < CORNERS and abs(self.focal / other.focal - 1) < FOCAL


@dataclass(frozen=True)
class Prior:
    """What is known of a focal length (px) before the frames are seen: `spread` of its logarithm, and from where."""

    focal: float
    spread: float
    words: str

    @property
    def said(self) -> str:
        """In words for the user."""
        return f"{self.focal:.0f} px, give or take {self.focal * self.spread:.0f} ({self.words})"


def usual(side: int) -> Prior:
    """What phones and cameras have, for frames of `side` px at the longer side."""
    return Prior(USUAL_FOCAL * side, FOCAL_SPREAD, "what phones and cameras have")


def weigh(focal: float, k: float, covariance: np.ndarray, side: int, prior: Prior) -> Intrinsics:
    """The most likely lens, of what SfM found and of what was known before.

    `covariance` [2,2] of focal length (px) and k for points 1 px off; `side` px is the frames' longer one. Both are normal
    distributions, of the focal length's logarithm and k (Bishop, Pattern Recognition and Machine Learning, eq. 2.116).
    Raises ValueError for a covariance that is not one.
    """
    scale = np.diag([1 / focal, 1.0])
    seen = scale @ covariance @ scale * (TRACK_ERROR * side) ** 2
    if not np.isfinite(seen).all() or (np.linalg.eigvalsh(seen) <= 0).any():
        raise ValueError(f"no covariance: {covariance.tolist()}")
    found, before = np.array([np.log(focal), k]), np.array([np.log(prior.focal), 0.0])
    evidence, known = np.linalg.inv(seen), np.diag([1 / prior.spread**2, 1 / K_SPREAD**2])
    left = np.linalg.inv(evidence + known)
    likely, spread = left @ (evidence @ found + known @ before), np.sqrt(np.diag(left))
    best = float(np.exp(likely[0]))
    return Intrinsics(best, float(likely[1]), best * float(spread[0]), float(spread[1]))


def spreads(found: Adjusted, side: int) -> dict[str, float]:
    """Standard deviations of the mean focal length in px and of k, itself and 1 at most: tracks drift together, as in `weigh`."""
    drift = max(TRACK_ERROR * side / found.noise, 1.0)
    knots = len(found.bundle.log_focal)
    of_log = np.sqrt(found.covariance[:knots, :knots].mean()) * drift
    focal = float(np.median(found.bundle.focals))
    k_spread = np.sqrt(found.covariance[knots, knots]) * drift
    of_focal, of_k = np.fmin([focal * of_log, k_spread], [focal, 1.0]).tolist()
    return {"focal_spread_px": round(of_focal, 3), "k_spread": round(of_k, 5)}


def compare_halves(model: Model, likely: Intrinsics) -> dict[str, float]:
    """A spread that has in it half of what the focal lengths of the clip's halves are apart, for sfm.json."""
    halves = colmap_lens.half_focals(model.reconstruction)
    if halves is None:
        return {}
    spread = np.fmin(np.hypot(likely.focal_spread, (halves[0] - halves[1]) / 2), likely.focal)
    return {"focal_spread_px": round(float(spread), 3)}


def settle(job: Job, model: Model, width: int, height: int, prior: Prior | None = None) -> dict[str, float]:
    """Pull a lens that the model hardly fixes toward the prior, and adjust the model; facts for sfm.json.

    Without a prior it is what cameras have. A model that fixes its lens so well that both take the same pictures is not
    changed, except that a distortion within its error becomes none: the focal length is then known better.
    """
    camera = next(iter(model.reconstruction.cameras.values()))
    focal, _, _, k = (float(value) for value in camera.params)
    side = max(width, height)
    prior = prior or usual(side)
    covariance = colmap_lens.lens_covariance(model.reconstruction)
    try:
        likely = weigh(focal, k, np.full((2, 2), np.nan) if covariance is None else covariance, side, prior)
    except ValueError:
        job.warn(f"how well the clip fixes the focal length could not be computed; it is taken as {focal:.0f} px")
        return {}
    facts = {"focal_spread_px": round(likely.focal_spread, 3), "k_spread": round(likely.k_spread, 5)}
    facts |= compare_halves(model, likely)
    told = likely.same_pictures(replace(likely, focal=focal, k=k), width, height)
    if told and abs(k) >= DOUBT * likely.k_spread:
        return facts
    bent = lens.max_shift(focal, k, width, height)
    if told:
        colmap_lens.straighten(model.reconstruction)
        job.note(f"no lens distortion: {bent:.2f} px at the corners is within its error")
    else:
        colmap_lens.hold_lens(model.reconstruction, likely.focal, likely.k)
        job.warn(
            f"the clip hardly fixes its focal length: {likely.focal:.0f} px is likely, give or take {likely.focal_spread:.0f}; "
            f"SfM alone gave {focal:.0f} px, with a distortion of {bent:.1f} px at the corners. "
            "If you know it, give it with --set sfm.focal=PX"
        )
    return facts | {"free_focal_px": focal, "free_k": k}
