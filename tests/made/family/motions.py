"""Motions by formula whose feet stand where they stand: where pelvis and feet go is said, the legs follow.

A `Plan` is in leg lengths (hip to sole), so that it suits any body; `tests.made.family.legs` poses one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

SIDES = (1.0, -1.0)
"""Left is +x of a person who looks along +z."""
CYCLE, SWING = 0.9, 0.38
"""Seconds of two steps, and the share of it in which a foot is in the air."""
CLEARANCE, HEEL = 0.09, 0.75
"""How high a foot is lifted, leg lengths; how far the heel has risen when the foot leaves the floor, rad."""


class Plan:
    """What a person does at each of F times: lengths in leg lengths, angles in rad, all arrays [F] or [F,2] (left, right).

    `spot` [F,2] pelvis x, z, `tall` its height (1: upright), `yaw`, `lean` (forward) and `bend` of the spine; `feet` [F,2,3]
    x, lift, z of the balls less where they are at rest, `feet_yaw`, `heels` (up); arms: `up` from hanging to the side,
    `ahead` from hanging forward, `elbows`; `nod` of the head; `flight` of the whole person over the floor.
    """

    def __init__(self, times: np.ndarray):
        count = len(times)
        self.times, self.tall = times, np.full(count, 0.985)
        self.spot, self.feet = np.zeros((count, 2)), np.zeros((count, 2, 3))
        self.yaw, self.lean, self.bend, self.nod, self.flight = np.zeros((5, count))
        self.feet_yaw, self.heels, self.up, self.ahead = np.zeros((4, count, 2))
        self.elbows = np.full((count, 2), 0.25)


def _ease(t: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 before `start`, 1 after `end`, smooth between."""
    x = ((t - start) / (end - start)).clip(0, 1)
    return x * x * x * (10 - 15 * x + 6 * x * x)


def _there_and_back(t: np.ndarray, down: float, up: float, ramp: float = 0.9) -> np.ndarray:
    """1 from `down` + ramp to `up`, 0 before `down` and after `up` + ramp."""
    return _ease(t, down, down + ramp) - _ease(t, up, up + ramp)


def _step(plan: Plan, where: Callable[[np.ndarray], np.ndarray], cycle: float = CYCLE) -> None:
    """Let the feet step so that they follow the pelvis, which is at `where`(times) [N,3]: x, z, yaw."""
    t = plan.times
    path = where(t)
    plan.spot, plan.yaw = path[:, :2], path[:, 2]
    for i in range(2):
        phase = t / cycle + 0.5 * i + 0.31
        lap = np.floor(phase)
        gone = (phase - lap) / SWING  # below 1: in the air
        middle = (lap + (1 + SWING) / 2 - 0.5 * i - 0.31) * cycle  # of the stance that follows
        before, after = where(middle - cycle), where(middle)
        x = gone.clip(0, 1)
        at = before + (after - before) * (x * x * (3 - 2 * x))[:, None]
        plan.feet[:, i, [0, 2]], plan.feet_yaw[:, i] = at[:, :2], at[:, 2]
        stride = np.linalg.norm((after - before)[:, :2], axis=1).clip(max=0.6)
        plan.feet[:, i, 1] = CLEARANCE * np.sin(np.pi * x) ** 2
        leaving = ((phase - lap - 0.75) / 0.25).clip(0, 1)
        plan.heels[:, i] = HEEL * stride / 0.6 * np.where(gone < 1, (1 - x) ** 2, leaving**2)
        swing = np.sin(2 * np.pi * (phase - SWING / 2))
        plan.ahead[:, i] = 0.6 * stride * swing  # arms swing against the legs
    plan.elbows[:] = 0.4


def turn(t: np.ndarray, way: float = 1.0) -> Plan:
    """Once around on the spot in small steps, arms that rise and fall."""
    plan = Plan(t)
    _step(plan, lambda t: np.stack([0 * t, 0 * t, way * 2 * np.pi * t / 3.1], 1), cycle=0.62)
    for i in range(2):
        plan.up[:, i] = 1.5 * np.sin(np.pi * (t / 2.1 + 0.4 * i)) ** 2
        plan.elbows[:, i] = 0.3 + 0.6 * np.sin(np.pi * (t / 1.7 + 0.3 * i)) ** 2
    plan.nod = 0.1 * np.sin(2 * t)
    return plan


