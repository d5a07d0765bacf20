"""Which vertices of a posed body the body itself hides."""

from __future__ import annotations

import numpy as np

from stages.estimators.bodyfit.posed import seen_vertices
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES

MODEL = read_body_model()
K = np.array([[500.0, 0, 200], [0, 500, 300], [0, 0, 1]])


def test_the_front_is_seen_and_the_back_is_not():
    body = MODEL.v_template * [1, -1, -1] + [0, 0, 3.0]  # looks at the camera
    trunk = np.flatnonzero(MODEL.lbs_weights[:, JOINT_NAMES.index("spine2")] > 0.5)
    side = MODEL.v_template[trunk, 2] - MODEL.v_template[trunk, 2].mean()
    front, back = trunk[side > 0.04], trunk[side < -0.04]
    seen = seen_vertices(
        np.stack([body, body * [1, 1, 0] + [0, 0, -3.0]]), MODEL.faces, np.stack([K, K]), np.r_[front, back]
    )
    assert seen[0, : len(front)].mean() > 0.95 and seen[0, len(front) :].mean() < 0.05
    assert seen.shape == (2, len(front) + len(back)), "a body behind the camera is no crash"
