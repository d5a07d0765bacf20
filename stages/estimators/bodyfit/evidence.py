"""BlazePose landmarks as evidence for the body fit: under the body model's names, of the right person, sides voted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.formats.landmarks import NAMES
from stages.records import JOINT_NAMES, BodyModel, SeenLandmarks

STAND_INS = {
    "left_hand": ("left_pinky", "left_index"),
    "right_hand": ("right_pinky", "right_index"),
    "left_big_toe": ("left_foot_index",),
    "right_big_toe": ("right_foot_index",),
    "left_foot": ("left_foot_index",),
    "right_foot": ("right_foot_index",),
}
"""Model landmarks that BlazePose knows under another name, or as the middle of two (the knuckles)."""
ARMS, LEGS = ("elbow", "wrist", "hand"), ("knee", "ankle", "heel", "big_toe", "foot")
# Cost of exchanging sides, in body heights moved by the landmarks that swap: at either end of a run of exchanged frames, and
# for all frames together; each costs its share, or a third of a clip of many frames would stay exchanged.
SWAP_EDGE, SWAP_ALL = 0.45, 3.0
STRANGER_JUMP = 0.75  # body heights from the neighbours' median; farther is a stranger
CUT = 0.04  # of the person's height: nearer to the picture's border than that, a landmark is a guess
LEAST, LEFT = 6, 4  # landmarks of somebody who is seen: in all, and away from the picture's border
WINDOW = 4  # neighbours on each side for that median
# BlazePose draws people flat. Five synthetic clips: joints 4.16 cm off as it says, 3.99 with depths 1.3 times as large (3.96
# with 1.4), and people stand 1.5 cm too far away instead of 2.3. Where there is no truth (the kitchen), outlines, motion and
# feet agree best with 1.2 to 1.4 too.
FLAT = 1.3


@dataclass(frozen=True)
class LandmarkEvidence:
    """Landmarks of F frames under K model names.

    `xy` [F,K,2] px; `weight` [F,K] 0..1, zero where nothing is known; `world` [F,K,3] m about the hips with camera axes
    (x right, y down, z away); `seen` [F] bool: somebody was found; `height` [F] px: size of the person in the picture.
    `deep` [F,K] bool: `world` was seen, and not filled in between frames; `trust` [K] against BlazePose's landmarks. None: all, 1.
    """

    names: tuple[str, ...]
    xy: np.ndarray
    weight: np.ndarray
    world: np.ndarray
    seen: np.ndarray
    height: np.ndarray
    deep: np.ndarray | None = None
    trust: np.ndarray | None = None

    @property
    def middle(self) -> np.ndarray:
        """The middle of shoulders and hips [F,2] px: where BlazePose's crop looks."""
        return self.xy[:, self.torso].mean(1)

    @property
    def torso(self) -> list[int]:
        """Columns of shoulders and hips."""
        return [k for k, name in enumerate(self.names) if name.partition("_")[2] in ("shoulder", "hip")]

    def column(self, name: str) -> int:
        return self.names.index(name)

    def frames(self, rows: np.ndarray) -> LandmarkEvidence:
        """The same with these frames alone."""
        deep = None if self.deep is None else self.deep[rows]
        each = {key: getattr(self, key)[rows] for key in ("xy", "weight", "world", "seen", "height")}
        return LandmarkEvidence(self.names, **each, deep=deep, trust=self.trust)

    def trusted(self, name: str) -> float:
        """Trust in a landmark against BlazePose's."""
        return 1.0 if self.trust is None else float(self.trust[self.column(name)])

    def limbs(self, ends: list[int], starts: list[int]) -> np.ndarray:
        """Trust [F,S] in the directions between columns: 1, or 0 where they were not seen, whatever that in the places is."""
        trust = np.array([self.trusted(name) for name in self.names])
        deep = np.ones((len(self.seen), len(ends))) if self.deep is None else self.deep[:, ends] & self.deep[:, starts]
        return deep / np.sqrt(trust[ends] * trust[starts])


def model_landmarks(model: BodyModel) -> tuple[tuple[str, ...], np.ndarray]:
    """Names [K] and regressor [K,V] of the model's points that BlazePose sees: its landmarks, and the hands' joints."""
    names, regressor = model.landmark_regressor()
    kept = [i for i, name in enumerate(names) if name in NAMES or name in STAND_INS]
    hands = [side for side in ("left_hand", "right_hand") if side not in names]
    rows = [regressor[kept], *(model.J_regressor[[JOINT_NAMES.index(side)]] for side in hands)]
    return tuple(names[i] for i in kept) + tuple(hands), np.concatenate(rows)


