"""Checks whether the cameras of another program fit the frames: by feature matches, or by the colours of given points."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.contract import Job, StageError
from stages.estimators.cameras import colmap, colmap_features
from stages.estimators.cameras.colmap import Cloud
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import Pinholes, write_ignored
from stages.formats.images import read_image

MATCHES_OFF = 0.01  # of the longer side: matches farther from their epipolar lines contradict the cameras
COLORS_FIT = 0.5  # correlation of colours of points and frames: under it cameras are doubtful; true ones have 0.9
LOOKED_AT = 12  # frames in which the points' colours are compared


def triangulate(job: Job, found: Pinholes, size: tuple[int, int], features: int, scratch: Path) -> None:
    """Triangulate points for given cameras without points; StageError if the frames' matches contradict the cameras.

    Takes about `features` SIFT features a frame from the undistorted images/ and masks/ in `job.out`.
    """
    job.progress(0, 100)
    files, database, side = [f"{name}.png" for name in found.names], scratch / "database.db", max(size)
    images, shared = job.out / "images", bool((found.Ks == found.Ks[0]).all())
    write_ignored(found.names, job.out, scratch / "ignored", side)
    first = colmap.pinhole_params(found.Ks[0])
    colmap_features.extract(database, images, scratch / "ignored", files, features, first, "PINHOLE", shared)
    if not shared:
        colmap_features.set_pinholes(database, found.Ks)
    colmap_features.match(database, len(files).bit_length(), growing=True, side=side)
    pairs, _ = colmap_features.read_pairs(database, files)
    error = match_error(pairs, found.viewmats, found.Ks, math.hypot(*size))
    found.facts |= {"verified_pairs": len(pairs), "epipolar_px": error}
    if error is None:
        job.warn("no two frames match outside the person, so the given cameras could not be checked")
        return
    if error > MATCHES_OFF * side:
        raise StageError(
            "the given cameras do not fit the frames",
            "check that they belong to this clip, that frame numbers count from the same frame (`--set "
            "sfm.cameras_from=0` or `=1`), and the axes: OpenGL's in transforms.json, OpenCV's in COLMAP and cameras.npz",
            [
                f"matched points lie {error:.1f} px off their epipolar lines (median); the limit is {MATCHES_OFF * side:.1f} px",
                f"{len(pairs)} pairs of frames were matched",
            ],
        )
    found.model = colmap.triangulate(database, images, scratch / "model", files, found.viewmats, found.Ks, size)
    job.note(f"points by COLMAP from the given cameras; matches lie {error:.2f} px off their epipolar lines (median)")


def match_error(pairs: list[Pair], viewmats: np.ndarray, Ks: np.ndarray, most: float) -> float | None:
    """Median distance in px, `most` at most, of matched points from their epipolar lines by the cameras; None without matches.

    Source: Hartley and Zisserman, Multiple View Geometry, eq. 9.1 for F and eq. 11.9 for the first-order distance.
    """
    found = []
    for pair in pairs:
        relative = viewmats[pair.second] @ np.linalg.inv(viewmats[pair.first])
        x, y, z = relative[:3, 3]
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
        F = np.linalg.inv(Ks[pair.second]).T @ essential @ np.linalg.inv(Ks[pair.first])
        a, b = (np.c_[points, np.ones(len(points))] for points in (pair.a, pair.b))
        line_b, line_a = a @ F.T, b @ F
        slope = np.sqrt((line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1))
        found.append(np.abs((b * line_b).sum(1)) / np.maximum(slope, 1e-300))
    return min(float(np.median(np.concatenate(found))), most) if found else None


def compare_colors(job: Job, found: Pinholes, cloud: Cloud) -> None:
    """Compare the colours of given points with the frames where they project; a note or a warning gives the result."""
    alike = color_agreement(job.out / "images", found, cloud)
    found.facts["colour_correlation"] = alike
    if alike is None:
        lacking = "colours" if any(map(len, cloud.tracks)) else "tracks"
        job.warn(f"the given points have no {lacking}, so the given cameras could not be checked")
    elif alike < COLORS_FIT:
        job.warn(
            f"the given points have other colours than the frames where they project (correlation {alike:.2f}, usual is "
            "0.9): the cameras may belong to another clip, or their frame numbers may count from another frame"
        )
    else:
        job.note(f"{len(cloud.ids)} points as given; they have the frames' colours (correlation {alike:.2f})")


def color_agreement(images: Path, found: Pinholes, cloud: Cloud) -> float | None:
    """Correlation of the brightness of given points with the pixels they project to; None with too few or without contrast.

    Each point is compared in those of a few frames of `images` that its track lists.
    """
    seen_at = []
    point = np.repeat(np.arange(len(cloud.tracks)), [len(track) for track in cloud.tracks])
    frame = np.concatenate([*cloud.tracks, np.zeros(0, np.int64)])
    for i in np.unique(np.linspace(0, len(found.names) - 1, LOOKED_AT).round().astype(int)):
        seen = point[frame == i]
        image = read_image(images / f"{found.names[i]}.png").astype(np.float64).mean(2)
        pixels, z = project(cloud.xyz[seen], found.viewmats[i], found.Ks[i])
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < image.shape[::-1]).all(1)
        x, y = pixels[inside].astype(int).T
        seen_at.append(np.stack([image[y, x], cloud.rgb[seen][inside].mean(1)]))
    both = np.concatenate(seen_at, axis=1)
    if both.shape[1] < 2 or (both.std(1) < 1).any():
        return None
    return float(np.corrcoef(both)[0, 1])
