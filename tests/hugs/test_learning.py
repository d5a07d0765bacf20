"""`hugs.train`: arrays that do not fit are refused by name; a training on some is run with the examples."""

import numpy as np
import pytest

import hugs
from tests.made import tiny
from tests.made.said import holds


@pytest.fixture(scope="module")
def arrays():
    poses, count = tiny.make_poses(), tiny.FRAMES
    return {
        "images": np.zeros((count, tiny.HEIGHT, tiny.WIDTH, 3), np.uint8),
        "masks": np.zeros((count, tiny.HEIGHT, tiny.WIDTH), bool),
        "viewmats": tiny.make_viewmats(),
        "Ks": np.tile(np.eye(3), (count, 1, 1)),
        "body_pose": poses.body_pose.reshape(count, 23, 3),
        "global_orient": poses.global_orient,
        "transl": poses.transl,
    }


@pytest.mark.parametrize(
    ("name", "value", "facts"),
    [
        ("images", np.zeros((8, 128, 96, 3)), ("float64", "uint8")),
        ("masks", np.zeros((7, 128, 96), bool), ("[7, 128, 96]", "[8,128,96]")),
        ("body_pose", np.zeros((8, 72)), ("72", "[8,69]")),
        ("transl", np.full((8, 3), np.nan), ("finite", "8 rows")),
        ("heldout", np.zeros(8), ("bool",)),
        ("body_model", "smpl.npz", ("smpl.npz",)),
        ("masks", np.zeros((8, 128, 96), bool), ("masks", "empty")),
    ],
)
def test_what_does_not_fit_is_refused_by_name(arrays, name, value, facts):
    with pytest.raises(hugs.StageError) as refused:
        hugs.train(**arrays | {name: value}, progress=lambda now: None)
    assert holds(str(refused.value), *facts) and (name in str(refused.value) or name == "body_model")
