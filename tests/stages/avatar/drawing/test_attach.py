from dataclasses import replace

import numpy as np
import pytest
import torch

from stages import gestures
from stages.avatar.body.face import face_vector
from stages.avatar.body.fingers import finger_bones, finger_joints
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.attach import FaceSkin, attach
from stages.avatar.drawing.avatar import PosedAvatar, bones_of, gloved, load_avatar, mimed, posed_by
from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import read_avatar, write_splats
from stages.gestures import FINGER_NAMES
from tests.made.learned import pose_avatar
from tests.made.tiny import make_avatar

INDEX = [FINGER_NAMES.index(f"left_index{part}") for part in (1, 2, 3)]
BODY = read_body_model()


@pytest.fixture(scope="module")
def bare():
    return make_avatar(BODY, every=3)


@pytest.fixture(scope="module")
def record(bare):
    return attach(bare, BODY, read_hands_face(BODY))


def pose():
    return [torch.as_tensor(np.random.default_rng(2).normal(0, 0.4, size)).float() for size in (3, 69, 3)]


def test_without_hands_and_face_all_is_as_before_to_the_bit(bare, record):
    ours, theirs = (pose_avatar(load_avatar(one), *pose()) for one in (record, bare))
    assert torch.equal(ours.means, theirs.means) and torch.equal(ours.axes, theirs.axes)
    still = gloved(load_avatar(record))
    rested = posed_by(still, bones_of(still, *pose()[:2], torch.zeros(2, 15, 3)), pose()[2])
    assert (rested.means - theirs.means).abs().max() < 2e-6
    assert (
        torch.equal(still.resting.weights[:, 24:].amax(1) > 0, torch.as_tensor(record.fingers.shares).amax(1) > 0)
        or (still.resting.weights.sum(1) - 1).abs().max() < 1e-3
    )


def test_who_moves_fingers_in_a_clip_is_drawn_in_one_of_its_poses_and_in_others_without(record):
    parts, hands = [torch.stack(2 * [part]) for part in pose()], torch.zeros(2, 2, 15, 3)
    hands[1, 0, INDEX[0], 2] = -1.2
    clip = PosedAvatar.of(load_avatar(record), *parts, hands=hands)
    one = replace(clip.row(1), body_pose=parts[1][:1])
    torch.testing.assert_close(one.splats(0).means, clip.splats(1).means)
    still = PosedAvatar.of(clip.avatar, *pose()).splats(0).means
    torch.testing.assert_close(still, pose_avatar(load_avatar(record), *pose()).means, atol=2e-6, rtol=0)
    assert (still - one.splats(0).means).abs().max() > 0.04


def test_an_index_finger_moves_its_gaussians_and_no_others(record):
    hands = torch.zeros(1, 2, 15, 3)
    hands[0, 0, INDEX[0], 2] = -1.2
    posed = PosedAvatar.of(load_avatar(record), *pose(), hands=hands)
    moved = (posed.splats(0).means - pose_avatar(load_avatar(record), *pose()).means).norm(dim=1).numpy()
    own = np.zeros(len(record), bool)
    own[record.fingers.rows] = record.fingers.shares[:, INDEX].any(1)
    rig = read_hands_face(BODY)
    truth = rig.finger_weights[::3, INDEX].any(1)
    assert np.array_equal(own, truth) and own.sum() > 15
    assert moved[own].max() > 0.04 and moved[~own].max() < 2e-6


def test_hands_that_were_bent_in_the_clip_lie_on_bent_fingers(bare):
    """Gaussians that lie where a fist has its skin are opened by the pose 0 to where they are at rest."""
    rig, body = read_hands_face(BODY), Body(BODY)
    vertices, _ = body.rest(torch.zeros(10))
    fist = torch.zeros(2, 15, 3)
    fist[0, :12, 2], fist[1, :12, 2] = -0.8, 0.8
    bones = finger_bones(finger_joints(rig, vertices)[0], fist, torch.eye(4).expand(24, 4, 4))
    own = torch.as_tensor(rig.finger_weights)
    blend = (own @ bones[:, :3].flatten(1)).unflatten(1, (3, 4))
    bent = (1 - own.sum(1, keepdim=True)) * vertices + (blend[..., :3] @ vertices[..., None])[..., 0] + blend[..., 3]
    step = (bent - vertices)[::3].numpy()  # hands do not move in the canonical pose
    record = attach(replace(bare, means=bare.means + step), BODY, rig, fist.numpy())
    still = [torch.zeros(size) for size in (3, 69, 3)]
    rows = [PosedAvatar.of(load_avatar(record), *still, hands=one[None]).splats(0).means for one in (fist, 0 * fist)]
    plain = pose_avatar(load_avatar(record), *still).means
    assert (rows[0] - plain).abs().max() < 2e-5
    off = (rows[1] - vertices[::3]).norm(dim=1)[np.linalg.norm(step, axis=1) > 0.01]
    assert off.median() < 1e-3 and off.quantile(0.95) < 0.012


