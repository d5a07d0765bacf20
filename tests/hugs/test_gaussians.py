"""Gaussians and people from Python: arrays or tensors that mean what they say."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import hugs
from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import load_avatar
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import write_splats
from stages.gestures import FACE_NAMES
from tests.made.clothes import dress, some_clothes
from tests.made.learned import pose_avatar
from tests.made.tiny import make_avatar

RNG = np.random.default_rng(0)
POSE = RNG.normal(0, 0.3, 69)


@pytest.fixture(scope="module")
def record():
    body = read_body_model()
    return attach(dress(make_avatar(body, every=40), some_clothes()), body, read_hands_face(body))


@pytest.fixture(scope="module")
def avatar(record, tmp_path_factory):
    path = tmp_path_factory.mktemp("hugs") / "avatar.npz"
    write_splats(path, record)
    return hugs.load(path)


def test_a_posed_person_in_arrays(avatar, record, held):
    person = avatar.pose(POSE, [0, 0.5, 0], transl=(1, 2, 3))
    tensors = (torch.as_tensor(part, dtype=torch.float32) for part in ([0, 0.5, 0], POSE, [1, 2, 3]))
    truth = pose_avatar(load_avatar(record), *tensors)
    np.testing.assert_allclose(person.means, truth.means, atol=1e-6)
    axes = matrix_from_quat(torch.as_tensor(person.quats)) * torch.as_tensor(person.scales)[:, None]
    held((axes @ axes.mT - truth.axes @ truth.axes.mT).abs().max(), 1e-7)
    held(np.abs(person.axes - truth.axes.numpy()).max(), 1e-7)
    np.testing.assert_array_equal(person.opacities, truth.opacities)
    np.testing.assert_allclose(person.colors, truth.colors(torch.zeros(3)), atol=1e-6)
    assert person.sh.shape == (person.count, 1, 3)
    parts = person.means, person.quats, person.scales, person.colors, person.joints, person.vertices
    assert {(type(part), part.dtype) for part in parts} == {(np.ndarray, np.dtype("f4"))}


@pytest.mark.parametrize("taught", [False, True])
@pytest.mark.parametrize("view_dependent", [False, True])
def test_poses_together_are_each_by_itself_in_tensors(taught, view_dependent, avatar, held):
    """With gradients pose by pose, without in one pass; rotations only where colours have a direction."""
    if view_dependent:
        avatar = avatar.changed(sh=torch.randn(len(avatar.record), 4, 3))
    poses = torch.as_tensor(RNG.normal(0, 0.3, (9, 23, 3))).requires_grad_(taught)
    places = torch.as_tensor(RNG.normal(0, 1, (9, 3)))
    person = avatar.pose(poses, transl=places)
    assert len(person) == 9 and person.means.shape == (9, person.count, 3) and person.joints.shape == (9, 24, 3)
    for row in (0, 8):
        for alone in (avatar.pose(poses[row], transl=places[row]), person[row]):
            for name in ("means", "axes", "joints", "vertices"):
                held((getattr(person, name)[row] - getattr(alone, name)).abs().max(), 3e-6, name)
            held((person.sets[row].normals - alone.sets[0].normals).detach().abs().max(), 3e-6, "normals")
            ours, its = person.sets[row].rotations, alone.sets[0].rotations
            assert (ours is not None) == view_dependent and (ours is None or (ours - its).abs().max() < 3e-6)
            assert person.sets[row].means.requires_grad == taught
    with pytest.raises(IndexError):
        person[9]


def test_joints_and_vertices_are_those_of_the_body(avatar, held):
    """The free body is known by its joints; its joints are those that the avatar's bones carry."""
    betas = torch.linspace(-1, 1, 10)
    person = avatar.pose(torch.as_tensor(POSE), [0.1, 2, 0], [1, 2, 3], betas)
    turned = torch.tensor([[0.1, 2, 0]]), torch.as_tensor(POSE).float()[None], torch.tensor([[1.0, 2, 3]])
    vertices, joints = Body(read_body_model())(betas, *turned)
    held((person.vertices - vertices[0]).abs().max(), 1e-6)
    held((person.joints - joints[0]).abs().max(), 3e-6)
    assert avatar.faces.max() == len(vertices[0]) - 1


def test_in_another_shape_gaussians_go_with_the_skin_under_them(record, tmp_path):
    write_splats(tmp_path / "bare.npz", make_avatar(read_body_model(), every=40))
    bare = hugs.load(tmp_path / "bare.npz")
    betas = torch.tensor([3.0, -2, 0, 0, 0, 0, 0, 0, 0, 0], requires_grad=True)
    own, other = bare.pose(torch.zeros(69)), bare.pose(torch.zeros(69), betas=betas)
    vertices = own.vertices[::40], other.vertices[::40]  # there the Gaussians are
    moved = other.means - own.means
    assert moved.norm(dim=1).mean() > 0.03 and (moved - vertices[1] + vertices[0]).norm(dim=1).max() < 0.01
    other.means.square().sum().backward()
    assert betas.grad.abs().min() > 0
    same = bare.pose(torch.zeros(69), betas=np.zeros(10))
    torch.testing.assert_close(same.means, own.means)


