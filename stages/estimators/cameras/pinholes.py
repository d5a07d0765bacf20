"""Solved cameras with their lens replaced by a pinhole, and what is said of its focal length."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from stages.avatar.cameras import lens
from stages.avatar.cameras.pinhole import pinhole
from stages.estimators.cameras import colmap
from stages.estimators.cameras.sparse_model import Pinholes
from stages.estimators.cameras.task import GUESSED_FOCAL, Solution, Task
from stages.formats.datasets.undistorted import HELD, Grid


def pinholes_of(task: Task, solution: Solution, undistort: Literal["auto", "always", "never"]) -> Pinholes:
    """The pinhole cameras of a solution, and the grids that remove its lens: where it moves pixels visibly, or as said.

    Also makes the solution's model one of pinholes.
    """
    k, center, size = solution.k, np.array(solution.center), task.size
    own = solution.focals.tolist()
    shift = 0.0  # of "never": as if there were no lens, and sfm.json says so
    if undistort != "never":
        shift = max(lens.max_shift(focal, k, *size) for focal in set(own))
    bends = undistort == "always" or shift >= lens.NO_SHIFT
    made = {focal: lens.pinhole_focal(focal, center, k, *size) if bends else focal for focal in set(own)}
    focals, focal_of = [made[focal] for focal in own], dict(zip(solution.names, own, strict=True))

    @lru_cache(HELD)
    def grid(focal: float) -> Grid:
        return lens.remap_grid(focal, center, k, made[focal], *size)

    def grid_of(name: str) -> Grid | None:
        return grid(focal_of[name]) if bends else None

    if solution.model is not None:
        colmap.make_pinhole(solution.model, dict(zip([f"{name}.png" for name in solution.names], focals, strict=True)))
    facts = {
        "focal_px": float(np.median(solution.focals)),
        "focal_source": focal_source(task, solution),
        "pinhole_focal_px": float(np.median(focals)),
        "distortion": {"model": "SIMPLE_RADIAL", "params": [k], "max_shift_px": shift},
        **solution.facts,
    }
    Ks = np.array([pinhole(focal, *size) for focal in focals])
    return Pinholes(solution.verdict, solution.names, solution.viewmats, Ks, grid_of, facts, solution.model)


def focal_source(task: Task, solution: Solution) -> str:
    """Where the focal length is from: given, file, estimated or guessed; a warning says the last, a note how sure it is."""
    focal, source = float(np.median(solution.focals)), "given" if task.focal else "estimated"
    if task.focal is None and solution.verdict == "static camera":
        source = "file" if task.told else "guessed"
    if source == "guessed":
        task.job.warn(
            f"the focal length is a guess ({focal:.0f} px, {GUESSED_FOCAL} x the longer side); "
            "if you know it, give it with --set sfm.focal=PX"
        )
    if task.focal is None and (spread := solution.facts.get("lens", {}).get("focal_spread_px")):
        task.job.note(f"focal length {focal:.0f} px, give or take {spread:.0f}")
    return source
