"""Checks whether the cameras of another program fit the frames: by feature matches, by the colours of given points, by stillness.

Cameras of other pictures of the same size (cropped, mirrored, of other frames) may fit nearly as well as true ones. So they are
compared with other WAYS to join them: true cameras fit far better as they are given than in any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.contract import Job, StageError
from stages.estimators.cameras import colmap, colmap_features
from stages.estimators.cameras.colmap import Cloud
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import Pinholes, write_ignored
from stages.estimators.cameras.stillness import ONE_WAY, measure_stillness
from stages.formats.images import evenly, read_image

MATCHES_OFF = 0.01  # of the longer side: matches farther from their epipolar lines contradict the cameras
MATCHES_ROUGH = 0.001  # of it: true cameras of `courtyard` and `kitchen` have 0.0001
COLORS_FIT = 0.6  # correlation of colours of points and frames: under it cameras are doubtful; true ones have 0.9
LOOKED_AT = 12  # frames in which the points' colours are compared
PAIRS = 100  # of frames whose matches are compared, about
UNLIKE = "they may belong to another clip, to cut or turned pictures, or count from another frame; or they are rough"
BETTER = 0.5  # of the misfit as given: a way that has less is the right one; of true cameras none has less than 3 times as much


@dataclass(frozen=True)
class Way:
    """A way to join cameras to frames: of frames `later` in the clip, which were scaled about their middle by `scale`."""

    words: str
    later: int = 0
    scale: tuple[float, float] = (1.0, 1.0)

    def cameras(self, found: Pinholes, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """camera_from_world [C,4,4] and K [C,3,3] px that the frames would have."""
        moved = np.diag([*self.scale, 1.0])
        moved[:2, 2] = (1 - np.array(self.scale)) * size / 2
        return np.roll(found.viewmats, -self.later, 0), moved @ np.roll(found.Ks, -self.later, 0)


WAYS = (
    Way("as given"),
    Way("if the frames were mirrored", scale=(-1, 1)),
    Way("if the frames were upside down", scale=(-1, -1)),
    *(Way("if the frames were enlarged cuts of their pictures", scale=(size, size)) for size in (1.1, 1.25)),
    *(Way("if their pictures were enlarged cuts of the frames", scale=(size, size)) for size in (0.9, 0.8)),
    *(
        Way(f"if each were of the frame {count} {where} (`--set sfm.cameras_from=0` or `=1`)", sign * count)
        for where, sign in (("before", 1), ("after", -1))
        for count in (1, 2, 3)
    ),
)


def better_way(misfits: list[float]) -> int:
    """Which of WAYS fits far better than as given, by the misfit of each; 0 if none does."""
    best = int(np.nanargmin(misfits))
    return best if misfits[best] < BETTER * misfits[0] else 0


def compare_stillness(job: Job, found: Pinholes, size: tuple[int, int], scratch: Path) -> None:
    """Warn where given cameras without points stand still and the film goes one way, or turn and the film's stands still."""
    write_ignored(found.names, job.out, scratch / "ignored", max(size))
    measured = measure_stillness(job.out / "images", scratch / "ignored", [f"{name}.png" for name in found.names])
    stands = found.verdict == "static camera"
    if measured is not None and stands != measured.still and (measured.still or measured.one_way > ONE_WAY):
        do = ("stand still", "moves") if stands else ("turn", "stands still")
        job.warn(f"the given cameras {do[0]}, and the film's {do[1]}: they may belong to another clip")


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
    found.facts |= {"verified_pairs": len(pairs), "epipolar_px": None}
    if not pairs:
        job.warn("no two frames match outside the person, so the given cameras could not be checked")
        return
    some = pairs[:: len(pairs) // PAIRS + 1]
    errors = [match_error(some, *way.cameras(found, size), math.hypot(*size)) for way in WAYS]
    found.facts["epipolar_px"] = errors[0]
    off, way = f"matched points lie {errors[0]:.1f} px off their epipolar lines (median)", better_way(errors)
    other = [f"{WAYS[way].words}, they would lie {errors[way]:.2f} px off"] if way else []
    if errors[0] > MATCHES_OFF * side:
        raise StageError(
            "the given cameras do not fit the frames",
            "check that they belong to this clip, that frame numbers count from the same frame (`--set "
            "sfm.cameras_from=0` or `=1`), and the axes: OpenGL's in transforms.json, OpenCV's in COLMAP and cameras.npz",
            [
                f"{off}; the limit is {MATCHES_OFF * side:.1f} px",
                f"{len(pairs)} pairs of frames were matched",
                *other,
            ],
        )
    if other or errors[0] > MATCHES_ROUGH * side:
        job.warn(f"the given cameras hardly fit the frames: {off}; {other[0] if other else UNLIKE}")
    found.model = colmap.triangulate(database, images, scratch / "model", files, found.viewmats, found.Ks, size)
    job.note(
        f"points by COLMAP from the given cameras; matches lie {errors[0]:.2f} px off their epipolar lines (median)"
    )


def match_error(pairs: list[Pair], viewmats: np.ndarray, Ks: np.ndarray, most: float) -> float:
    """Median distance in px, `most` at most, of matched points from their epipolar lines by the cameras.

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
    return min(float(np.median(np.concatenate(found))), most)


def compare_colors(job: Job, found: Pinholes, cloud: Cloud, size: tuple[int, int]) -> None:
    """Compare the colours of given points with the frames where they project; a note or a warning gives the result."""
    fits = color_agreement(job.out / "images", found, cloud, size)
    found.facts["colour_correlation"] = alike = fits[0] if fits else None
    if fits is None or alike is None:
        lacking = "colours" if any(map(len, cloud.tracks)) else "tracks"
        job.warn(f"the given points have no {lacking}, so the given cameras could not be checked")
    elif (way := better_way([1 - fit for fit in fits])) or alike < COLORS_FIT:
        other = f"{WAYS[way].words}, they would have them ({fits[way]:.2f})" if way else UNLIKE
        job.warn(
            "the given points have other colours than the frames where they project "
            f"(correlation {alike:.2f}, usual is 0.9): {other}"
        )
    else:
        job.note(f"{len(cloud.ids)} points as given; they have the frames' colours (correlation {alike:.2f})")


def color_agreement(images: Path, found: Pinholes, cloud: Cloud, size: tuple[int, int]) -> list[float] | None:
    """Correlation of the brightness of given points with the pixels they project to, in each of WAYS; None with too few or
    without contrast as given.

    Each point is compared in those of a few frames of `images` that its track lists.
    """
    point = np.repeat(np.arange(len(cloud.tracks)), [len(track) for track in cloud.tracks])
    frame = np.concatenate([*cloud.tracks, np.zeros(0, np.int64)])
    cameras, seen_at = [way.cameras(found, size) for way in WAYS], [[np.zeros((2, 0))] for _ in WAYS]
    for i in evenly(len(found.names), LOOKED_AT):
        image = read_image(images / f"{found.names[i]}.png").astype(np.float64).mean(2)
        for way, (viewmats, Ks), both in zip(WAYS, cameras, seen_at, strict=True):
            seen = point[frame == (i + way.later) % len(found.names)]
            pixels, z = project(cloud.xyz[seen], viewmats[i], Ks[i])
            inside = (z > 0) & (pixels >= 0).all(1) & (pixels < image.shape[::-1]).all(1)
            x, y = pixels[inside].astype(int).T
            both.append(np.stack([image[y, x], cloud.rgb[seen][inside].mean(1)]))
    fits = [_correlation(np.concatenate(both, axis=1)) for both in seen_at]
    return None if fits[0] is None else [-1.0 if fit is None else fit for fit in fits]


def _correlation(both: np.ndarray) -> float | None:
    """Of two rows [2,N]; None with too few or without contrast."""
    return float(np.corrcoef(both)[0, 1]) if both.shape[1] > 1 and (both.std(1) >= 1).all() else None
