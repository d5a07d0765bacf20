from dataclasses import replace

import numpy as np

from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import FACE_NAMES, FINGER_NAMES, face_names


def test_the_free_body_has_fingers_and_a_face_of_its_size():
    body = read_body_model()
    rig, large = read_hands_face(body), read_hands_face(body.sized(1.5))
    assert rig is not None and large is not None
    assert rig.finger_regressor.shape == (len(FINGER_NAMES) + 10, 6890) and len(rig.face_shapes) == len(FACE_NAMES)
    assert np.allclose(rig.finger_regressor.sum(1), 1, atol=1e-5)
    assert (rig.finger_weights.sum(1) <= body.lbs_weights[:, 22:24].sum(1) + 1e-3).all()
    assert np.allclose(large.face_points, 1.5 * rig.face_points, rtol=1e-4)
    assert rig.sized(np.float64(1.5)).face_shapes.dtype == np.float32 == rig.face_shapes.dtype


def test_shapes_have_names_and_those_of_a_body_itself_numbers():
    assert face_names(52) == FACE_NAMES and face_names(54)[51:] == ("tongueOut", "expression1", "expression2")


def test_an_smpl_model_has_neither():
    assert read_hands_face(replace(read_body_model(), name="SMPL")) is None
