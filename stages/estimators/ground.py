"""The floor on which a person stood: a plane through the scene under their soles or, where none shows, what bodies tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stages.estimators.bodyfit.gravity import camera_up, trunk_up
from stages.records import Ground

STEEPEST = np.cos(np.radians(30))  # between the floor's normal and what is up for the cameras or the bodies
NEAR = 1.5  # m from where they stood: there the plane is sought
REACHES = (0.8, 0.8, 1.6, 1.6, 3.2, 3.2, 4.0, 4.0)  # m: and so far it is widened
THICK = 0.03  # m from the plane up to which a thing belongs to it
CELL, PATCH = 0.1, 0.3  # m: one height is taken for each cell; errors of the scene's depth are alike within a patch
FEW = 25  # cells that make a floor
LIFTED = 0.1  # m that the soles of the median frame may stand off the plane
TRIALS = 2000
LEANING, PRESSED = np.radians(8), 0.03  # rad and m: how far people lean, and how far fitted soles are off the floor


@dataclass(frozen=True)
class Plane:
    """A floor: `normal` [3] upwards and `offset`, the height of x being normal . x + offset; `members` things lie in it.

    `height_error` m where people stood and `tilt_error` rad are one standard deviation.
    """

    normal: np.ndarray
    offset: float
    members: int = 0
    height_error: float = np.inf
    tilt_error: float = np.inf

    def height(self, x: np.ndarray) -> np.ndarray:
        """Heights of x [...,3], in the same unit as the offset."""
        return x @ self.normal + self.offset


def best_plane(
    things: np.ndarray,
    ups: np.ndarray,
    thick: float,
    trust: np.ndarray,
    stands: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Plane | None:
    """The plane square to one of `ups` [U,3] with most `trust` [N] in the `things` [N,3] up to `thick` away; RANSAC, seeded.

    Of planes through three things, only those count for which `stands(normals [T,3], offsets [T])` is true. None if none does.
    """
    rng = np.random.default_rng(0)
    triples = things[np.stack([rng.choice(len(things), 3, replace=False) for _ in range(TRIALS)])]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(length > 0, length, 1)[:, None]
    normals *= np.where(normals @ ups[0] < 0, -1, 1)[:, None]
    offsets = -(normals * triples[:, 0]).sum(1)
    fair = (length > 0) & (normals @ ups.T > STEEPEST).any(1)
    if stands is not None:
        fair &= stands(normals, offsets)
    if not fair.any():
        return None
    normals, offsets = normals[fair], offsets[fair]
    best = ((np.abs(things @ normals.T + offsets) < thick) * trust[:, None]).sum(0).argmax()
    return Plane(normals[best], float(offsets[best]))


def find_ground(
    things: np.ndarray,
    soles: np.ndarray,
    turns: np.ndarray,
    pelvis: np.ndarray,
    turn: np.ndarray,
    viewmats: np.ndarray,
    metres: float,
) -> Ground:
    """The floor under a person, or several, in their world of metres; `metres` per SfM unit is only handed on.

    `things` [N,3] m are solid parts of the scene; of F frames that show somebody `soles` [F,P,3] m are points of their
    soles, `turns` [F,3,3] how the body is turned; `pelvis` [3] m and `turn` [3,3] are where the first person stood and looked
    in the middle of the clip; `viewmats` [C,4,4] in metres. Where the scene has no floor under the soles, bodies over all frames
    and the way people hold cameras tell it.
    """
    held, held_error = camera_up(viewmats)
    ups = np.stack([held, trunk_up(turns[:, :, 1], held)])
    plane, how = plane_of_scene(things, soles, ups), "a plane through the scene under the soles"
    if plane is None:
        plane, how = (
            plane_of_bodies(soles, ups, held_error),
            "guessed from the bodies: the scene shows no floor under them",
        )
    up = plane.normal
    ahead = turn[:, 2]
    ahead = ahead - up * (ahead @ up)
    return Ground(
        point=pelvis - up * plane.height(pelvis),
        up=up,
        ahead=ahead / np.linalg.norm(ahead),
        metres=metres,
        height_error=plane.height_error,
        tilt_error=plane.tilt_error,
        points=plane.members,
        how=how,
    )


def plane_of_scene(things: np.ndarray, soles: np.ndarray, ups: np.ndarray) -> Plane | None:
    """The plane of `things` [N,3] m on which the lowest of `soles` [F,P,3] m stand, square to one of `ups` [U,3].

    The `best_plane` near the soles is widened and fitted to the median height of each cell (Tukey's weights). None where it
    has under FEW cells.
    """
    lowest = np.take_along_axis(soles, (soles @ ups[0]).argmin(1)[:, None, None], 1)[:, 0]
    place = np.median(lowest, 0)
    cells = _thinned(things[np.linalg.norm(things - place, axis=1) < NEAR])
    if len(cells) < FEW:
        return None

    def stands(normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        return np.abs(np.median((soles @ normals.T).min(1), 0) + offsets) < LIFTED

    plane = best_plane(cells, ups, THICK, np.ones(len(cells)), stands)
    for reach in REACHES:
        plane = plane and _fitted(things, plane, place, reach)
    if plane is None or abs(np.median(plane.height(soles).min(1))) > LIFTED:
        return None
    return plane if (ups @ plane.normal > STEEPEST).any() else None


def plane_of_bodies(soles: np.ndarray, ups: np.ndarray, held_error: float) -> Plane:
    """What is left without a scene: the lowest soles [F,P,3] m lie on the floor, cameras are held and people stand upright.

    `ups` [2,3]: of the cameras, true to `held_error` rad, and of the bodies. Least squares for tilt and height; soles of one
    place count once, and those that are lifted little (Tukey's weights).
    """
    certain = np.array([held_error, LEANING]) ** -2.0
    first = certain @ ups
    first /= np.linalg.norm(first)
    low = np.take_along_axis(soles, (soles @ first).argmin(1)[:, None, None], 1)[:, 0]
    place = np.median(low, 0)
    axes = _axes(first)
    at, heights = (low - place) @ axes[:, :2], (low - place) @ first
    square = np.floor(at / 0.2).astype(int)
    _, which, alike = np.unique(square, axis=0, return_inverse=True, return_counts=True)
    once = 1 / alike[which.ravel()]
    leans = ups @ axes[:, :2] / (ups @ first)[:, None]  # a plane across such an up falls by this much a metre
    terms = np.c_[at, np.ones(len(at))]
    solution = np.array([0, 0, np.median(heights)])
    for doubt in np.geomspace(1.0, 4 * PRESSED, 20):  # m: a first guess may be far off, the last is sure
        weight = once * _tukey((heights - terms @ solution) / doubt) / PRESSED**2
        information = (terms * weight[:, None]).T @ terms + np.diag([certain.sum(), certain.sum(), 0])
        information[2, 2] += 1e-9
        right = (terms * weight[:, None]).T @ heights - np.r_[certain @ leans, 0]
        solution = np.linalg.solve(information, right)
    covariance = np.linalg.inv(information)
    return _plane(solution, axes, place, covariance)


def _fitted(things: np.ndarray, plane: Plane, place: np.ndarray, reach: float) -> Plane | None:
    """The plane fitted to the things in it up to `reach` m from `place`; None where they are too few."""
    axes = _axes(plane.normal)
    origin = place - plane.normal * plane.height(place)
    at, heights = (things - origin) @ axes[:, :2], (things - origin) @ plane.normal
    kept = (np.hypot(*at.T) < reach) & (np.abs(heights) < 2 * THICK)
    at, heights = at[kept], heights[kept]
    cell, which = np.unique(np.floor(at / CELL).astype(int), axis=0, return_inverse=True)
    if len(cell) < FEW:
        return None
    order = np.lexsort((heights, which.ravel()))
    starts = np.r_[np.flatnonzero(np.diff(which.ravel()[order], prepend=-1)), len(order)]
    middle = order[(starts[:-1] + starts[1:] - 1) // 2]
    terms, heights = np.c_[at[middle], np.ones(len(middle))], heights[middle]
    solution = np.zeros(3)
    for _ in range(10):
        weight = _tukey((heights - terms @ solution) / THICK)
        information = (terms * weight[:, None]).T @ terms
        if weight.sum() < FEW or np.linalg.cond(information) > 1e8:
            return None
        solution = np.linalg.solve(information, (terms * weight[:, None]).T @ heights)
    left = heights - terms @ solution
    spread = (weight * left**2).sum() / weight.sum()
    covariance = np.linalg.inv(information) * spread * (PATCH / CELL) ** 2
    found = _plane(solution, axes, origin, covariance)
    return replace(found, members=int((np.abs(found.height(things[kept])) < THICK).sum()))


def _plane(solution: np.ndarray, axes: np.ndarray, origin: np.ndarray, covariance: np.ndarray) -> Plane:
    """The plane that rises by solution [0] and [1] a metre along `axes`, [2] m over `origin`, with the `covariance` of these."""
    normal = axes[:, 2] - axes[:, :2] @ solution[:2]
    normal /= np.linalg.norm(normal)
    tilt = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    offset = float(-normal @ (origin + solution[2] * axes[:, 2]))
    return Plane(normal, offset, 0, float(np.sqrt(covariance[2, 2])), float(tilt))


def _axes(up: np.ndarray) -> np.ndarray:
    """A rotation [3,3] whose third column is `up`."""
    across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up], 1)


def _tukey(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < 1, (1 - x**2) ** 2, 0)


def _thinned(points: np.ndarray) -> np.ndarray:
    """One of the points [N,3] for each cube of CELL / 2, the first."""
    _, first = np.unique(np.floor(points / (CELL / 2)).astype(int), axis=0, return_index=True)
    return points[np.sort(first)]
