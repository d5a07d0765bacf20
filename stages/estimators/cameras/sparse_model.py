"""Writes points.ply and sparse/ of the sfm stage, without weak points and without points on the person."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.contract import Job
from stages.estimators.cameras import colmap
from stages.estimators.cameras.colmap import Cloud
from stages.formats import points
from stages.formats.datasets.undistorted import Grid
from stages.formats.images import read_mask, write_mask

PERSON = 64  # mask value from which a pixel counts as the person when features are looked for
DILATION = 0.01  # of the longer side: descriptors reach beyond their keypoint, and masks miss hair and hands
MIN_TRACK, MAX_ERROR = 3, 2.0  # pictures that must see a point; px it may be off on average
PERSON_SHARE = 0.8  # a point that falls on the person in more of its views than this is taken for the person's
FLAT = 0.02  # thickness over width of the points: below it focal length and depth are poorly fixed


@dataclass
class Pinholes:
    """The cameras of `names` with their lens distortion removed, whoever found them, and facts for sfm.json.

    `viewmats` [C,4,4]; `Ks` [C,3,3] px at the frames' size; `grid_of` says where to sample a frame, None where it stays
    as it is; `model` has the points that COLMAP made, `cloud` those of a given file.
    """

    verdict: str
    names: list[str]
    viewmats: np.ndarray
    Ks: np.ndarray
    grid_of: Callable[[str], Grid | None]
    facts: dict
    model: Any = None
    cloud: Cloud | None = None


def write_model(job: Job, found: Pinholes, size: tuple[int, int]) -> dict:
    """Write points.ply and sparse/, without weak points; numbers for sfm.json."""
    files = [f"{name}.png" for name in found.names]
    model = found.model or colmap.posed_model(files, found.viewmats, found.Ks, *size)
    cloud = found.cloud or colmap.cloud_of(model, files)
    keep, facts = write_points(job, found, cloud)
    if found.cloud is None:
        for i in cloud.ids[~keep]:
            model.delete_point3D(i)
    else:
        colmap.add_points(model, cloud, keep)
    (job.out / "sparse").mkdir()
    model.write_binary(job.out / "sparse")
    return facts


def write_points(job: Job, found: Pinholes, cloud: Cloud) -> tuple[np.ndarray, dict]:
    """Write points.ply without weak points: returns bool [P] of those kept, and facts for sfm.json.

    Where no given point is seen often enough, the file does not tell which are weak: some programs keep no tracks.
    """
    on_person, in_view = np.zeros(len(cloud.ids)), np.zeros(len(cloud.ids))
    for name, viewmat, K in zip(found.names, found.viewmats, found.Ks, strict=True) if len(cloud.ids) else ():
        mask = read_mask(job.out / "masks" / f"{name}.png")
        pixels, z = project(cloud.xyz, viewmat, K)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < mask.shape[::-1]).all(1)
        x, y = pixels[inside].astype(int).T
        in_view += inside
        on_person[inside] += mask[y, x] > 127
    short, loose = cloud.lengths < MIN_TRACK, cloud.errors > MAX_ERROR
    told = found.cloud is None or not short.all()
    if not told and len(short):
        job.note(f"{len(short)} given points, seen in fewer than {MIN_TRACK} pictures each: kept as they are")
        short[:] = False
    person = on_person > PERSON_SHARE * np.maximum(in_view, 1)
    keep = ~(short | loose | person)
    points.write_points(job.out / "points.ply", cloud.xyz[keep], cloud.rgb[keep])
    facts: dict = {
        "points": int(keep.sum()),
        "points_dropped": {"short_track": int(short.sum()), "error": int(loose.sum()), "on_person": int(person.sum())},
    }
    if not keep.any():
        return keep, facts
    sure = cloud.xyz[keep & (cloud.errors < MAX_ERROR)]
    if len(sure) > 3:  # three always lie on a plane
        spread = np.linalg.svd(sure - np.median(cloud.xyz, 0), compute_uv=False)
        flatness = float(spread[2] / max(spread[0], 1e-12))
        if flatness < FLAT:
            job.warn(
                f"the points lie on a plane (thickness {flatness:.3f} of their width): the focal length is uncertain"
            )
        facts["flatness"] = flatness
    measured = keep & (cloud.errors >= 0)  # COLMAP writes -1 for an error that nobody computed
    return keep, facts if not told else facts | {
        "reprojection_px": float(cloud.errors[measured].mean()) if measured.any() else None,
        "median_track": float(np.median(cloud.lengths[keep])),
        "median_triangulation_deg": float(np.median(cloud.angles[keep])),
    }


def write_ignored(names: list[str], masks: Path, out: Path, side: int) -> None:
    """Write COLMAP's masks, 0 = ignore: the person, made a little larger."""
    out.mkdir()
    reach = max(2, round(DILATION * side))
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))

    def write(name: str) -> None:
        person = (read_mask(masks / "masks" / f"{name}.png") >= PERSON).astype(np.uint8)
        write_mask(out / f"{name}.png", 255 * (1 - cv2.dilate(person, brush)))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, names))
