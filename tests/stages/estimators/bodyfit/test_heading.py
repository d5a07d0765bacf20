"""Frames that contradict how the person turns are left out, and those of any even or uneven turn stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.heading import drop_turned

TIMES, LAP = np.arange(80) / 13, 2 * np.pi
TRUNK = {
    "left_shoulder": (0.18, -0.5, 0.02),
    "right_shoulder": (-0.18, -0.5, -0.02),
    "left_hip": (0.1, 0.0, 0.0),
    "right_hip": (-0.1, 0.0, 0.0),
}


def turning(yaw: Callable[[np.ndarray], np.ndarray], wrong: tuple[int, ...] = ()) -> LandmarkEvidence:
    """Somebody with `yaw`(times) rad, shoulders and hips seen 2 cm off, and in the `wrong` frames as from the other side."""
    sine, cosine = np.sin(yaw(TIMES)), np.cos(yaw(TIMES))
    turns = np.stack([cosine, 0 * sine, sine, 0 * sine, 1 + 0 * sine, 0 * sine, -sine, 0 * sine, cosine], 1)
    world = np.array(list(TRUNK.values())) @ turns.reshape(-1, 3, 3).mT
    world += np.random.default_rng(0).normal(0, 0.02, world.shape)
    world[list(wrong)] = world[list(wrong)][:, [1, 0, 3, 2]] * [1, 1, -1]
    flat = np.ones(world.shape[:2])
    return LandmarkEvidence(tuple(TRUNK), world[..., :2], flat, world, np.ones(80, bool), 2 * flat[:, 0])


@pytest.mark.parametrize(
    "yaw",
    [
        pytest.param(lambda t: LAP / 6 * t, id="once around"),
        pytest.param(lambda t: -LAP * t, id="six times around, the other way"),
        pytest.param(lambda t: np.radians(55) * (1 - np.cos(LAP / 1.6 * t)), id="to and fro"),
        pytest.param(lambda t: LAP / 3 * (t // 1 + np.interp(t % 1, [0, 0.6], [0, 1])), id="with stops"),
        pytest.param(lambda t: 2.5 * (t > 3), id="a cut"),
    ],
)
def test_who_turns_however_they_do_stays_in_all_frames(yaw):
    evidence = turning(yaw)
    kept, turned = drop_turned(evidence, TIMES)
    assert not turned.any() and kept.seen.all() and (kept.weight == evidence.weight).all()


@pytest.mark.parametrize("wrong", [(0,), (33,), (33, 34), (26, 27, 28, 29), (12, 13, 61), (78, 79)])
@pytest.mark.parametrize("seconds", [2, 6, np.inf])
def test_frames_that_face_another_way_than_those_around_are_left_out(seconds, wrong):
    yaw = 0.5 + LAP / seconds * TIMES
    kept, turned = drop_turned(turning(lambda t: yaw, wrong), TIMES)
    off = abs(np.angle(np.exp(1j * (np.pi - 2 * yaw))))  # hardly anything where they are seen from the side
    assert turned[[i for i in wrong if off[i] > np.radians(60)]].all() and set(np.flatnonzero(turned)) <= set(wrong)
    assert not kept.seen[turned].any() and not kept.weight[turned].any() and kept.seen[~turned].all()


@pytest.mark.parametrize("seen", [0, 1])
def test_a_clip_that_hardly_shows_anybody_has_no_turn(seen):
    evidence = turning(lambda t: t)
    assert not drop_turned(replace(evidence, seen=np.arange(80) < seen), TIMES)[1].any()