def test_a_jaw_opens_and_the_neck_stays(record):
    face = torch.as_tensor(face_vector({"jawOpen": 1.0})).float()[None]
    still = [torch.zeros(size) for size in (3, 69, 3)]
    way = (
        PosedAvatar.of(load_avatar(record), *still, face=face).splats(0).means
        - pose_avatar(load_avatar(record), *still).means
    )
    assert way[:, 1].min() < -0.025 and way[BODY.lbs_weights[::3, 15] < 0.01].abs().max() == 0
    assert 50 < (way.norm(dim=1) > 1e-3).sum() < 0.2 * len(record)


def test_training_moves_a_face_as_the_avatar_does(record):
    """Value, and gradient in the coefficients: it is linear in these."""
    rig, resting = read_hands_face(BODY), load_avatar(record).resting
    mien = FaceSkin.of(rig, Body(BODY), torch.zeros(10)).at(resting.means, resting.weights)
    face = torch.rand(52, generator=torch.Generator().manual_seed(1)).requires_grad_()
    ours, theirs = mien.moved(resting.means, face), mimed(load_avatar(record), face).means
    assert (ours - theirs).abs().max() < 6e-4, "what the avatar's file leaves out"
    assert (ours - resting.means).norm(dim=1).max() > 0.01
    along = torch.randn(ours.shape, generator=torch.Generator().manual_seed(2))
    (slope,) = torch.autograd.grad((ours * along).sum(), face)
    torch.testing.assert_close(slope, mien.moves @ along[mien.rows].flatten(), atol=1e-5, rtol=1e-4)


def test_hands_and_face_keep_in_the_file(record, tmp_path):
    write_splats(tmp_path / "avatar.npz", record)
    back = read_avatar(tmp_path / "avatar.npz")
    assert np.array_equal(back.fingers.rows, record.fingers.rows) and np.allclose(
        back.fingers.joints, record.fingers.joints
    )
    assert np.abs(back.fingers.shares - record.fingers.shares).max() < 1e-3
    assert np.abs(back.face.moves.astype(float) - record.face.moves).max() < 2e-4 and back.face.moves.max() > 0.005
    more = gestures.Face(record.face.rows, np.concatenate([record.face.moves, record.face.moves[:3]]))
    write_splats(tmp_path / "avatar.npz", replace(record, face=more))
    back = read_avatar(tmp_path / "avatar.npz")
    assert len(back.face.moves) == 55 and np.abs(back.face.moves.astype(float) - more.moves).max() < 2e-4


def test_coefficients_of_the_first_shapes_alone_leave_the_others_at_rest(record):
    mien, face = load_avatar(record).face, torch.zeros(52)
    face[24] = 1
    means = load_avatar(record).resting.means
    assert torch.equal(mien.moved(means, face[:25]), mien.moved(means, face))


@pytest.mark.parametrize("count", [51, 10**9])
def test_a_face_of_too_few_or_too_many_shapes_is_refused(record, tmp_path, count):
    write_splats(tmp_path / "avatar.npz", record)
    np.savez(tmp_path / "a.npz", **dict(np.load(tmp_path / "avatar.npz")) | {"face_count": count})
    with pytest.raises(StageError, match=rf"(?s)face_count.*{count} shapes.*52"):
        read_avatar(tmp_path / "a.npz")


@torch.no_grad()
def gap(record, hands, face, along):
    avatar = gloved(load_avatar(record))
    return (posed_by(avatar, bones_of(avatar, *pose()[:2], hands), pose()[2], face).means * along).sum()


def test_gradients_are_finite_differences(record, held):
    rng = torch.Generator().manual_seed(3)
    hands, face = 0.3 * torch.randn(2, 15, 3, generator=rng), torch.rand(52, generator=rng)
    along, way, away = (
        torch.randn(len(record), 3, generator=rng),
        torch.randn(2, 15, 3, generator=rng),
        torch.randn(52, generator=rng),
    )
    avatar, given = gloved(load_avatar(record)), [hands.clone().requires_grad_(), face.clone().requires_grad_()]
    (posed_by(avatar, bones_of(avatar, *pose()[:2], given[0]), pose()[2], given[1]).means * along).sum().backward()
    for own, turn, mien, step in ((given[0].grad, way, 0 * away, 1e-2), (given[1].grad, 0 * way, away, 0.1)):
        there, back = (gap(record, hands + sign * step * turn, face + sign * step * mien, along) for sign in (1, -1))
        slope = (own * (way if turn.any() else away)).sum()
        held(((there - back) / (2 * step) - slope).abs() / slope.abs(), 2e-2)
