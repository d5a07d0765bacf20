"""Picks the masked person among the people that a tool found: the one whose outline lies on the masks."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.contract import StageError
from stages.estimators.bodyfit.placing import place_in_world
from stages.formats.given_fits.record import SmplFit
from stages.records import BodyModel, Cameras

EVERY = 10  # of the body's vertices, enough for its hull
SIDE = 200  # px of the longer side at which hulls are compared
SPECK = 0.05  # of a mask's area; smaller pieces do not count
NOWHERE = 0.1  # mean overlap under which a fit is of something else


def choose_person(
    fit: SmplFit, frames: np.ndarray, cameras: Cameras, masks: list[np.ndarray], model: BodyModel
) -> tuple[SmplFit, np.ndarray, dict[str, Any]]:
    """The fit with one row a frame, of the track that lies best on the masks; its frames [M]; facts for smpl.json.

    `frames` [N] is the camera of each row. A track scores the sum over its frames, so a person who is followed for long
    wins over a passer-by. StageError if nobody is where the masks are.
    """
    overlap = overlaps(fit, frames, cameras, masks, model)
    tracks = np.array(fit.tracks if fit.tracks is not None else [""] * len(fit))
    best: dict[str, dict[int, int]] = {}
    for row in np.argsort(np.nan_to_num(overlap, nan=-1.0), kind="stable"):
        best.setdefault(str(tracks[row]), {})[int(frames[row])] = int(row)  # the best row of a frame comes last
    score = {track: float(np.nansum(overlap[list(rows.values())])) for track, rows in best.items()}
    chosen = max(sorted(score), key=lambda track: (score[track], len(best[track])))
    rows = [best[chosen][frame] for frame in sorted(best[chosen])]
    mean = {track: _mean(overlap[list(kept.values())]) for track, kept in best.items()}
    most = mean[chosen]
    if most is not None and most < NOWHERE:
        facts = [f"the best of {len(best)} overlaps the masks by {100 * most:.0f} %, in {len(rows)} frames"]
        hint = "is it of this video, frame by frame, and in the camera's axes (x right, y down, z forward)?"
        raise StageError(f"the bodies of {fit.path} do not lie on the masks", hint, facts)
    found = {"tool": fit.tool, "person": chosen, "overlap": most, "people": mean}
    return fit.rows(rows), frames[rows], found


def overlaps(
    fit: SmplFit, frames: np.ndarray, cameras: Cameras, masks: list[np.ndarray], model: BodyModel
) -> np.ndarray:
    """Intersection over union [N] of the hulls of each row's body and of its frame's mask; NaN where the mask is empty."""
    names = tuple(cameras.names[i] for i in frames)
    poses = place_in_world(fit, names, cameras.viewmats[frames], cameras.Ks[frames], model, 1.0)
    body = Body(model).subset(torch.arange(0, len(model.v_template), EVERY))
    zero = np.zeros((len(fit), 3))
    parts = (poses.betas, poses.global_orient, poses.body_pose, zero)
    vertices = body(*(torch.tensor(part, dtype=torch.float32) for part in parts))[0].double().numpy()
    vertices = vertices + poses.transl[:, None]
    pixels, z = project(vertices, rescale_viewmats(cameras.viewmats[frames], poses.world_from_sfm), cameras.Ks[frames])
    ratio = min(1.0, SIDE / max(cameras.width, cameras.height))
    shape = (max(1, round(cameras.height * ratio)), max(1, round(cameras.width * ratio)))
    hulls = {i: _mask_hull(masks[i], shape) for i in set(frames.tolist())}
    result = np.full(len(fit), np.nan)
    for row, frame in enumerate(frames):
        mask = hulls[frame]
        if mask.any():
            shown = (z[row] > 0) & np.isfinite(pixels[row]).all(-1)
            drawn = _hull(pixels[row][shown] * ratio, shape)
            result[row] = (drawn & mask).sum() / (drawn | mask).sum()
    return result


def _mask_hull(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The convex hull of the mask, shrunk to bool `shape`, without specks."""
    small = (cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)
    _, labels, facts, _ = cv2.connectedComponentsWithStats(small)
    sizes = facts[1:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero(sizes >= SPECK * sizes.sum())
    return _hull(np.argwhere(np.isin(labels, kept))[:, ::-1] + 0.5, shape)


def _hull(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The convex hull of `points` [N,2] px drawn into bool `shape`."""
    canvas = np.zeros(shape, np.uint8)
    if len(points):
        bounded = np.clip(points, -4 * max(shape), 4 * max(shape)).astype(np.float32)
        cv2.fillConvexPoly(canvas, np.rint(cv2.convexHull(bounded) * 16 - 8).astype(np.int32), 1, shift=4)
    return canvas.astype(bool)


def _mean(values: np.ndarray) -> float | None:
    known = values[~np.isnan(values)]
    return round(float(known.mean()), 4) if len(known) else None
