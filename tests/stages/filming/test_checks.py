"""People in each other and under the floor are seen before anything is drawn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.avatar.effects.shadow import Casters
from stages.filming.cast import cast
from stages.filming.checks import SUNK, TOUCH, faults_of, lowest, overlap
from stages.filming.spec import Person
from stages.formats.ground import read_ground
from stages.records import Ground
from tests.made.said import holds

LEVEL = Ground(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), 1, 0, 0, 0, "")


def ball(x: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A hollow ball: its points' covariance is a third of radius^2."""
    return np.array([[x, 0.5, 0]]), np.eye(3)[None] * radius**2 / 3


def test_balls_are_as_deep_in_each_other_as_they_are():
    assert overlap(ball(0, 0.2), ball(0.25, 0.1)) == pytest.approx(0.05)
    assert overlap(ball(0, 0.2), ball(1, 0.1)) == pytest.approx(-0.7)
    assert lowest(*ball(0, 0.6), LEVEL) == pytest.approx(-0.1)


def stand_at(run, ground, **more):
    return cast(Person(avatar=run, **more), "x", ground, 30.0, "cpu")


def test_people_who_stand_apart_are_no_fault_and_people_in_each_other_are_named(tiny):
    run = tiny["train"].parent
    ground = read_ground(tiny["smpl"] / "ground.json")
    here = replace(stand_at(run, ground, motion="wave"), name="ann")
    near, far = (stand_at(run, ground, motion="wave", at=(x, 0)) for x in (0.25, 2.0))
    assert faults_of([here, replace(far, name="bob")], ground, 30, 30.0) == []
    (fault,) = faults_of([here, replace(near, name="bob")], ground, 30, 30.0)
    assert fault.startswith("ann and bob") and holds(fault, "cm") and fault.endswith(" s")
    assert 5 < float(fault.split(" by ")[1].split(" cm")[0]) < 40


def test_a_person_under_the_floor_is_named_with_the_distance(tiny):
    run = tiny["train"].parent
    ground = read_ground(tiny["smpl"] / "ground.json")
    sunk = stand_at(run, replace(ground, point=ground.point - 0.3 * ground.up), motion="wave")
    (fault,) = faults_of([replace(sunk, name="ann")], ground, 30, 30.0)
    assert holds(fault, "ann", "under", "floor") and abs(float(fault.split(" by ")[1].split(" cm")[0]) - 30) < 4


def of_balls(name: str, *balls: tuple[np.ndarray, np.ndarray]) -> SimpleNamespace:
    parts = Casters(*(torch.as_tensor(np.concatenate(part)) for part in zip(*balls, strict=True)))
    return SimpleNamespace(name=name, casters=lambda picture: parts)


@pytest.mark.parametrize(("deep", "said"), [(TOUCH - 0.01, False), (TOUCH + 0.01, True)])
def test_a_touch_is_no_fault_and_a_limb_that_is_not_there_touches_nobody(deep, said):
    gone = np.array([[0, 0.5, 0.0]]), np.zeros((1, 3, 3))
    ann, bob = of_balls("ann", ball(0, 0.2)), of_balls("bob", ball(0.4 - deep, 0.2))
    assert bool(faults_of([ann, bob], LEVEL, 1, 30.0)) is said
    below = np.array([[0, -1.0, 0.0]]), np.zeros((1, 3, 3))
    assert faults_of([ann, of_balls("bob", ball(2, 0.2), gone, below)], LEVEL, 1, 30.0) == []
    for sunk in (SUNK - 0.01, SUNK + 0.01):
        low = of_balls("bob", (np.array([[2, 0.2 - sunk, 0]]), ball(0, 0.2)[1]))
        assert bool(faults_of([ann, low], LEVEL, 1, 30.0)) is (sunk > SUNK)
