"""The axes of a skeleton's joints, as programs that pose by hand expect them."""

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.drawing.rig import rig_of
from stages.formats.body_model import read_body_model
from stages.formats.exchange.skeleton import _axes, skeleton_of
from tests.made.tiny import make_avatar

SKELETON = skeleton_of(rig_of(make_avatar(read_body_model())))


def test_the_third_axis_points_ahead_and_that_of_feet_which_lie_along_it_up():
    np.testing.assert_allclose(np.linalg.det(SKELETON.turns), 1, atol=1e-9)
    lying = [name.endswith(("ankle", "foot")) for name in SKELETON.names]
    assert (SKELETON.turns[lying, 1, 2] > 0.9).all()
    assert (SKELETON.turns[~np.array(lying), 2, 2] > 0.9).all()
    for rise in (-0.3, 0.0, 0.3):
        assert _axes(np.array([0, rise, np.sqrt(1 - rise**2)]))[1, 2] > 0.9, "also of toes that point up"


def test_of_two_quaternions_of_one_rest_turn_the_file_has_that_with_the_real_part_from_0_up():
    nodes = SKELETON.nodes(0)
    assert min(node["rotation"][3] for node in nodes) >= 0
    for joint, (node, parent) in enumerate(zip(nodes, SKELETON.parents.tolist(), strict=True)):
        above = SKELETON.turns[parent] if parent >= 0 else np.eye(3)
        found = above @ Rotation.from_quat(node["rotation"]).as_matrix()
        np.testing.assert_allclose(found, SKELETON.turns[joint], atol=1e-9)
