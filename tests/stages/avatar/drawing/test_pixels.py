"""Drawing what training left: colours over a background, coverage, and a person at a pose."""

import numpy as np
import pytest
import torch

from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import sh_from_rgb
from tests.made.learned import draw

CAMERA = Camera.of(np.eye(4), np.array([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), 40, 30)


def spot(place, rgb, size=0.1):
    sh = sh_from_rgb(torch.tensor([[rgb]]))
    return Splats(torch.tensor([place]), size * torch.eye(3)[None], torch.tensor([0.98]), sh)


def test_the_background_shows_where_nothing_covers_it():
    for background in (0.0, 1.0):
        image, alpha = draw(spot([0.0, 0, 2], [0.8, 0.2, 0.1]), None, CAMERA, background)
        assert image.shape == (30, 40, 3) and alpha.shape == (30, 40) and image.dtype == np.float32
        assert alpha[15, 20] > 0.9 and alpha[0, 0] == 0
        assert (image[0, 0] == background).all()
        covered = image - (1 - alpha[..., None]) * background
        np.testing.assert_allclose(covered[15, 20] / alpha[15, 20], [0.8, 0.2, 0.1], atol=1e-4)


def test_person_and_scene_hide_each_other_by_depth():
    near, far = spot([0.0, 0, 2], [1.0, 0, 0]), spot([0.0, 0, 3], [0.0, 0, 1.0], 0.3)
    for human, scene in ((near, far), (far, near)):
        image, _ = draw(human, scene, CAMERA)
        assert image[15, 20, 0] > 0.9 and image[15, 20, 2] < 0.1, "the nearer one wins, whichever set it is of"
    alone, _ = draw(None, far, CAMERA)
    assert alone[15, 20, 2] > 0.9


def test_b16_bytes_are_rounded_and_clipped_but_never_made_of_nan():
    assert to_uint8(np.array([-0.2, -0.01, 0, 0.5, 0.9999, 1.004, 1.7])).tolist() == [0, 0, 0, 128, 255, 255, 255]
    with pytest.raises(ValueError, match="2 values"):
        to_uint8(np.array([0.1, np.nan, np.inf]))