def test_the_shape_of_an_unknown_body_is_refused_and_so_are_its_vertices(record, tmp_path):
    record = make_avatar(read_body_model(), every=40)
    record.joints[:] += [0.3, 0, 0]
    write_splats(tmp_path / "other.npz", record)
    person = hugs.load(tmp_path / "other.npz").pose()
    assert person.joints.shape == (24, 3)
    for ask in (lambda: person.vertices, lambda: hugs.load(tmp_path / "other.npz").pose(betas=np.ones(10))):
        with pytest.raises(hugs.StageError, match="body of this avatar is unknown"):
            ask()


@pytest.mark.parametrize(
    "given, named",
    [
        ({"body_pose": np.zeros(72)}, "body_pose"),
        ({"transl": [0, np.nan, 0]}, "transl"),
        ({"global_orient": np.eye(3)[None]}, "global_orient"),
        ({"betas": np.zeros((2, 10))}, "betas"),
        ({"body_pose": np.zeros((2, 69)), "transl": np.zeros((3, 3))}, r"'body_pose': 2, 'transl': 3"),
        ({"transl": torch.zeros(3)}, "body_pose must be a tensor"),
        ({"hands": np.zeros((30, 3))}, "hands"),
        ({"face": {"smile": 1.0}}, "smile"),
    ],
)
def test_what_is_no_pose_is_refused_by_name(avatar, given, named):
    with pytest.raises(ValueError, match=named):
        avatar.pose(**given)


def test_hands_and_a_face_are_arrays_or_names(avatar):
    """A batch of hands is each by itself, a name is its row, and in tensors both have gradients."""
    hands, face = RNG.normal(0, 0.3, (3, 2, 15, 3)), {"jawOpen": 0.8}
    person = avatar.pose(POSE, hands=hands, face=face)
    assert len(person) == 3
    np.testing.assert_allclose(person.means[1], avatar.pose(POSE, hands=hands[1], face=face).means, atol=1e-6)
    plain, row = avatar.pose(POSE).means, np.eye(52)[FACE_NAMES.index("jawOpen")]
    np.testing.assert_allclose(avatar.pose(POSE, face=0.8 * row).means, avatar.pose(POSE, face=face).means, atol=1e-6)
    for one in (avatar.pose(POSE, hands=hands[0]).means, avatar.pose(POSE, face=face).means):
        assert 0.01 < np.abs(one - plain).max() < 0.2
    taught = [torch.as_tensor(part).float().requires_grad_() for part in (hands[0], row)]
    avatar.pose(torch.as_tensor(POSE), hands=taught[0], face=taught[1]).means.square().sum().backward()
    assert all(part.grad is not None and part.grad.abs().max() > 0 for part in taught)


def test_a_face_with_expressions_of_its_body_takes_them_by_name_and_52_numbers_too(avatar):
    own = avatar.record.face
    moves = np.concatenate([own.moves, 0 * own.moves[:1], own.moves[[FACE_NAMES.index("jawOpen")]]])
    record = replace(avatar.record, face=replace(own, moves=moves))
    one = replace(avatar, record=record, baked=load_avatar(record))
    theirs = one.pose(POSE, face={"jawOpen": -0.8}).means
    row = np.zeros(54)
    row[53] = -0.8
    for face in ({"expression2": -0.8}, row, np.eye(52)[FACE_NAMES.index("jawOpen")] * -0.8):
        np.testing.assert_allclose(one.pose(POSE, face=face).means, theirs, atol=1e-6)
    with pytest.raises(ValueError, match=r"face has the shape .*53"):
        one.pose(POSE, face=np.zeros(53))


def test_an_avatar_without_fingers_is_refused(avatar):
    bare = replace(avatar, record=replace(avatar.record, fingers=None, face=None))
    for given in ({"hands": np.zeros((2, 15, 3))}, {"face": {"jawOpen": 1}}):
        with pytest.raises(hugs.StageError, match="has no"):
            bare.pose(**given)


def test_gaussians_of_your_own_keep_their_gradients():
    parts = [torch.rand(5, 3), torch.randn(5, 4), torch.rand(5, 3), torch.rand(5), torch.randn(5, 4, 3)]
    own = hugs.Gaussians.of(*(part.requires_grad_() for part in parts))
    assert own.count == 5 and own.means is parts[0] and own.axes.requires_grad
    arrays = hugs.Gaussians.of(*(part.detach().numpy() for part in parts))
    assert isinstance(arrays.means, np.ndarray) and arrays.sh.shape == (5, 4, 3)


def test_what_is_shown_of_them_is_short(avatar):
    for one in (avatar, avatar.pose(), avatar.pose(np.zeros((3, 69))), hugs.camera((0, 0, 3)), avatar.motions):
        assert "tensor" not in repr(one) and "array" not in repr(one) and len(repr(one)) < 120
    assert "173 Gaussians in 3 poses" in repr(avatar.pose(np.zeros((3, 69))))
