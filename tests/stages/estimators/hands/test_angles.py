"""What the angles of a hand do, against the skinning's own finger bones."""

import numpy as np
import torch

from stages.avatar.body.fingers import finger_bones, finger_joints
from tests.made.hands import MODEL, RIG, hand, waving


def test_the_angles_of_rest_turn_nothing_and_a_fist_closes():
    bones = hand()
    assert torch.allclose(bones.rotvecs(bones.rest), torch.zeros(15, 3), atol=1e-6)
    fist = bones.rest.clone()
    for joint, angle in ((1, 1.4), (2, 1.7), (3, 0.9)):
        fist[joint:16:4] = angle
    open_, closed = bones.points(bones.rest)[:4, 2], bones.points(fist)[:4, 2]
    assert (open_.norm(dim=1) > 0.055).all() and (closed.norm(dim=1) < 0.045).all()
    assert (bones.points(fist)[:4, 0, 1] < -0.015).all()  # the palm looks down


def test_turns_move_the_bodys_bones_as_the_angles_say():
    """The ends of bones by finger_bones, with the turns that are written, are those of the angles."""
    angles = waving(5)
    joints, tips = finger_joints(RIG, torch.tensor(MODEL.v_template))
    turns = torch.stack([torch.zeros(5, 15, 3), hand().rotvecs(angles)], 1)
    moved = finger_bones(joints, turns, torch.eye(4).expand(24, 4, 4))[:, 15:].reshape(5, 5, 3, 4, 4)
    ends = torch.cat([joints[15:].reshape(5, 3, 3)[:, 1:], tips[5:, None]], 1)
    posed = (moved[..., :3, :3] @ ends[..., None])[..., 0] + moved[..., :3, 3]
    want = hand().points(angles) + joints[15:].reshape(5, 3, 3)[:, :1]
    assert torch.allclose(posed, want, atol=1e-5) and float((posed - ends).norm(dim=-1).max()) > 0.03


def test_every_angle_moves_its_own_finger_alone():
    bones = hand()
    still = bones.points(bones.relaxed)
    for angle in range(21):
        moved = bones.relaxed.clone()
        moved[angle] += 0.2
        fingers = np.flatnonzero((bones.points(moved) - still).norm(dim=-1).amax(1).numpy() > 1e-6)
        assert fingers.tolist() == [min(angle // 4, 4)]
