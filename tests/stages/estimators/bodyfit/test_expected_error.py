"""How far joints are expected to be off: more where less is seen, more along the view than across it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.estimators.bodyfit.evidence import drop_strangers, gather, model_landmarks
from stages.estimators.bodyfit.expected_error import COMMON, LIMB, PIXELS, depth_error
from stages.estimators.bodyfit.fit import fit_body
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips

MODEL = read_body_model()
WRIST, ELBOW, OTHER = (JOINT_NAMES.index(name) for name in ("left_wrist", "left_elbow", "right_wrist"))


@pytest.mark.slow
def test_a_hidden_arm_is_expected_to_be_farther_off_and_depth_farther_than_place():
    clip = bodyfit_clips.make(MODEL, frames=8)
    names, regressor = model_landmarks(MODEL)
    evidence, _ = drop_strangers(gather(clip.tracks, names), None)
    arm = [k for k, name in enumerate(names) if name in ("left_elbow", "left_wrist", "left_hand")]
    weight = evidence.weight.copy()
    weight[:, arm] = 0

    def expected(weight: np.ndarray) -> np.ndarray:
        shown = replace(evidence, weight=weight)
        args = (MODEL, regressor, shown, clip.cameras, clip.times, None, clip.points)
        return fit_body(*args).expected_error[evidence.seen].mean(0)

    seen, hidden = expected(evidence.weight), expected(weight)
    assert seen.shape == (24, 2) and (seen[:, 0] > seen[:, 1]).all() and (seen[:, 0] > 0.9 * COMMON).all()
    assert (hidden[[ELBOW, WRIST]] > 2 * seen[[ELBOW, WRIST]]).any(1).all()
    assert hidden[WRIST, 1] > 3 * hidden[OTHER, 1] and hidden.max() < LIMB
    np.testing.assert_allclose(hidden[OTHER], seen[OTHER], rtol=0.3)


def test_a_camera_that_hardly_travels_knows_less_how_far_away_the_person_is():
    def off(travel: float, moving: bool = True) -> float:
        center = torch.linspace(-1, 1, 9)[:, None] * torch.tensor(
            [travel, 0.0, 0.3]
        )  # and back and forth, which tells nothing
        world = SimpleNamespace(moving=moving, center=center, turn=torch.eye(3).expand(9, 3, 3))
        solver = SimpleNamespace(world=world, K=torch.tensor([[500.0, 0, 0], [0, 500, 0], [0, 0, 1]]).expand(9, 3, 3))
        return depth_error(solver, SimpleNamespace(scale=2.0), torch.tensor([0, 0, 4.0]).expand(9, 24, 3))

    spread = 2.0 * float(torch.linspace(-1, 1, 9).square().mean().sqrt())
    assert off(0.1) == pytest.approx(PIXELS * 16 / (500 * 0.1 * spread), rel=1e-4)
    assert off(0.05) == pytest.approx(2 * off(0.1), rel=1e-4) and off(0.0) > 1e3 and off(0.0, moving=False) == 0
