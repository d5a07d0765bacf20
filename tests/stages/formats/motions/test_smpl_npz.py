"""SMPL motions of other programs."""

import pickle

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.motions.smpl_npz import read_smpl_motion
from stages.gestures import FACE_NAMES
from tests.made.said import any_holds, holds

N = 5
RNG = np.random.default_rng(0)
POSES = RNG.normal(0, 0.3, (N, 165))
TRANS = RNG.normal(size=(N, 3))


def read(tmp_path, **arrays):
    np.savez(tmp_path / "m.npz", **arrays)
    return read_smpl_motion(tmp_path / "m.npz")


@pytest.mark.parametrize(
    "arrays,kept,fps",
    [
        ({"poses": POSES[:, :72], "trans": TRANS}, 24, None),
        ({"poses": POSES[:, :72].reshape(N, 24, 3), "transl": TRANS, "fps": 25}, 24, 25),
        ({"poses": POSES[:, :156], "trans": TRANS, "mocap_framerate": 120.0, "gender": "male"}, 22, 120),
        ({"poses": POSES, "trans": TRANS, "mocap_frame_rate": np.array([59.94])}, 22, 60000 / 1001),
        ({"smpl_poses": POSES[:, :72], "smpl_trans": TRANS * 93.8, "smpl_scaling": [93.8]}, 24, 60),
        ({"global_orient": POSES[:, :3], "body_pose": POSES[:, 3:72], "transl": TRANS}, 24, None),
        ({"poses": POSES[:, :66], "trans": TRANS}, 22, None),
        (
            {"root_orient": POSES[:, :3], "pose_body": POSES[:, 3:66], "trans": TRANS, "fps": 30, "floor": TRANS[0]},
            22,
            30,
        ),
        (
            {"global_orient": POSES[:, :3], "body_pose": POSES[:, 3:66], "transl": TRANS, "mocap_frame_rate": 30.0},
            22,
            30,
        ),
        (
            {"global_orient": POSES[:, None, :3], "body_pose": POSES[:, 3:66].reshape(N, 21, 3), "transl": TRANS},
            22,
            None,
        ),
    ],
    ids=["plain", "joints", "AMASS SMPL-H", "AMASS SMPL-X", "AIST++", "body.npz", "66", "HuMoR", "SMPL-X", "21 joints"],
)
def test_the_families(tmp_path, arrays, kept, fps):
    motion = read(tmp_path, **arrays)
    np.testing.assert_allclose(motion.rotvecs[:, :kept], POSES[:, : 3 * kept].reshape(N, kept, 3))
    assert (motion.rotvecs[:, kept:] == 0).all() and motion.rotvecs.shape == (N, 24, 3)
    np.testing.assert_allclose(motion.transl, TRANS, atol=1e-12)
    assert motion.fps == (fps and pytest.approx(fps)) and len(motion) == N
    width = next((array.shape[1] for key, array in arrays.items() if key == "poses"), 0)
    assert (motion.hands is not None) == (width in (156, 165))
    assert bool(motion.notes) == (kept == 22 and width != 156)


def test_jaw_eyes_and_expressions_are_a_face_in_every_layout(tmp_path):
    """A half open jaw, a left eye that looks in, and eleven expressions, of which ten are taken."""
    turns, expressions = np.zeros((N, 9)), RNG.normal(size=(N, 11))
    turns[1, 0], turns[2, 4] = np.radians(11), np.radians(-7)
    poses = np.concatenate([POSES[:, :66], turns, POSES[:, 75:]], 1)
    body, eyes = {"poses": POSES[:, :72], "trans": TRANS}, {"leye_pose": turns[:, 3:6], "reye_pose": turns[:, None, 6:]}
    faces = [
        read(tmp_path, poses=poses, trans=TRANS, expressions=expressions).face,
        read(tmp_path, pose_jaw=turns[:, :3], pose_eye=turns[:, 3:], expression=expressions, **body).face,
        read(tmp_path, jaw_pose=turns[:, :3], expression=expressions, **eyes, **body).face,
    ]
    for face in faces:
        assert face.shape == (N, 62)
        np.testing.assert_array_equal(face[:, 52:], expressions[:, :10])
        shown = {(f, FACE_NAMES[k]): face[f, k] for f, k in zip(*np.nonzero(face[:, :52]), strict=True)}
        assert shown == {(1, "jawOpen"): pytest.approx(0.5), (2, "eyeLookInLeft"): pytest.approx(0.5)}
    turns[:] = 0
    still = read(tmp_path, jaw_pose=turns[:, :3], expression=0 * expressions, **body)
    assert still.face is None and not still.notes


