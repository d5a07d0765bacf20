"""Bundle adjustment of a camera that may zoom while filming and read its rows one after the other.

COLMAP's camera does neither: it explains both by a wrong focal length, a bent lens and a wrong path. Here the focal
length may change over the clip (its logarithm is linear between a few knots), and each row has a time of its own, as in
`stages/estimators/detectors/bundle.py`.
Source: Triggs et al. 2000, the points eliminated by the Schur complement; Hedborg et al. 2012 for rows with their own time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

DONE = 1e-5  # of the cost: a round that wins less is the last
HALF = 1.5  # times the median error at the start: an observation so far off counts half (Cauchy)
TRIES = 6  # of a round, each with ten times the damping
K_SPREAD, READOUT_SPREAD = 0.02, 1.0  # known beforehand of k, and of the readout in frame intervals
CHANGE, BEND = 0.3, 0.05  # of the focal length's logarithm: between neighbouring knots, and off the line through them
BEHIND = 1e4  # px: the error of a point behind its camera


@dataclass(frozen=True)
class Observations:
    """M places `xy` [M,2] px where frames `frame` [M] see points `point` [M], which ascend; frames of `size` px."""

    frame: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True)
class Bundle:
    """Cameras `viewmats` [F,4,4] and `points` [T,4]; `log_focal` [J] (px) at knots spread over the clip; `k` of the lens.

    A point is x, y, z, w of length 1 for the place (x, y, z) / w, so that one far away or without parallax (w 0) is one,
    too. Cameras that stay in one place and points with w 0 are a turn, and adjusted they stay one.
    `readout` is the share of the time between two frames in which a picture is read; `viewmats` are of the middle row.
    """

    viewmats: np.ndarray
    points: np.ndarray
    log_focal: np.ndarray
    k: float
    readout: float = 0.0

    @property
    def focals(self) -> np.ndarray:
        """Focal length of each frame in px [F]."""
        return np.exp(between_knots(len(self.viewmats), len(self.log_focal)) @ self.log_focal)


@dataclass(frozen=True)
class Adjusted:
    """An adjusted bundle with the errors `off` [M] px it leaves, and its robust `cost`.

    `covariance` [J+2,J+2] is of log_focal, k and readout, for observations that are `noise` px off.
    """

    bundle: Bundle
    off: np.ndarray
    cost: float
    covariance: np.ndarray
    noise: float


def between_knots(frames: int, count: int) -> np.ndarray:
    """The weight [frames,count] that each of `count` knots has at each frame; one knot is for all frames."""
    at = np.linspace(0, count - 1, frames)
    return np.maximum(0, 1 - abs(at[:, None] - np.arange(count)))


def rolled(bundle: Bundle, seen: Observations) -> np.ndarray:
    """How far each observation lies from where the camera of its frame's middle row sees it [M,2] px."""
    solver = _Solver(bundle, seen, True, 0.0, 1.0)
    return bundle.readout * solver.late * solver.speed(bundle)


def adjust(start: Bundle, seen: Observations, rolls: bool, focal: float, spread: float, rounds: int = 40) -> Adjusted:
    """The bundle near `start` that explains best what is seen; its readout stays as it is unless it `rolls`.

    `focal` px, with `spread` of its logarithm, is known beforehand of the clip's mean.
    """
    bundle, damping, solver = start, 1e-4, _Solver(start, seen, rolls, np.log(focal), spread)
    off = solver.errors(bundle)
    solver.noise = HALF * float(np.median(np.linalg.norm(off, axis=1))) + 1e-3
    cost = solver.cost(bundle, off)
    for _ in range(rounds):
        solver.linearise(bundle, off)
        for _ in range(TRIES):
            moved = solver.step(bundle, damping)
            rest = solver.errors(moved)
            if (now := solver.cost(moved, rest)) < cost:
                break
            damping *= 10
        else:
            break
        won, bundle, off, cost, damping = 1 - now / cost, moved, rest, now, max(damping / 10, 1e-9)
        if won < DONE:
            break
    solver.linearise(bundle, off)
    return Adjusted(bundle, np.linalg.norm(off, axis=1), cost, solver.covariance(), solver.noise)


