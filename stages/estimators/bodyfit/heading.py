"""Which frames contradict how the person turns: the heading is a track with a speed, and landmarks that leave it for a few
frames and come back took the back for the front, or what is far for what is near. Where they took the trunk alone for that,
arms and legs do not fit to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.estimators.bodyfit.evidence import LandmarkEvidence, mirrored_columns
from stages.estimators.bodyfit.start import normalize

SLACK = np.radians(45)  # by which a turn from a frame to another differs from the speed's, less the speed's own turn
AROUND = 8  # steps before and after whose median is the speed: a third of them may be wrong
TORN = 1.1  # times as long as with the trunk turned about: arms and thighs are at most 1.0 in ten clips, of a false trunk 1.13
BREAK = 1 / 16  # of the frames: a turn that contradicts the speed costs as much as leaving out so many


def drop_turned(evidence: LandmarkEvidence, times: np.ndarray) -> tuple[LandmarkEvidence, np.ndarray]:
    """Drop frames that contradict the heading of those around them, or whose trunk limbs do, as if nobody was seen; `times` [F] s.

    A shortest path through the seen frames: a frame left out costs 1, and BREAK a turn that differs from that of the speed there
    by more than SLACK and once more the speed's. Returns the evidence and which frames [F] were dropped.
    """
    frames = np.flatnonzero(evidence.seen & ~_torn(evidence))
    across, up = _axes(evidence, frames)
    count, cost_of_break = len(frames), max(2.0, BREAK * len(frames))
    even = _even(across, up, times[frames])
    cost, back = np.arange(count, dtype=float), np.full(count, -1)  # all before it left out
    for b in range(1, count):
        a = np.arange(max(0, b - 1 - int(2 * cost_of_break)), b)
        due = even[b] - even[a]
        breaks = abs(_turn(across[a], across[b], up[a] + up[b]) - due) > SLACK + abs(due)
        total = cost[a] + b - a - 1 + cost_of_break * breaks
        if total.min() < cost[b]:
            cost[b], back[b] = total.min(), a[total.argmin()]
    kept = [int((cost + np.arange(count)[::-1]).argmin())] if count else []
    while kept and back[kept[-1]] >= 0:
        kept.append(int(back[kept[-1]]))
    turned = evidence.seen.copy()
    turned[frames[kept]] = False
    weight = np.where(turned[:, None], 0.0, evidence.weight)
    return replace(evidence, seen=evidence.seen & ~turned, weight=weight), turned


def _torn(evidence: LandmarkEvidence) -> np.ndarray:
    """Whether upper arms and thighs would be clearly shorter [F] if the trunk were seen from its other side."""
    bones = [
        (f"{side}_{far}", f"{side}_{near}")
        for side in ("left", "right")
        for near, far in (("shoulder", "elbow"), ("hip", "knee"))
    ]
    ends, starts = (np.array([evidence.column(bone[i]) for bone in bones]) for i in (0, 1))
    others, world = mirrored_columns(evidence.names)[starts], evidence.world
    known = (evidence.limbs(list(ends), list(starts)) > 0) & (evidence.limbs(list(ends), list(others)) > 0)
    long, turned = (
        (np.linalg.norm(world[:, ends] - trunk, axis=-1) * known).sum(1)
        for trunk in (world[:, starts], world[:, others] * [1, 1, -1])
    )
    return np.asarray(long > TORN * turned)


def _axes(evidence: LandmarkEvidence, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [N,3] across the trunk, to the left, and up along it."""
    at = {name: evidence.world[frames, k] for k, name in enumerate(evidence.names)}
    hips, shoulders = (at[f"left_{part}"] - at[f"right_{part}"] for part in ("hip", "shoulder"))
    up = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    return normalize(hips + shoulders), normalize(up)


def _turn(a: np.ndarray, b: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Turns about `up` from `a` to `b`, all [...,3], rad, from -pi to pi."""
    up = normalize(up)
    flat = (a * b).sum(-1) - (a * up).sum(-1) * (b * up).sum(-1)
    return np.arctan2((np.cross(a, b) * up).sum(-1), flat)


def _even(across: np.ndarray, up: np.ndarray, times: np.ndarray) -> np.ndarray:
    """How far [N] rad an even turn has come at each of the `times`: its speed is the median of the steps around."""
    passed = np.maximum(np.diff(times), 1e-6)
    speed = _turn(across[:-1], across[1:], up[:-1] + up[1:]) / passed
    median = [np.median(speed[max(0, i - AROUND) : i + 1 + AROUND]) for i in range(len(speed))]
    return np.concatenate([[0.0], np.cumsum(np.array(median) * passed)])
