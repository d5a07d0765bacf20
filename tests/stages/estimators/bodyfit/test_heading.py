"""Frames that contradict how the person turns are left out, and those of any even or uneven turn stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import LandmarkEvidence, mirrored_columns
from stages.estimators.bodyfit.heading import drop_turned

TIMES, LAP = np.arange(80) / 13, 2 * np.pi
TRUNK = {
    "left_shoulder": (0.18, -0.5, 0.02),
    "right_shoulder": (-0.18, -0.5, -0.02),
    "left_hip": (0.1, 0.0, 0.0),
    "right_hip": (-0.1, 0.0, 0.0),
}
LIMBS = {
    "left_elbow": (0.24, -0.22, 0.05),
    "right_elbow": (-0.24, -0.22, 0.0),
    "left_knee": (0.12, 0.42, -0.05),
    "right_knee": (-0.12, 0.42, -0.02),
}


def turning(
    yaw: Callable[[np.ndarray], np.ndarray], wrong: tuple[int, ...] = (), alone: bool = False
) -> LandmarkEvidence:
    """Somebody with `yaw`(times) rad, seen 2 cm off, and in the `wrong` frames, or the trunk `alone`, as from the other side."""
    sine, cosine = np.sin(yaw(TIMES)), np.cos(yaw(TIMES))
    turns = np.stack([cosine, 0 * sine, sine, 0 * sine, 1 + 0 * sine, 0 * sine, -sine, 0 * sine, cosine], 1)
    names = (*TRUNK, *LIMBS)
    world = np.array(list((TRUNK | LIMBS).values())) @ turns.reshape(-1, 3, 3).mT
    rng = np.random.default_rng(0)
    world += np.concatenate([rng.normal(0, 0.02, (len(TIMES), 4, 3)) for _ in (TRUNK, LIMBS)], 1)
    part = np.arange(len(TRUNK) if alone else len(names))
    world[np.ix_(wrong, part)] = world[np.ix_(wrong, mirrored_columns(names)[part])] * [1, 1, -1]
    flat = np.ones(world.shape[:2])
    return LandmarkEvidence(names, world[..., :2], flat, world, np.ones(80, bool), 2 * flat[:, 0])


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


@pytest.mark.parametrize("seconds", [3, 6, 12, np.inf])
@pytest.mark.parametrize("wrong", [range(14, 19), range(20, 34), range(40, 70)])
def test_a_trunk_that_alone_faces_the_other_way_is_left_out_however_long_it_does(seconds, wrong):
    yaw = 0.5 + LAP / seconds * TIMES
    _, turned = drop_turned(turning(lambda t: yaw, tuple(wrong), alone=True), TIMES)
    off = abs(np.angle(np.exp(1j * (np.pi - 2 * yaw))))
    assert turned[[i for i in wrong if off[i] > np.radians(75)]].all() and set(np.flatnonzero(turned)) <= set(wrong)


def test_arms_and_legs_whose_depth_nobody_saw_say_nothing_of_the_trunk():
    evidence = turning(lambda t: 0 * t, (30,), alone=True)
    deep = np.ones(evidence.weight.shape, bool)
    assert drop_turned(replace(evidence, deep=deep), TIMES)[1].sum() == 1
    deep[:, len(TRUNK) :] = False
    flat = replace(turning(lambda t: 0 * t), deep=deep)
    torn = replace(
        flat, world=np.where(np.arange(len(flat.names))[:, None] < len(TRUNK), flat.world, flat.world[:, ::-1])
    )
    assert not drop_turned(torn, TIMES)[1].any()


@pytest.mark.parametrize("seen", [0, 1])
def test_a_clip_that_hardly_shows_anybody_has_no_turn(seen):
    evidence = turning(lambda t: t)
    assert not drop_turned(replace(evidence, seen=np.arange(80) < seen), TIMES)[1].any()
