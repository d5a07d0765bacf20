import numpy as np
import pytest
import torch

from stages.avatar.body.face import face_at, face_vector
from stages.avatar.body.smpl import Body
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import FACE_NAMES


@pytest.fixture(scope="module")
def free():
    model = read_body_model()
    return Body(model), read_hands_face(model)


def shape(rig, name):
    return rig.face_points, rig.face_shapes[FACE_NAMES.index(name)]


def test_shapes_move_what_they_are_called_after(free):
    """The jaw opens the lower half, a blink closes its own eye, a smile lifts one corner."""
    points, jaw = shape(free[1], "jawOpen")
    lowest = jaw[:, 1].argmin()
    middle = (points[:, 1].min() + points[:, 1].max()) / 2
    assert jaw[lowest, 1] < -0.02 and points[lowest, 1] < middle and np.abs(jaw[points[:, 1] > middle]).max() < 0.005
    for name, sign in (("eyeBlinkLeft", 1), ("eyeBlinkRight", -1), ("mouthSmileLeft", 1), ("mouthSmileRight", -1)):
        points, moves = shape(free[1], name)
        far = np.linalg.norm(moves, axis=1)
        assert far[sign * points[:, 0] > 0].max() > 0.006 > 3 * far[sign * points[:, 0] < -0.02].max()


def test_the_face_lies_on_the_head_of_any_shape(free):
    body, rig = free
    for size in (-2.0, 2.0):
        betas = torch.tensor([size] + [0.0] * 9)
        vertices, _ = body.rest(betas)
        points = face_at(rig, body.v_template, body.shapedirs, betas)
        # eyes lie up to 12 mm behind the lids; 90 % is skin
        assert torch.cdist(points, vertices).amin(1).quantile(0.9) < 0.006


def test_coefficients_have_names():
    assert face_vector({"jawOpen": 0.4})[FACE_NAMES.index("jawOpen")] == 0.4
    with pytest.raises(ValueError, match="jawopen"):
        face_vector({"jawopen": 0.4})
