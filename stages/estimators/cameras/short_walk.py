"""A camera that only turns, or that walks so little that mappers see no depth: which of the two explains the clip.

Both are adjusted to the same tracks. A turn may zoom and read its rows late, too: it gets every chance. A walk is
believed if it leaves clearly less, after its greater freedom is paid for, and if nearly all points come to lie before
the camera: what is no parallax puts as many behind it.
Source: Yu and Gallup 2014 for structure from hardly any motion, begun with depths at random; here points have four
numbers (`adjustment.Bundle`), so that a turn is a walk of length 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.estimators.cameras.adjustment import HALF, Adjusted, Bundle, Observations, adjust
from stages.estimators.cameras.changing import KNOTS, WORTH
from stages.estimators.cameras.intrinsics import TRACK_ERROR, Prior
from stages.estimators.cameras.motion import Pair, rays_of

ASKED, KEPT = 400, 4000  # tracks, the longest: to tell a walk from a turn, and to make the model of a walk
LEAST, LONG = 3, 5  # frames that must see a track; that see those by which a walk and a turn are compared
SEEDS, FIRST = 8, 2  # starts with depths at random, and how many are tried although one fits
NEAREST, FARTHEST = 0.3, 0.1  # w of these depths, for a camera of which nothing is known but that it turns
ROUNDS, AGAIN = 100, 3  # of adjustment; and how often points behind the camera are put before it
WINS = 1.25  # times as much must a turn leave over as a walk: turns 0.8 to 1.2, walks of 0.3 to 5 degrees 1.2 to 2.9
BEHIND = 0.15  # share of the points that may lie behind the camera: of turns it is 0.2 to 0.5, of walks up to 0.1
FITS = 0.0005  # of the longer side: what a walk may leave over; those that ended in a wrong place left more
FAR = 50.0  # times as far as the middle one: such points are as good as infinitely far, and no part of a model
KNOT = 3  # frames for each knot of a focal length that may change, or it explains what a few frames show of depth
ENOUGH = 15  # tracks that a frame must see to be placed


@dataclass(frozen=True)
class TurnOrWalk:
    """The best turn and the best walk for the same tracks `seen` of `pairs`, and what tells them apart.

    `wins` is how many times as much the turn leaves over, `behind` the share of points behind the walking camera.
    """

    turn: Adjusted
    walk: Adjusted
    pairs: list[Pair]
    seen: Observations
    wins: float
    behind: float

    @property
    def turns(self) -> bool:
        """Whether the camera only turns: a walk explains nothing more."""
        return self.wins < WINS

    @property
    def walks(self) -> bool:
        """Whether the camera walks, and the walk that was found can be believed."""
        return not self.turns and self.behind < BEHIND and fits(self.walk, self.seen)

    def facts(self) -> dict[str, float]:
        """For sfm.json."""
        return {"walk_wins": round(self.wins, 3), "walk_behind": round(self.behind, 3)}


def tracks_of(pairs: list[Pair], size: tuple[int, int], most: int) -> Observations:
    """Places that verified matches join to one, in the order of their tracks: the `most` longest of LEAST frames or more.

    A track that has two places in one frame is none.
    """
    ends = [np.column_stack([np.full(len(xy), i), xy]) for p in pairs for i, xy in ((p.first, p.a), (p.second, p.b))]
    places, row = np.unique(np.concatenate(ends), axis=0, return_inverse=True)
    starts = np.cumsum([0, *(len(end) for end in ends)])
    joined = [np.ravel(row)[a:b] for a, b in zip(starts, starts[1:])]
    first, second = np.concatenate(joined[::2]), np.concatenate(joined[1::2])
    shape = (len(places), len(places))
    count, track = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=shape), directed=False)
    frame = places[:, 0].astype(int)
    twice, times = np.unique(np.column_stack([track, frame]), axis=0, return_counts=True)
    length = np.bincount(track, minlength=count)
    length[twice[times > 1, 0]] = 0
    kept = np.argsort(-length, kind="stable")[:most]
    kept = kept[length[kept] >= LEAST]
    number = np.full(count, -1)
    number[kept] = np.arange(len(kept))
    point = number[track]
    order = np.argsort(point, kind="stable")[(point < 0).sum() :]
    return Observations(frame[order], point[order], places[order, 1:], size)


def compare(
    pairs: list[Pair], turns: np.ndarray, focal: float, k: float, size: tuple[int, int], prior: Prior
) -> TurnOrWalk | None:
    """The best turn and the best walk near rotations `turns` [F,3,3] and lens `focal` px and `k`; None for too few tracks.

    `prior` is what is known of the focal length.
    """
    seen = tracks_of(pairs, size, ASKED)
    if len(seen.frame) < 4 * 6 * len(turns):  # twice as many numbers as the cameras of a walk have
        return None
    start = _turn_from(seen, turns, focal, k)
    plain = _adjusted(start, seen, prior)
    free = _adjusted(_freed(plain.bundle), seen, prior, rolls=True)
    walk = _best_walk(plain.bundle, seen, prior)
    free_walk = _adjusted(_freed(walk.bundle), seen, prior, rolls=True)
    changes = np.median(free.off) < (1 - WORTH) * np.median(plain.off)
    behind = float((walk.bundle.points[:, 3] <= 0).mean())
    least = max(leftover(free_walk.off, seen, 6, 3, free_walk.noise), 1e-9)  # px
    wins = leftover(free.off, seen, 3, 2, free_walk.noise) / least
    return TurnOrWalk(free if changes else plain, walk, pairs, seen, wins, behind)


def leftover(off: np.ndarray, seen: Observations, camera: int, point: int, noise: float) -> float:
    """The usual error in px of a track, for errors `off` [M] of cameras and points that have so many free numbers each.

    Each track pays for what fitted it: its own numbers, and its share of the cameras'.
    """
    length = np.bincount(seen.point)
    squared = np.bincount(seen.point, np.minimum(off, 3 * noise) ** 2)
    free = 2 * length - point - camera * len(np.unique(seen.frame)) * length / len(off)
    long = length >= min(LONG, length.max())
    return float(np.sqrt(np.median(squared[long] / free[long])))


def all_tracks(found: TurnOrWalk, prior: Prior) -> tuple[Adjusted, Observations]:
    """The walk adjusted to KEPT tracks; points behind the cameras, or as good as infinitely far, are left out."""
    seen = tracks_of(found.pairs, found.seen.size, KEPT)
    walk = _adjusted(replace(found.walk.bundle, points=_intersected(seen, found.walk.bundle)), seen, prior)
    w = walk.bundle.points[:, 3] / np.linalg.norm(walk.bundle.points[:, :3], axis=1)
    near = w > np.median(w) / FAR
    number, here = np.cumsum(near) - 1, near[seen.point]
    kept = Observations(seen.frame[here], number[seen.point[here]], seen.xy[here], seen.size)
    return replace(walk, bundle=replace(walk.bundle, points=walk.bundle.points[near]), off=walk.off[here]), kept


def _intersected(seen: Observations, bundle: Bundle) -> np.ndarray:
    """The points [T,4] nearest to the rays in which cameras see them.

    Source: Hartley and Zisserman 2004, section 12.2, with rays of length 1.
    """
    rays = rays_of((seen.xy - np.array(seen.size) / 2) / bundle.focals[seen.frame, None], bundle.k)
    beside = np.cross(rays[:, :, None], bundle.viewmats[seen.frame, :3], axis=1)
    first = np.flatnonzero(np.diff(seen.point, prepend=-1))
    points = np.linalg.eigh(np.add.reduceat(beside.mT @ beside, first))[1][:, :, 0]
    ahead = ((bundle.viewmats[seen.frame[first], :3] @ points[..., None])[..., 0] * rays[first]).sum(1)
    return points * np.where(ahead < 0, -1, 1)[:, None]


def _points(seen: Observations, turns: np.ndarray, focal: float, k: float, w: float) -> np.ndarray:
    """Points [T,4] in the mean direction in which cameras that turn see them, with `w` for a direction of length 1."""
    rays = rays_of((seen.xy - np.array(seen.size) / 2) / focal, k)
    world = (rays[:, None] @ turns[seen.frame])[:, 0]
    mean = np.stack([np.bincount(seen.point, axis) for axis in world.T], 1)
    ways = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    return _unit(np.column_stack([ways, np.full(len(ways), w)]))


def _unit(points: np.ndarray) -> np.ndarray:
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def _turn_from(seen: Observations, turns: np.ndarray, focal: float, k: float) -> Bundle:
    viewmats = np.tile(np.eye(4), (len(turns), 1, 1))
    viewmats[:, :3, :3] = turns
    return Bundle(viewmats, _points(seen, turns, focal, k, 0.0), np.log([focal]), k)


def _adjusted(start: Bundle, seen: Observations, prior: Prior, rolls: bool = False) -> Adjusted:
    """The bundle adjusted twice: then with the noise that the first time leaves, beside which tracks drift together."""
    first = adjust(start, seen, rolls, prior.focal, prior.spread, ROUNDS)
    drift = max(TRACK_ERROR * max(seen.size) / (HALF * float(np.median(first.off)) + 1e-3), 1.0)
    return adjust(first.bundle, seen, rolls, prior.focal, prior.spread / drift, ROUNDS)


def fits(walk: Adjusted, seen: Observations) -> bool:
    """Whether a walk leaves as little as one that ended in the right place."""
    return float(np.median(walk.off)) < FITS * max(seen.size)


def _best_walk(turn: Bundle, seen: Observations, prior: Prior) -> Adjusted:
    """The walk that leaves least of several starts: a few are tried, and more only while none fits.

    All begin with the lens of the turn but one: that lens may have bent to explain depth.
    """
    tried: list[Adjusted] = []
    usual = replace(turn, log_focal=np.log([prior.focal]), k=0.0)
    for seed in range(SEEDS):
        if seed >= FIRST and any(fits(walk, seen) for walk in tried):
            break
        tried.append(_walk(usual if seed == 1 else turn, seen, prior, seed))
    return min(tried, key=lambda walk: float(np.median(walk.off)))


def _walk(turn: Bundle, seen: Observations, prior: Prior, seed: int) -> Adjusted:
    """The walk that is found from a turn and depths at random."""
    points = turn.points.copy()
    points[:, 3] = np.random.default_rng(seed).uniform(FARTHEST, NEAREST, len(points))
    bundle = replace(turn, points=_unit(points))
    found = adjust(bundle, seen, False, prior.focal, prior.spread, ROUNDS)
    for _ in range(AGAIN - 1):
        points = _before(found.bundle).points.copy()
        points[:, 3] = np.where(points[:, 3] > 0, points[:, 3], max(float(np.median(points[:, 3])), 0) / 3)
        bundle = replace(_before(found.bundle), points=_unit(points))
        found = adjust(bundle, seen, False, prior.focal, prior.spread, ROUNDS)
    return replace(found, bundle=_before(found.bundle))


def _before(bundle: Bundle) -> Bundle:
    """The same pictures with most points before the cameras: a walk and its mirrored one see the same."""
    if np.median(bundle.points[:, 3]) >= 0:
        return bundle
    points, viewmats = bundle.points * [1, 1, 1, -1], bundle.viewmats.copy()
    viewmats[:, :3, 3] *= -1
    return replace(bundle, points=points, viewmats=viewmats)


def _freed(bundle: Bundle) -> Bundle:
    """The bundle with a focal length that may change."""
    return replace(bundle, log_focal=np.full(min(KNOTS, max(len(bundle.viewmats) // KNOT, 1)), bundle.log_focal.mean()))
