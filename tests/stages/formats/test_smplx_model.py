"""A user's SMPL-H or SMPL-X file: 24 joints bend as its own do, fingers and a face come along, and what is wrong is named."""

import pickle

import numpy as np
import pytest
import torch

from stages.avatar.body.face import face_vector
from stages.avatar.body.fingers import bent_skin, finger_joints
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
from stages.contract import StageError
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.face_turns import TURNS
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import read_avatar, write_splats
from stages.gestures import FINGER_NAMES, face_names
from tests.made.smplx import LEFT_INDEX, made_smplx, posed
from tests.made.tiny import make_avatar

KINDS = ("SMPL-X", "SMPL-H")
BETAS = np.random.default_rng(1).normal(size=10)
INDEX = [FINGER_NAMES.index(f"left_index{part}") for part in (1, 2, 3)]


@pytest.fixture(scope="module", params=KINDS)
def made(request, tmp_path_factory):
    arrays = made_smplx(request.param)
    path = tmp_path_factory.mktemp("model") / "BODY_NEUTRAL.npz"
    np.savez(path, **arrays)
    return request.param, arrays, read_body_model(path)


def turned(arrays, hands=None):
    """Turns [J,3] rad of all joints of a pose of the body, with hands [30,3], and the same as SMPL's."""
    turns = np.zeros((arrays["weights"].shape[1], 3))
    turns[:22] = np.random.default_rng(2).normal(0, 0.4, (22, 3))
    smpl = torch.as_tensor(np.concatenate([turns[:22], np.zeros((2, 3))]))
    if hands is not None:
        turns[-30:] = hands
    return turns, smpl


def test_the_body_bends_and_changes_its_shape_as_the_files_own_joints_do(made):
    _, arrays, model = made
    assert model.name == "BODY_NEUTRAL" and model.posedirs.shape[2] == 207 and not model.posedirs[..., 189:].any()
    turns, smpl = turned(arrays)
    found, _ = Body(model, torch.float64)(
        torch.as_tensor(BETAS), smpl[None, 0], smpl[1:].reshape(1, 69), torch.zeros(1, 3)
    )
    assert np.abs(found[0].numpy() - posed(arrays, BETAS, turns, 21)).max() < 1e-5
    rest = arrays["v_template"] + arrays["shapedirs"][..., :10] @ BETAS
    middle = [len(turns) - 30 + bone for bone in (3, 18)]
    own = (arrays["J_regressor"] @ rest)[[*range(22), *middle]]
    assert np.abs(Body(model, torch.float64).rest(torch.as_tensor(BETAS))[1].numpy() - own).max() < 1e-5
    assert list(model.parents[22:]) == [20, 21]


def test_a_bent_finger_moves_what_it_moves_in_the_file(made):
    kind, arrays, model = made
    rig = read_hands_face(model)
    turns = np.zeros((arrays["weights"].shape[1], 3))
    turns[LEFT_INDEX[kind], 2] = -0.7
    vertices, _ = Body(model, torch.float64).rest(torch.as_tensor(BETAS))
    found = bent_skin(rig, vertices, torch.as_tensor(turns[-30:].reshape(2, 15, 3)))
    assert np.abs(found.numpy() - posed(arrays, BETAS, turns, 0)).max() < 1e-5
    moved = (found - vertices).norm(dim=1).numpy()
    own = arrays["weights"][:, LEFT_INDEX[kind]].any(1)
    assert moved[own].max() > 0.04 and moved[~own].max() < 1e-6 and own.sum() > 50