def test_turns_beyond_a_face_are_held_and_said_and_so_is_what_is_no_face(tmp_path):
    jaw = np.zeros((N, 3))
    jaw[:2, 0] = np.radians([44, -3])
    given = {"poses": POSES[:, :72], "trans": TRANS, "jaw_pose": jaw, "expression": np.zeros(10), "leye_pose": jaw[:1]}
    motion = read(tmp_path, **given)
    assert motion.face.shape == (N, 52) and motion.face[:, FACE_NAMES.index("jawOpen")].tolist() == [1, *[0] * (N - 1)]
    assert any_holds(motion.notes, "2 turns") and any_holds(motion.notes, "expression left out")
    assert any_holds(motion.notes, "leye_pose left out")


WORLD = {"global_orient": POSES[:, :3], "body_pose": POSES[:, 3:66], "transl": TRANS}
FILES = {
    "AIST++": {
        "smpl_poses": POSES[:, :72],
        "smpl_trans": TRANS * 93.8,
        "smpl_scaling": np.array([93.8]),
        "smpl_loss": 1.5,
    },
    "HuMoR": {"root_orient": POSES[:, :3], "pose_body": POSES[:, 3:66], "trans": TRANS, "fps": 30},
    "GVHMR": {"smpl_params_global": WORLD, "smpl_params_incam": WORLD | {"transl": TRANS + 1}, "K_fullimg": np.eye(3)},
    "WHAM": {4: {"pose_world": POSES[:, :72], "trans_world": TRANS, "frame_ids": np.arange(N)}, 7: {}},
    "SLAHMR": {
        "root_orient": np.stack([POSES[:, :3], POSES[:, 3:6]]),
        "pose_body": np.stack([POSES[:, 3:66], POSES[:, 6:69]]),
        "trans": np.stack([TRANS, -TRANS]),
    },
}


@pytest.mark.parametrize("tool", FILES)
def test_pickles_of_other_programs(tmp_path, tool):
    for path in (tmp_path / "m.pkl", tmp_path / "m.pt"):
        path.write_bytes(pickle.dumps(FILES[tool]))
        motion = read_smpl_motion(path)
        np.testing.assert_allclose(motion.rotvecs[:, :22], POSES[:, :66].reshape(N, 22, 3))
        np.testing.assert_allclose(motion.transl, TRANS, atol=1e-12)
        assert any_holds(motion.notes, "2 people", "first") == (tool in ("WHAM", "SLAHMR"))
    if tool == "SLAHMR":
        assert len(read(tmp_path, **FILES[tool])) == N


def test_what_a_file_holds_is_said_whatever_it_is(tmp_path):
    with pytest.raises(StageError, match="has no motion") as refused:
        read(tmp_path, joints=TRANS, names=np.array([{}], dtype=object), image=TRANS)
    assert len(refused.value.facts) == 1 and holds(refused.value.facts[0], "joints", "names", "image")


def test_pickles_beside_the_motion_are_not_opened(tmp_path):
    labels = np.array([{"a": 1}], dtype=object)
    assert len(read(tmp_path, poses=POSES, trans=TRANS, markers_latent_vids=labels)) == N


GOOD = {"poses": POSES[:, :72], "trans": TRANS}


@pytest.mark.parametrize(
    "changed,problem,fact",
    [
        ({"poses": None}, "has no poses", "it holds trans"),
        ({"trans": None}, "has no trans", "it holds poses"),
        ({"poses": POSES[:, :63]}, r"\bposes\b", "found 5x63, wanted 5x72"),
        ({"poses": POSES[:3, :72]}, r"\bposes\b", "found 3x72, wanted 5x72"),
        ({"poses": np.array(1.0)}, r"\bposes\b", "found a single number"),
        ({"trans": TRANS[:, :2]}, r"\btrans\b", "found 5x2"),
        ({"trans": TRANS[:0], "poses": POSES[:0, :72]}, "holds no frame", "0x3"),
        ({"poses": np.where(np.arange(72) == 7, np.nan, POSES[:, :72])}, "not finite", "[0, 7]"),
        ({"poses": np.degrees(POSES[:, :72])}, "looks like degrees", "turns by"),
        ({"mocap_framerate": 0.0}, "mocap_framerate", "it is 0"),
        ({"mocap_framerate": np.array([30.0, 60])}, "mocap_framerate", "found 2, wanted 1"),
        ({"smpl_poses": POSES[:, :72], "smpl_trans": TRANS}, "has no smpl_scaling", "it holds"),
        ({"poses": None, "body_pose": POSES[:, 3:72]}, "has no global_orient", "body_pose"),
        ({"poses": POSES.astype(str)[:, :72]}, "does not hold numbers", "its type"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path, changed, problem, fact):
    arrays = {key: value for key, value in (GOOD | changed).items() if value is not None}
    with pytest.raises(StageError, match=problem) as refused:
        read(tmp_path, **arrays)
    assert fact in refused.value.facts[0] and refused.value.hint


def test_a_file_that_is_no_npz_is_refused(tmp_path):
    (tmp_path / "m.npz").write_text("no zip")
    with pytest.raises(StageError, match="cannot read"):
        read_smpl_motion(tmp_path / "m.npz")
