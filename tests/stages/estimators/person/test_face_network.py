"""The face network on pictures of no face; what it says of faces is tested in `detectors/test_face.py`."""

import numpy as np
import pytest

from stages.estimators.person.crops import Roi
from stages.estimators.person.face_network import MARGINS, FaceNetwork
from tests.made.networks import fetched

FACE = Roi(100, 90, 80, 0.2)


@pytest.fixture
def network():
    fetched("face_landmark.tflite")
    return FaceNetwork()


@pytest.mark.parametrize("which", [0, 1])
def test_a_face_is_there_if_the_tight_and_the_wide_crop_show_it(network, monkeypatch, which):
    def seen(image, roi):
        assert (roi.x, roi.y, roi.angle) == (FACE.x, FACE.y, FACE.angle)
        return 0.2 if roi.side == pytest.approx(MARGINS[which] * FACE.side) else 0.9

    monkeypatch.setattr(network, "_look", seen)
    assert network.presence(np.zeros((9, 9, 3), np.uint8), FACE) == 0.2


def test_noise_and_nothing_are_no_face(network):
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3)).astype(np.uint8)
    for image in (noise, 0 * noise, 0 * noise + 255):
        assert 0 < network.presence(image, FACE) < 0.1