@pytest.mark.slow
@pytest.mark.parametrize("shapes", [20, 400])
def test_a_face_moves_as_the_files_own_jaw_eyes_and_expressions_do(shapes, tmp_path):
    arrays = made_smplx(shapes=shapes)
    np.savez(tmp_path / "new.npz", **arrays)
    rig = read_hands_face(read_body_model(tmp_path / "new.npz"))
    names, rest = face_names(len(rig.face_shapes)), arrays["v_template"]
    rows = np.linalg.norm(rest - rig.face_points[:, None], axis=2).argmin(1)
    assert names[52:] == tuple(f"expression{k}" for k in range(1, 11)) and 500 < len(rows) < 2000
    ways = {"jawOpen": (0, -1, -1), "jawLeft": (1, 0, 0), "jawRight": (-1, 0, 0)}
    for side, out in (("Left", 1), ("Right", -1)):
        for way, toward in (("Up", (0, 1, 0)), ("Down", (0, -1, 0)), ("In", (-out, 0, 0)), ("Out", (out, 0, 0))):
            ways[f"eyeLook{way}{side}"] = toward
    for name, (joint, axis, degrees) in TURNS.items():
        turns, own = np.zeros((55, 3)), 22 if "jaw" in name else 23 if "Left" in name else 24
        turns[own, axis] = 1
        theirs = (posed(arrays, np.zeros(10), np.radians(degrees) * turns, 0) - rest)[rows]
        shape = rig.face_shapes[names.index(name)]
        assert np.abs(shape - theirs).max() < 1e-6, name
        far = np.linalg.norm(theirs, axis=1)
        front = theirs[np.where(far > far.max() / 2, rest[rows, 2], 0).argsort()[-10:]].mean(0)
        assert (front * ways[name]).max() > 5e-4 and (front * ways[name]).min() >= 0, f"{name}: {front} m"
        assert 22 + joint == own
    begin = {20: 10, 400: 300}[shapes]
    np.testing.assert_allclose(
        rig.face_shapes[52:], np.moveaxis(arrays["shapedirs"][rows, :, begin : begin + 10], 2, 0)
    )
    still = [k for k, name in enumerate(names[:52]) if name not in TURNS]
    assert not rig.face_shapes[still].any() and rig.face_shapes[52:].any((1, 2)).all()


@pytest.mark.slow
def test_smplx_without_expressions_has_jaw_and_eyes_alone_and_smplh_no_face(made, tmp_path):
    kind, arrays, model = made
    np.savez(tmp_path / "few.npz", **arrays | {"shapedirs": arrays["shapedirs"][..., :16]})
    rig = read_hands_face(read_body_model(tmp_path / "few.npz"))
    assert len(rig.face_shapes) == 52 and (len(rig.face_points) > 100) == (kind == "SMPL-X")
    assert len(model.fingers.face_shapes) == (62 if kind == "SMPL-X" else 52)


def test_tips_lie_beyond_the_last_joints_and_hands_on_hand_joints(made):
    *_, model = made
    joints, tips = finger_joints(read_hands_face(model), torch.as_tensor(model.v_template))
    free = read_body_model()
    theirs = finger_joints(read_hands_face(free), torch.as_tensor(free.v_template))[1]
    assert (tips - theirs).norm(dim=1).max() < 0.01 and (joints[2::3] - tips).norm(dim=1).min() > 0.01
    assert np.allclose(model.fingers.finger_weights.reshape(-1, 2, 15).sum(2), model.lbs_weights[:, 22:], atol=1e-5)


@pytest.mark.slow
def test_an_avatar_of_it_has_fingers_and_a_face_also_from_the_file_of_the_run(made, tmp_path):
    kind, _, model = made
    write_body_model(tmp_path / "body_model.npz", model.sized(1.1))
    again = read_body_model(tmp_path / "body_model.npz")
    bare = make_avatar(again, every=3)
    write_splats(tmp_path / "avatar.npz", attach(bare, again, read_hands_face(again)))
    record = read_avatar(tmp_path / "avatar.npz")
    assert np.allclose(again.fingers.face_shapes, 1.1 * model.fingers.face_shapes, rtol=1e-5)
    assert np.allclose(again.fingers.face_points, 1.1 * model.fingers.face_points, rtol=1e-5)
    assert np.ptp(record.fingers.joints) == pytest.approx(1.1 * reach(model), rel=1e-3)
    hands = torch.zeros(1, 2, 15, 3)
    hands[0, 0, INDEX[0], 2] = -1.2
    still = [torch.zeros(size) for size in (3, 69, 3)]
    there = [PosedAvatar.of(load_avatar(record), *still, hands=one).splats(0).means for one in (hands, 0 * hands)]
    moved = (there[0] - there[1]).norm(dim=1).numpy()
    own = again.fingers.finger_weights[::3, INDEX].any(1)
    assert moved[own].max() > 0.04 and moved[~own].max() < 2e-6
    if kind == "SMPL-H":
        assert record.face is None
        return
    shapes = [{"jawOpen": 1.0}, {"expression1": -1.5}, {}]
    faces = [torch.as_tensor(face_vector(one, 62)).float()[None] for one in shapes]
    jaw, smile, none = (PosedAvatar.of(load_avatar(record), *still, face=one).splats(0).means for one in faces)
    assert (jaw - none)[:, 1].min() < -0.025 and 0.01 < (smile - none).norm(dim=1).max() < 0.04
    assert (none - PosedAvatar.of(load_avatar(record), *still).splats(0).means).abs().max() == 0


