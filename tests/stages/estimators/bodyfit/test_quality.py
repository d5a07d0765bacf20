"""How well a body fits is a possible number, wherever its landmarks fall."""

from __future__ import annotations

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.quality import measure_quality
from stages.formats.body_model import read_body_model
from stages.records import BodyPoses, Cameras

NAMES = ("000000", "000001")


@pytest.mark.parametrize("away", [0.0, 2.0, 1e6, 1e150, np.inf])
def test_landmarks_are_no_farther_off_than_a_picture_is_wide(away):
    cameras = Cameras(NAMES, np.tile(np.eye(4), (2, 1, 1)), np.tile(np.diag([300.0, 300, 1]), (2, 1, 1)), 320, 240)
    xy = np.full((2, 5, 2), 100.0)
    evidence = LandmarkEvidence(
        tuple("abcde"), xy, np.ones((2, 5)), np.zeros((2, 5, 3)), np.ones(2, bool), np.full(2, 90.0)
    )
    pixels = xy + [[[away, 0]], [[0, 0]]]
    poses = BodyPoses(NAMES, np.zeros(10), np.zeros((2, 3)), np.zeros((2, 69)), np.zeros((2, 3)), np.ones(2))
    found = measure_quality(poses, read_body_model(), cameras, np.arange(2.0), None, evidence, pixels)
    assert found.error_px.tolist() == [min(away, 400.0), 0.0]
    assert found.confidence[1] == 1 and (found.confidence[0] < 0.5) == (away > 2)
