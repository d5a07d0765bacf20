"""A camera that zooms while filming, or reads its rows one after the other: seen, modelled, and said.

COLMAP's camera has one focal length and one moment a picture, and makes of either a wrong focal length and a bent lens at
a small error. So a few hundred points are asked first whether a camera that may do both explains them much better.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from stages.contract import Job
from stages.estimators.cameras import colmap_lens
from stages.estimators.cameras.adjustment import Adjusted, Bundle, adjust
from stages.estimators.cameras.colmap import Model
from stages.estimators.cameras.intrinsics import Prior, spreads

KNOTS = 7  # of the focal length over the clip
ASKED, KEPT = 800, 4000  # points, those seen longest: to see whether the camera changes, and to model it
LOOK = 4  # rounds that tell whether it does
WORTH = 0.05  # of the cost: clips without either win 0.001, a phone's weak rolling shutter 0.01, strong ones 0.5
ZOOMS = 0.03  # of the focal length, between its shortest and longest
SIGMAS = 4.0


def model_changes(
    job: Job, model: Model, width: int, height: int, prior: Prior
) -> tuple[Model, dict[str, float]] | None:
    """The model anew with a focal length for each frame or with rows that have their own time, and facts for sfm.json.

    None where the camera does neither, or too little to tell. `prior` is what is known of the focal length.
    """
    size = (width, height)
    start, seen, _ = colmap_lens.bundle_of(model.reconstruction, size, ASKED)

    def asked(knots: int, rolls: bool) -> Adjusted:
        return adjust(_with(start, knots), seen, rolls, prior.focal, prior.spread, LOOK)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        plain, free = pool.map(asked, (1, KNOTS), (False, True))
    if free.cost > (1 - WORTH) * plain.cost:
        return None
    start, seen, points = colmap_lens.bundle_of(model.reconstruction, size, KEPT)
    free = adjust(_with(start, KNOTS), seen, True, prior.focal, prior.spread)
    sigmas = np.sqrt(np.diag(free.covariance))
    apart, rolls = np.ptp(free.bundle.log_focal), abs(free.bundle.readout) > SIGMAS * sigmas[-1]
    zooms = apart > max(ZOOMS, SIGMAS * sigmas[:KNOTS].max())
    if not zooms and not rolls:
        return None
    found = adjust(_with(free.bundle, KNOTS if zooms else 1, rolls), seen, bool(rolls), prior.focal, prior.spread)
    facts = spreads(found, max(size))
    focals, readout = found.bundle.focals, found.bundle.readout
    if zooms:
        facts |= {"first_focal_px": round(focals[0], 3), "last_focal_px": round(focals[-1], 3)}
        job.note(
            f"the camera zooms while filming, from {focals[0]:.0f} to {focals[-1]:.0f} px: each frame has its own focal length"
        )
    if rolls:
        facts["readout"] = round(readout, 4)
        job.note(
            f"the camera reads its rows one after the other, in {abs(readout):.2f} of the time between two frames "
            "(rolling shutter): a frame's camera is that of its middle row"
        )
    files = sorted(f"{name}.png" for name in model.poses)
    colors = np.array([model.reconstruction.points3D[i].color for i in points])
    return Model(colmap_lens.model_of(files, colors, found.bundle, seen)), facts


def _with(bundle: Bundle, knots: int, rolls: bool = False) -> Bundle:
    """The bundle with its mean focal length at so many knots, or as it is with as many; no readout unless it `rolls`."""
    log_focal = bundle.log_focal if len(bundle.log_focal) == knots else np.full(knots, bundle.log_focal.mean())
    return Bundle(bundle.viewmats, bundle.points, log_focal, bundle.k, bundle.readout if rolls else 0.0)
