"""How far joints are expected to be off: more where less is seen, more along the view than across it."""

from __future__ import annotations

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import drop_strangers, gather, model_landmarks
from stages.estimators.bodyfit.expected_error import COMMON, LIMB
from stages.estimators.bodyfit.fit import fit_body
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips

MODEL = read_body_model()
ELBOW, WRIST, HAND, OTHER_ELBOW, OTHER = (
    JOINT_NAMES.index(name) for name in ("left_elbow", "left_wrist", "left_hand", "right_elbow", "right_wrist")
)


@pytest.mark.slow
def test_a_hidden_arm_is_expected_to_be_farther_off_and_depth_farther_than_place(monkeypatch):
    """Of one fit; the other arm, which is seen, is how far the hidden one would be off."""
    bodyfit_clips.take_steps(monkeypatch, 40, 1, 60)
    clip = bodyfit_clips.make(MODEL, frames=8)
    names, regressor = model_landmarks(MODEL)
    evidence, _ = drop_strangers(gather(clip.tracks, names), None)
    arm = [k for k, name in enumerate(names) if name in ("left_elbow", "left_wrist", "left_hand")]
    evidence.weight[:, arm] = 0
    fit = fit_body(MODEL, regressor, evidence, clip.cameras, clip.times, None, clip.points)
    expected = fit.expected_error[evidence.seen].mean(0)
    assert expected.shape == (24, 2) and (expected[:, 0] > 0.9 * COMMON).all() and expected.max() < LIMB
    hidden, seen = expected[[ELBOW, WRIST]], expected[[OTHER_ELBOW, OTHER]]
    assert (np.delete(expected, [ELBOW, WRIST, HAND], 0) @ [1, -1] > 0).all()
    assert (hidden > 2 * seen).any(1).all() and hidden[1, 1] > 3 * seen[1, 1]