def turn_back(t: np.ndarray) -> Plan:
    """The other way around, arms ahead in turn."""
    plan = turn(t, -1.0)
    plan.up *= 0.3
    plan.ahead = np.stack([1.4 * np.sin(np.pi * (t / 1.9 + 0.5 * i)) ** 2 for i in range(2)], 1)
    return plan


def turn_fast(t: np.ndarray) -> Plan:
    """Around once a second, arms low."""
    plan = Plan(t)
    _step(plan, lambda t: np.stack([0 * t, 0 * t, 2 * np.pi * t], 1), cycle=0.3)
    plan.up += 0.2
    return plan


def turn_stopping(t: np.ndarray) -> Plan:
    """Around in 3 s with a stop after each third of it, arms that rise and fall."""
    plan, third = Plan(t), 2 * np.pi / 3
    _step(plan, lambda t: np.stack([0 * t, 0 * t, third * (np.floor(t) + _ease(t % 1, 0.0, 0.6))], 1), cycle=0.4)
    plan.up[:] = 0.7 * np.sin(np.pi * t / 2.1)[:, None] ** 2
    return plan


def turn_fro(t: np.ndarray) -> Plan:
    """110 degrees to the left and back, once in 1.6 s."""
    plan = Plan(t)
    _step(plan, lambda t: np.stack([0 * t, 0 * t, np.radians(55) * (1 - np.cos(2 * np.pi * t / 1.6))], 1), cycle=0.4)
    plan.up += 0.15
    return plan


def _walk(t: np.ndarray, length: float, yaw: float) -> Plan:
    """A straight walk of `length` leg lengths with its middle at the origin."""
    plan = Plan(t)

    def where(t: np.ndarray) -> np.ndarray:
        gone = length * (t / 3.1 - 0.5)
        return np.stack([gone * np.sin(yaw), gone * np.cos(yaw), np.full_like(t, yaw)], 1)

    _step(plan, where)
    plan.tall -= 0.01
    plan.lean += 0.04
    return plan


def walk_toward(t: np.ndarray) -> Plan:
    """Towards +z, 3 leg lengths."""
    return _walk(t, 3.0, 0.0)


def walk_away(t: np.ndarray) -> Plan:
    """Towards -z."""
    return _walk(t, 3.0, np.pi)


def walk_across(t: np.ndarray) -> Plan:
    """Towards +x."""
    return _walk(t, 2.6, np.pi / 2)


def squat(t: np.ndarray) -> Plan:
    """Down with the arms ahead, a little wait, and up; then down again."""
    plan, down = Plan(t), 0.5 - 0.5 * np.cos(2 * np.pi * t / 1.6)
    plan.feet[..., 0] = 0.05 * np.array(SIDES)
    plan.tall -= 0.42 * down
    plan.lean, plan.bend, plan.nod = 0.6 * down, 0.2 * down, -0.4 * down
    plan.spot[:, 1] = -0.12 * down
    plan.ahead[:] = (1.5 * down)[:, None]
    return plan


def bend(t: np.ndarray) -> Plan:
    """Bows down to the floor, touches it before the feet, and comes up again."""
    plan, down = Plan(t), _there_and_back(t, 0.2, 1.9, 1.1)
    plan.tall -= 0.14 * down
    plan.lean, plan.bend, plan.nod = 1.35 * down, 0.75 * down, -0.2 * down
    plan.spot[:, 1] = -0.16 * down
    plan.ahead[:] = (1.75 * down)[:, None]
    plan.ahead[:, 1] -= 0.4 * down
    plan.elbows[:] = 0.15
    return plan