def gather(tracks: Sequence[SeenLandmarks | None], names: tuple[str, ...], flat: float = FLAT) -> LandmarkEvidence:
    """BlazePose's poses (None: nobody was found) as evidence under the model's `names`, their depths `flat` times too small.

    Of landmarks of other networks a place or a depth may be NaN: then it has no weight, or is filled in between frames.
    """
    sources = [[NAMES.index(s) for s in STAND_INS.get(name, (name,))] for name in names]
    count, points = len(tracks), len(names)
    xy, world, weight = np.zeros((count, points, 2)), np.zeros((count, points, 3)), np.zeros((count, points))
    for i, track in enumerate(tracks):
        if track is None:
            continue
        for k, source in enumerate(sources):
            xy[i, k] = np.asarray(track.xy, np.float64)[source].mean(0)
            world[i, k] = np.asarray(track.world, np.float64)[source].mean(0)
            weight[i, k] = np.asarray(track.visibility, np.float64)[source].mean()
    world[..., 2] *= flat
    weight, xy = np.where(np.isfinite(xy).all(-1), weight, 0.0), np.where(np.isfinite(xy), xy, 0.0)
    seen = np.array([track is not None for track in tracks]) & ((weight > 0.3).sum(1) >= LEAST)
    weight[~seen] = 0
    deep = np.isfinite(world).all(-1) & seen[:, None]
    return LandmarkEvidence(names, xy, weight, _filled(world, deep), seen, _heights(xy, weight, seen), deep)


def _filled(world: np.ndarray, deep: np.ndarray) -> np.ndarray:
    """Points [F,K,3], those that are not finite filled in between frames where they are `deep` [F,K]; 0 where none is."""
    filled = np.nan_to_num(world)
    for k in np.flatnonzero(~np.isfinite(world).all((0, 2))):
        known = np.flatnonzero(deep[:, k])
        if len(known):
            columns = [np.interp(np.arange(len(world)), known, world[known, k, axis]) for axis in range(3)]
            filled[:, k] = np.where(np.isfinite(world[:, k]), world[:, k], np.stack(columns, -1))
    return filled


