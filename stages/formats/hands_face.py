"""Finger bones and face of a body: those of the free body are in hands_face.npz, which comes with the program."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.formats.arrays import read_npz
from stages.formats.body_model import FREE, FREE_BODY
from stages.gestures import HandsFace
from stages.records import BodyModel

HANDS_FACE = Path(__file__).parent.parent / "estimators" / "hands_face.npz"


def read_hands_face(body: BodyModel) -> HandsFace | None:
    """Fingers and face of a `body`: SMPL-H has no points of a face; None for SMPL, which has neither."""
    if body.name != FREE:
        return body.fingers
    arrays, count = read_npz(HANDS_FACE), len(body.v_template)
    weights = np.zeros((count, arrays["finger_weights"].shape[1]), np.float32)
    weights[arrays["hand_vertices"]] = arrays["finger_weights"]
    own = read_npz(FREE_BODY, only=["v_template"])["v_template"]
    size = np.ptp(body.v_template[:, 1]) / np.ptp(own[:, 1])  # see `BodyModel.sized`
    shapes = arrays["face_shapes"].astype(np.float32)
    return HandsFace(arrays["finger_regressor"], weights, arrays["face_points"], shapes).sized(size)
