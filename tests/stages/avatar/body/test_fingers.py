import numpy as np
import pytest
import torch

from stages.avatar.body.fingers import bent_skin, finger_bones, finger_joints, flat_hands, from_flat
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import Body, rest_relative_transforms
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import FINGER_NAMES

LEFT_INDEX = [FINGER_NAMES.index(f"left_index{part}") for part in (1, 2, 3)]


@pytest.fixture(scope="module")
def free():
    model = read_body_model()
    body, rig = Body(model, torch.float64), read_hands_face(model)
    assert rig is not None
    vertices, joints = body.rest(torch.zeros(10, dtype=torch.float64))
    return body, rig, vertices, joints, *finger_joints(rig, vertices)


def posed(free, hands):
    """The body's vertices [V,3] in the T-pose with those hands [2,15,3]."""
    body, rig, vertices, _, fingers, _ = free
    bones = torch.eye(4, dtype=torch.float64).expand(24, 4, 4)
    all_bones = torch.cat([bones, finger_bones(fingers, hands, bones)])
    own = torch.as_tensor(rig.finger_weights).double()
    limbs = body.lbs_weights.clone()
    limbs[:, 22:24] -= own.unflatten(1, (2, 15)).sum(2)
    blend = (torch.cat([limbs, own], 1) @ all_bones[:, :3].flatten(1)).unflatten(1, (3, 4))
    return (blend[..., :3] @ vertices[..., None])[..., 0] + blend[..., 3]


def test_fingers_lie_in_the_hands_and_their_order_is_smplx(free):
    """From the little finger to the thumb hands spread ahead, left and right alike; the tips lie beyond the last joint."""
    *_, joints, tips = free
    hands = joints.reshape(2, 5, 3, 3)
    assert (hands[0, :, 0] - hands[1, :, 0] * torch.tensor([-1.0, 1, 1])).abs().max() < 1e-3
    pinky, ring, middle, index, thumb = hands[0, [2, 3, 1, 0, 4], 0]
    ahead = torch.stack([pinky, ring, middle, index])[:, 2]
    assert (ahead.diff() > 0.01).all() and thumb[0] < pinky[0] - 0.03
    assert (tips.reshape(2, 5, 3)[..., 0].abs() > hands[..., -1, 0].abs() + 0.01).all()


def test_an_index_finger_bends_alone(free):
    hands = torch.zeros(2, 15, 3, dtype=torch.float64)
    hands[0, LEFT_INDEX, 2] = -1.0
    moved = (posed(free, hands) - free[2]).norm(dim=1)
    own = torch.as_tensor(free[1].finger_weights[:, LEFT_INDEX].sum(1) > 0)
    assert moved[own].max() > 0.05 and moved[~own].max() < 1e-6 and own.sum() > 50
    down = posed(free, hands)[own][:, 1].min() - free[2][own][:, 1].min()
    assert down < -0.01  # the left hand's palm looks down


def test_hands_at_rest_go_with_the_wrist(free):
    _, _, _, joints, fingers, _ = free
    rotations = matrix_from_rotvec(torch.randn(24, 3, generator=torch.Generator().manual_seed(0)).double())
    bones = rest_relative_transforms(joints, rotations, free[0].parents)
    found = finger_bones(fingers, torch.zeros(2, 15, 3).double(), bones).reshape(2, 15, 4, 4)
    assert (found - bones[22:24, None]).abs().max() < 1e-12


def test_flat_hands_are_flat_and_smplx_bends_go_on_from_there(free):
    *_, joints, tips = free
    eye = torch.eye(4, dtype=torch.float64).expand(24, 4, 4)

    def ways(hands):
        bones = finger_bones(joints, hands, eye).reshape(10, 3, 4, 4)
        ends = torch.cat([joints.reshape(10, 3, 3)[:, 1:], tips[:, None]], 1) - joints.reshape(10, 3, 3)
        way = (bones[..., :3, :3] @ ends[..., None])[..., 0]
        return (way / way.norm(dim=-1, keepdim=True)).reshape(2, 5, 3, 3)[:, :4]

    flat = flat_hands(joints, tips)
    assert ways(torch.zeros_like(flat))[..., 1].abs().min() > 0.15 and ways(flat)[..., 1].abs().max() < 1e-9
    assert (from_flat(torch.zeros_like(flat), joints, tips) - flat).abs().max() < 1e-9
    bent = torch.zeros_like(flat)
    bent[0, LEFT_INDEX[1], 2] = -torch.pi / 2
    below = ways(from_flat(bent, joints, tips))[0, 0]
    assert below[0, 1].abs() < 1e-9 and np.allclose(below[1:, 1], -ways(flat)[0, 0, 1:, 0], atol=1e-2)


def test_gradients_are_right(free):
    _, _, _, _, joints, _ = free
    bones = torch.eye(4, dtype=torch.float64).repeat(24, 1, 1)
    hands = torch.randn(2, 15, 3, generator=torch.Generator().manual_seed(1)).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda h: finger_bones(joints, h, bones)[::4, :3, 3], hands, fast_mode=True)


def test_bent_skin_is_the_skinned_body(free):
    hands = 0.5 * torch.randn(2, 15, 3, generator=torch.Generator().manual_seed(1)).double()
    bent = bent_skin(free[1], free[2], hands)
    assert torch.allclose(bent, posed(free, hands), atol=1e-5) and (bent - free[2]).norm(dim=1).max() > 0.02
    assert torch.equal(bent_skin(free[1], free[2], 0 * hands), free[2])