def _heights(xy: np.ndarray, weight: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Size of the person [F] px: the spread of the landmarks, which does not shrink as a box does when arms hang."""
    height = np.full(len(xy), np.nan)
    for i in np.flatnonzero(seen):
        points = xy[i, weight[i] > 0.3]
        height[i] = np.hypot(*np.ptp(points, axis=0))
    middle = np.nanmedian(height) if seen.any() else 1.0
    return np.maximum(np.where(seen, height, middle), 1.0)


def drop_strangers(evidence: LandmarkEvidence, masks: list[np.ndarray] | None) -> tuple[LandmarkEvidence, np.ndarray]:
    """Drop frames whose landmarks lie on somebody else: away from the neighbours, or off the person's mask.

    Off it is where the mask is empty, no shoulder or hip lies on it, or less than half as many landmarks as in the median frame:
    somebody near by. Returns the evidence and which frames [F] were dropped.
    """
    middle = evidence.middle
    empty = np.zeros(len(middle), bool) if masks is None else np.array([not (mask > 127).any() for mask in masks])
    stranger = evidence.seen & empty
    on_mask = np.full(len(middle), np.nan)
    order = np.flatnonzero(evidence.seen & ~empty)
    for rank, i in enumerate(order):
        near = np.r_[order[max(0, rank - WINDOW) : rank], order[rank + 1 : rank + 1 + WINDOW]]
        if len(near) >= 3:
            jump = np.linalg.norm(middle[i] - np.median(middle[near], axis=0))
            stranger[i] = jump > STRANGER_JUMP * np.median(evidence.height[near])
        if masks is not None:
            rows, columns = masks[i].shape
            at = np.floor(evidence.xy[i]).astype(int)
            inside = (at >= 0).all(1) & (at[:, 0] < columns) & (at[:, 1] < rows)
            hits = inside & (masks[i][at[:, 1].clip(0, rows - 1), at[:, 0].clip(0, columns - 1)] > 127)
            torso = np.isin(np.arange(len(at)), evidence.torso)
            stranger[i] |= bool((inside & torso).sum() >= 3 and not hits[torso].any())
            shown = inside & (evidence.weight[i] > 0.3)
            on_mask[i] = hits[shown].mean() if shown.any() else np.nan
    if np.isfinite(on_mask).any():
        stranger |= on_mask < 0.5 * np.nanmedian(on_mask)
    weight = np.where(stranger[:, None], 0.0, evidence.weight)
    return replace(evidence, seen=evidence.seen & ~stranger, weight=weight), stranger


def drop_cut(evidence: LandmarkEvidence, size: tuple[int, int]) -> LandmarkEvidence:
    """Drop landmarks at the border of the pictures, `size` (width, height) px: what is cut off BlazePose puts there.

    A frame in which too few are left shows nobody.
    """
    rim = CUT * evidence.height[:, None, None]
    inside = ((evidence.xy > rim) & (evidence.xy < np.array(size) - rim)).all(-1)
    weight = np.where(inside, evidence.weight, 0.0)
    seen = evidence.seen & ((weight > 0).sum(1) >= LEFT)
    return replace(evidence, seen=seen, weight=np.where(seen[:, None], weight, 0.0))


def mirrored_columns(names: tuple[str, ...], parts: tuple[str, ...] | None = None) -> np.ndarray:
    """Column order [K] with left and right exchanged, for the named `parts` or for all."""
    order = np.arange(len(names))
    for k, name in enumerate(names):
        side, _, part = name.partition("_")
        if side in ("left", "right") and (parts is None or part in parts):
            order[k] = names.index(("right_" if side == "left" else "left_") + part)
    return order


def vote_sides(evidence: LandmarkEvidence) -> tuple[LandmarkEvidence, np.ndarray]:
    """Exchange left and right (of all, arms or legs), or front and back, in the frames that contradict their neighbours.

    Somebody seen from behind who is taken for somebody seen from the front has both left and right exchanged and near and
    far; where depth alone is read wrongly, near and far alone. A shortest path over the seen frames (Viterbi): a step costs
    how far the landmarks move, in picture and space; a run of exchanged frames costs SWAP_EDGE at either end and its share
    of SWAP_ALL, so the sides that BlazePose gives most often win. Returns which frames [F] were changed.
    """
    orders = [mirrored_columns(evidence.names, parts) for parts in ((), None, ARMS, LEGS, None, ())]
    near_far = np.ones((len(orders), 3))
    near_far[-2:, 2] = -1
    frames = np.flatnonzero(evidence.seen)
    if len(frames) < 2:
        return evidence, np.zeros(len(evidence.seen), bool)
    size = np.median(evidence.height[frames])
    middle = np.median(np.linalg.norm(evidence.world[frames], axis=-1).max(1))
    features = np.concatenate([evidence.xy / size, 0.5 * evidence.world / max(middle, 1e-6)], -1)
    views = np.stack([features[:, order] for order in orders])
    views[..., 2:] *= near_far[:, None, None]
    weights = np.stack([evidence.weight[:, order] for order in orders])
    states = len(orders)
    cost, each = np.zeros(states), SWAP_ALL / len(frames)
    cost[1:] += SWAP_EDGE + each
    back = np.zeros((len(frames), states), int)
    for step in range(1, len(frames)):
        a, b = frames[step - 1], frames[step]
        moved = np.linalg.norm(views[:, None, a] - views[None, :, b], axis=-1)
        trust = np.sqrt(weights[:, None, a] * weights[None, :, b])
        step_cost = (trust * np.minimum(moved, 0.5)).sum(-1)
        total = cost[:, None] + step_cost + SWAP_EDGE * (1 - np.eye(states))
        back[step] = total.argmin(0)
        cost = total.min(0) + each * (np.arange(states) > 0)
    state = np.zeros(len(frames), int)
    state[-1] = (cost + SWAP_EDGE * (np.arange(states) > 0)).argmin()
    for step in range(len(frames) - 1, 0, -1):
        state[step - 1] = back[step, state[step]]
    xy, world, weight = evidence.xy.copy(), evidence.world.copy(), evidence.weight.copy()
    deep = None if evidence.deep is None else evidence.deep.copy()
    for i, s in zip(frames, state, strict=True):
        xy[i], world[i], weight[i] = xy[i, orders[s]], world[i, orders[s]] * near_far[s], weight[i, orders[s]]
        if deep is not None:
            deep[i] = deep[i, orders[s]]
    changed = np.zeros(len(evidence.seen), bool)
    changed[frames] = state > 0
    return replace(evidence, xy=xy, world=world, weight=weight, deep=deep), changed


def joint_trust(evidence: LandmarkEvidence) -> np.ndarray:
    """How visible each joint is [F,24], 0..1: as its landmark, a foot as its heel, a joint without one as the trunk's best."""
    torso = evidence.weight[:, evidence.torso].max(1)
    columns = []
    for name in JOINT_NAMES:
        landmark = name.replace("foot", "heel")
        columns.append(evidence.weight[:, evidence.column(landmark)] if landmark in evidence.names else torso)
    return np.minimum(2 * np.stack(columns, 1), 1)