def sit(t: np.ndarray) -> Plan:
    """Sits down on a chair behind, turns the trunk upright, and lifts an arm."""
    plan, down = Plan(t), _ease(t, 0.3, 1.5)
    rise = _there_and_back(t, 0.3, 1.0, 0.6)
    plan.tall -= 0.44 * down
    plan.spot[:, 1] = -0.40 * down
    plan.lean, plan.nod = 0.7 * rise - 0.06 * down, -0.2 * rise
    plan.ahead[:] = (0.6 * rise + 0.55 * down)[:, None]
    plan.elbows[:] = (0.25 + 0.7 * down)[:, None]
    plan.ahead[:, 0] += 1.3 * _ease(t, 1.9, 2.7)
    return plan


def kneel(t: np.ndarray) -> Plan:
    """A step back with the right foot, down on that knee, a look down; up again at the end."""
    plan, down = Plan(t), _there_and_back(t, 0.7, 2.3, 0.9)
    back = _ease(t, 0.1, 0.7)
    plan.feet[:, 1, 2] = -0.55 * back
    plan.feet[:, 1, 1] = 0.08 * np.sin(np.pi * back) ** 2
    plan.heels[:, 1] = 0.3 * back + 0.9 * down
    plan.tall -= 0.06 * back + 0.42 * down
    plan.spot[:, 1] = -0.2 * back - 0.06 * down
    plan.lean, plan.nod = 0.25 * down, 0.3 * down
    plan.ahead[:, 0] = 0.9 * down
    plan.elbows[:, 0] = 0.25 + 0.7 * down
    return plan


def reach(t: np.ndarray) -> Plan:
    """Both arms up over the head, then one, on tiptoe for a moment."""
    plan, high = Plan(t), _there_and_back(t, 0.2, 2.2, 0.9)
    plan.ahead[:, 0] = 2.8 * high
    plan.ahead[:, 1] = 2.7 * _there_and_back(t, 0.5, 1.3, 0.8)
    plan.elbows[:] = 0.15
    plan.heels[:] = (0.5 * _there_and_back(t, 0.9, 1.7, 0.5))[:, None]
    plan.tall += 0.06 * _there_and_back(t, 0.9, 1.7, 0.5)
    plan.bend, plan.nod = -0.12 * high, -0.35 * high
    return plan


def jump(t: np.ndarray) -> Plan:
    """Crouches, jumps with the arms, lands softly; twice."""
    plan, lap = Plan(t), t % 1.6
    air = ((lap - 0.65) / 0.45).clip(0, 1)
    crouch = _ease(lap, 0.0, 0.35) - _ease(lap, 0.45, 0.65) + 0.7 * (_ease(lap, 1.08, 1.2) - _ease(lap, 1.25, 1.6))
    plan.flight = 4 * 0.25 * air * (1 - air)
    plan.tall -= 0.26 * crouch
    plan.spot[:, 1] = -0.08 * crouch
    plan.lean, plan.nod = 0.55 * crouch, -0.3 * crouch
    plan.heels[:] = (0.9 * np.sin(np.pi * air) ** 2)[:, None]
    plan.ahead[:] = (2.3 * (_ease(lap, 0.4, 0.75) - _ease(lap, 0.9, 1.2)) - 0.6 * crouch)[:, None]
    return plan


def lie(t: np.ndarray) -> Plan:
    """Down to the floor behind the feet, and back until the back lies on it, knees up; then an arm goes up."""
    plan, sink, back = Plan(t), _ease(t, 0.1, 1.2), _ease(t, 1.0, 2.2)
    curl = _there_and_back(t, 0.1, 1.2, 0.8)
    plan.tall -= 0.86 * sink
    plan.spot[:, 1] = -0.52 * sink
    plan.lean = 0.5 * curl - 1.5 * back
    plan.bend, plan.nod = 0.4 * curl, 0.3 * curl
    plan.ahead[:] = (0.9 * curl)[:, None]
    plan.up[:] = (0.6 * back)[:, None]
    plan.ahead[:, 0] += 1.4 * _ease(t, 2.3, 3.0)
    plan.elbows[:] = 0.2
    return plan


MOTIONS: dict[str, Callable[[np.ndarray], Plan]] = {
    made.__name__: made
    for made in (turn, turn_back, turn_fast, turn_stopping, turn_fro, walk_toward, walk_away, walk_across)
    + (squat, bend, sit, kneel, reach, jump, lie)
}