def reach(model):
    return np.ptp(model.fingers.finger_regressor[:30] @ model.v_template)


@pytest.mark.slow
def test_newer_files_with_more_shapes_are_the_same_body_and_so_are_pickles(tmp_path):
    np.savez(tmp_path / "new.npz", **made_smplx(shapes=400))
    with open(tmp_path / "old.pkl", "wb") as file:
        pickle.dump(made_smplx() | {"joint2num": {"Pelvis": 0}}, file, protocol=2)
    new, old = read_body_model(tmp_path / "new.npz"), read_body_model(tmp_path / "old.pkl")
    assert np.array_equal(new.shapedirs, read_body_model().shapedirs)
    assert np.array_equal(new.shapedirs, old.shapedirs)
    assert np.array_equal(new.fingers.finger_weights, old.fingers.finger_weights)


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda a: {"posedirs": a["posedirs"][..., :207]}, ["posedirs", "6890x3x207", "6890x3x486"]),
        (lambda a: {"shapedirs": a["shapedirs"][..., :9]}, ["shapedirs", "6890x3x9", "6890x3x10"]),
        (lambda a: {"weights": a["weights"][:, :24]}, ["weights", "6890x24", "6890x55"]),
        (lambda a: {"J_regressor": a["J_regressor"][:, :9]}, ["J_regressor", "55x9", "55x6890"]),
        (lambda a: {"kintree_table": a["kintree_table"][:, :24]}, ["kintree_table", "2x24", "2x55"]),
        (lambda a: {"kintree_table": changed(a["kintree_table"], (0, 30), 28)}, ["joint 30", "parent 28", "29"]),
        (lambda a: {"kintree_table": changed(a["kintree_table"], (0, 5), 9)}, ["kintree_table", "joint 5", "parent 9"]),
        (lambda a: {"weights": changed(a["weights"], (7, 40), np.nan)}, ["weights", "[7, 40]", "nan"]),
        (lambda a: {"weights": changed(a["weights"], (7, 40), 2)}, ["weights", "vertex 7", "3.0000"]),
        (lambda a: {"weights": changed(a["weights"], (7, [40, 41]), [-0.5, 0.5])}, ["smallest weight is -0.5"]),
        (lambda a: {"weights": np.eye(55)[np.zeros(6890, int)]}, ["left_index3", "0.5"]),
        (lambda a: {"v_template": np.array({"a": 1}, dtype=object)}, ["'v_template'"]),
        (lambda a: {"posedirs": None}, ["no posedirs"]),
        (lambda a: {"J_regressor": None}, ["no J_regressor", "kintree_table", "hands_meanl"]),
    ],
)
def test_what_is_wrong_is_named(change, words, tmp_path, whole):
    path = tmp_path / "SMPLX_NEUTRAL.npz"
    np.savez(path, **{key: value for key, value in (whole | change(whole)).items() if value is not None})
    with pytest.raises(StageError) as refused:
        read_body_model(path)
    said = "\n".join([refused.value.problem, *refused.value.facts, refused.value.hint])
    assert all(word in said for word in [*words, str(path), "SMPL-X"]), said


@pytest.fixture(scope="module")
def whole():
    return made_smplx()
