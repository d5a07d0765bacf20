"""How far joints are expected to be off: more where less is seen, more along the view than across it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import drop_strangers, gather, model_landmarks
from stages.estimators.bodyfit.expected_error import COMMON, LIMB
from stages.estimators.bodyfit.fit import fit_body
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips

MODEL = read_body_model()
WRIST, ELBOW, OTHER = (JOINT_NAMES.index(name) for name in ("left_wrist", "left_elbow", "right_wrist"))


@pytest.mark.slow
def test_a_hidden_arm_is_expected_to_be_farther_off_and_depth_farther_than_place(monkeypatch):
    bodyfit_clips.take_steps(monkeypatch, 60, 50, 120)
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