class _Solver:
    """Normal equations of a bundle: cameras (6 numbers a frame), then S shared numbers, with the points eliminated."""

    def __init__(self, start: Bundle, seen: Observations, rolls: bool, log_focal: float, spread: float) -> None:
        self.seen, self.rolls, self.noise = seen, rolls, 1.0
        self.frames, self.count = len(start.viewmats), len(start.points)
        self.knots = between_knots(self.frames, len(start.log_focal))
        self.by_frame = np.argsort(seen.frame, kind="stable")
        self.late = (seen.xy[:, 1] / seen.size[1] - 0.5)[:, None]
        J = len(start.log_focal)
        rows, aims = [np.full(J, 1 / J) / spread], [log_focal / spread]
        rows += [(np.eye(J)[j + 1] - np.eye(J)[j]) / CHANGE for j in range(J - 1)]
        rows += [(np.eye(J)[j] + np.eye(J)[j + 2] - 2 * np.eye(J)[j + 1]) / 2 / BEND for j in range(J - 2)]
        self.known = np.zeros((len(rows) + 2, J + 2))
        self.known[:-2, :J], self.known[-2, J], self.known[-1, J + 1] = rows, 1 / K_SPREAD, 1 / READOUT_SPREAD
        self.aims = np.concatenate([aims, np.zeros(len(rows) + 1)])

    def place(self, bundle: Bundle, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where frames `frame` [M] see the points: in the camera's axes [M,3], and in px from the middle [M,2]."""
        V = bundle.viewmats[frame]
        local = (V[:, :3] @ bundle.points[self.seen.point][..., None])[..., 0]
        u = local[:, :2] / local[:, 2:]
        return local, u * (1 + bundle.k * (u**2).sum(1, keepdims=True)) * bundle.focals[frame][:, None]

    def speed(self, bundle: Bundle) -> np.ndarray:
        """How far each observation moves between two frames [M,2] px, from the frames before and after."""
        before, after = np.maximum(self.seen.frame - 1, 0), np.minimum(self.seen.frame + 1, self.frames - 1)
        way = self.place(bundle, after)[1] - self.place(bundle, before)[1]
        return way / (after - before)[:, None]

    def errors(self, bundle: Bundle) -> np.ndarray:
        """What is seen less what the bundle predicts [M,2] px."""
        local, there = self.place(bundle, self.seen.frame)
        if self.rolls or bundle.readout:
            there = there + bundle.readout * self.late * self.speed(bundle)
        off = self.seen.xy - np.array(self.seen.size) / 2 - there
        return np.where(local[:, 2:] > 0, off, BEHIND)

    def shared(self, bundle: Bundle) -> np.ndarray:
        """The numbers that all frames share [J+2]."""
        return np.array([*bundle.log_focal, bundle.k, bundle.readout])

    def cost(self, bundle: Bundle, off: np.ndarray) -> float:
        """Cauchy's cost of the errors, and how far the bundle is from what is known beforehand."""
        doubt = self.known @ self.shared(bundle) - self.aims
        return float(np.log1p((off**2).sum(1) / self.noise**2).sum() + (doubt**2).sum())

    def linearise(self, bundle: Bundle, off: np.ndarray) -> None:
        """Blocks of the normal equations around a bundle that leaves errors `off` [M,2] px."""
        frame, point, V = self.seen.frame, self.seen.point, bundle.viewmats
        local, there = self.place(bundle, frame)
        z, u = local[:, 2], local[:, :2] / local[:, 2:]
        bent, f = (u**2).sum(1)[:, None, None], bundle.focals[frame][:, None, None]
        by_u = f * ((1 + bundle.k * bent) * np.eye(2) + 2 * bundle.k * u[:, :, None] * u[:, None])
        by_local = np.concatenate([by_u, -by_u @ u[..., None]], 2) / z[:, None, None]
        turned = np.cross(local[:, None], np.eye(3))  # d(w x p) / dw
        rolled = self.late * self.speed(bundle) if self.rolls else np.zeros_like(there)
        J = self.knots.shape[1]
        by_shared = np.concatenate(
            [there[..., None] * self.knots[frame][:, None], f * bent * u[..., None], rolled[..., None]], 2
        )
        weight = np.sqrt(1 / (self.noise**2 + (off**2).sum(1)))[:, None, None]
        near = bundle.points[point, 3, None, None]
        cameras, shared = weight * np.concatenate([by_local @ turned, near * by_local], 2), weight * by_shared
        self.ways = ways_of(bundle.points)
        points, rest = weight * (by_local @ (V[frame, :3] @ self.ways[point])), weight * off[..., None]
        self.blocks = _sums(cameras.mT @ cameras, frame, self.frames, self.by_frame)
        self.cross = _sums(cameras.mT @ shared, frame, self.frames, self.by_frame).reshape(-1, J + 2)
        self.own = np.einsum("mki,mkj->ij", shared, shared)
        self.pull = np.concatenate(
            [_sums(cameras.mT @ rest, frame, self.frames, self.by_frame).ravel(), (shared.mT @ rest).sum(0)[:, 0]]
        )
        self.inner, self.inner_pull = (_sums(points.mT @ right, point, self.count) for right in (points, rest))
        self.mixed = np.zeros((6 * self.frames + J + 2, self.count, 3))
        self.mixed[: 6 * self.frames].reshape(self.frames, 6, self.count, 3)[frame, :, point] = cameras.mT @ points
        self.mixed[6 * self.frames :] = _sums(shared.mT @ points, point, self.count).swapaxes(0, 1)
        self.doubt = self.aims - self.known @ self.shared(bundle)

    def reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normal matrix and right side of cameras and shared numbers, and the points' inverse blocks [T,3,3]."""
        size = 6 * self.frames
        inner = self.inner + (damping + 1e-12) * np.trace(self.inner, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        inverse = np.linalg.inv(inner)
        half = (self.mixed.swapaxes(0, 1) @ inverse).swapaxes(0, 1).reshape(len(self.mixed), -1)
        N = -half @ self.mixed.reshape(len(self.mixed), -1).T
        for i, block in enumerate(self.blocks):
            N[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += block
        N[:size, size:] += self.cross
        N[size:, :size] += self.cross.T
        N[size:, size:] += self.own + self.known.T @ self.known
        steady = np.concatenate([np.diagonal(block) for block in self.blocks])
        N[np.arange(size), np.arange(size)] += damping * steady + 1e-9 * steady.max()  # the world may drift: its gauge
        if not self.rolls:
            N[-1], N[:, -1], N[-1, -1] = 0, 0, 1
        right = self.pull - half @ self.inner_pull.ravel()
        right[size:] += self.known.T @ self.doubt
        right[-1] *= self.rolls
        return N, right, inverse

    def step(self, bundle: Bundle, damping: float) -> Bundle:
        """The bundle after a step of Levenberg and Marquardt."""
        N, right, inverse = self.reduced(damping)
        found, size, J = np.linalg.solve(N, right), 6 * self.frames, len(bundle.log_focal)
        back = self.inner_pull - (found @ self.mixed.reshape(len(found), -1)).reshape(-1, 3, 1)
        moves, viewmats = found[:size].reshape(-1, 6), bundle.viewmats.copy()
        turn = Rotation.from_rotvec(moves[:, :3]).as_matrix()
        viewmats[:, :3] = turn @ viewmats[:, :3]
        viewmats[:, :3, 3] += moves[:, 3:]
        points = bundle.points + (self.ways @ inverse @ back)[..., 0]
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        log_focal, (k, readout) = bundle.log_focal + found[size : size + J], found[-2:]
        return Bundle(viewmats, points, log_focal, bundle.k + float(k), bundle.readout + float(readout))

    def covariance(self) -> np.ndarray:
        """Covariance [J+2,J+2] of the shared numbers; 0 for a readout that is not solved for."""
        found = np.linalg.inv(self.reduced(0.0)[0])[6 * self.frames :, 6 * self.frames :]
        found[-1, -1] *= self.rolls
        return found


def ways_of(points: np.ndarray) -> np.ndarray:
    """Three ways in which each of `points` [T,4] of length 1 can move, at right angles to it and to each other [T,4,3].

    Source: Householder 1958. For w 0 the last way changes w alone.
    """
    mirror = points.copy()
    mirror[:, 0] += np.where(points[:, 0] < 0, -1, 1)
    mirror /= np.linalg.norm(mirror, axis=1, keepdims=True)
    return (np.eye(4) - 2 * mirror[:, :, None] * mirror[:, None])[:, :, 1:]


def _sums(values: np.ndarray, row: np.ndarray, count: int, order: np.ndarray | None = None) -> np.ndarray:
    """Sums [count,...] of `values` [M,...] of each row; `order` sorts `row`, which ascends without."""
    if order is not None:
        values, row = values[order], row[order]
    found, starts = np.zeros((count, *values.shape[1:])), np.flatnonzero(np.diff(row, prepend=-1))
    found[row[starts]] = np.add.reduceat(values, starts)
    return found
