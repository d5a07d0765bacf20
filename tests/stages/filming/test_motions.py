"""Motions for the people of a film: at its rate and their speed, on a floor at height 0."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl_rest import smpl_rest
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import load_avatar, mimed
from stages.avatar.motion.moves import by_formula
from stages.avatar.motion.placing import Soles
from stages.avatar.motion.takes import SECONDS
from stages.contract import StageError
from stages.estimators.bodyfit.resting import posed_joints
from stages.filming.motions import Manner, from_clip, from_file
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import Face, face_names
from tests.made import bvh as bvh_made
from tests.made.said import holds
from tests.made.tiny import EMPTY, FRAMES, make_avatar, make_ground, make_poses

MODEL = read_body_model()


@pytest.fixture(scope="module")
def soles():
    return Soles.of_model(MODEL, np.zeros(10))


def low(placed, soles):
    return soles.at(placed.global_orient, placed.body_pose, placed.transl)[0][..., 1].min(1)


@pytest.mark.parametrize("name", ["wave", "squats"])
def test_a_made_motion_goes_at_its_speed(soles, name):
    plain, slow = (by_formula(name, soles, SECONDS, Manner(20.0, speed).wanted) for speed in (1.0, 0.5))
    assert len(plain.transl) == 80 and len(slow.transl) == 160
    np.testing.assert_allclose(slow.body_pose[::2], plain.body_pose, atol=0.15)
    assert np.abs(low(plain, soles)).max() < 0.02


def test_the_clips_own_motion_has_the_films_rate_and_both_ends(soles):
    body, ground = make_poses(), make_ground(make_poses(), MODEL)
    times = np.arange(FRAMES) * 0.1
    placed = from_clip(body, times, ground, Manner(30.0), soles)
    assert len(placed.transl) == 3 * (EMPTY - 1) + 1
    np.testing.assert_allclose(placed.body_pose[::3], body.body_pose[:EMPTY], atol=1e-9)
    half = from_clip(body, times, ground, Manner(30.0, 0.5), soles)
    assert len(half.transl) == 6 * (EMPTY - 1) + 1 and np.abs(low(half, soles)).max() < 0.02
    hands = np.random.default_rng(0).normal(0, 0.3, (FRAMES, 2, 15, 3))
    bent = from_clip(replace(body, hands=hands), times, ground, Manner(30.0), soles)
    np.testing.assert_allclose(bent.hands[::3], hands[:EMPTY], atol=1e-9)
    assert placed.hands is None
    face = np.random.default_rng(1).random((FRAMES, 52))
    spoken = from_clip(replace(body, face=face), times, ground, Manner(30.0, 0.5), soles)
    np.testing.assert_allclose(spoken.face[::6], face[:EMPTY], atol=1e-9)
    np.testing.assert_allclose(spoken.face[3], face[:2].mean(0), atol=1e-9)
    assert placed.face is None


def test_a_jump_stays_a_jump_however_slowly_it_is_shown(soles, tmp_path):
    orient, pose = np.zeros((60, 3)), np.zeros((60, 69))
    t = np.arange(60) / 60
    jump = np.maximum(0, 2.4 * (t - 0.4) - 0.5 * 9.81 * (t - 0.4) ** 2) * (t > 0.4)
    joints = MODEL.J_regressor.astype(float) @ MODEL.v_template
    steps = np.stack([0 * t, jump, 0 * t], 1)
    local = bvh_made.matrices(orient, pose)
    bvh_made.write_bvh(tmp_path / "jump.bvh", joints, local, steps, bvh_made.a_pose(), fps=60)
    for speed in (1.0, 0.2):
        placed, facts = from_file(tmp_path / "jump.bvh", Manner(30.0, speed), soles, MODEL.parents.tolist())
        assert low(placed, soles).max() == pytest.approx(jump.max(), abs=0.03), facts
        assert len(placed.transl) == pytest.approx(30 / speed, abs=1 / speed)


LIMBS = [(a, b) for chain in ((1, 4, 7), (2, 5, 8), (16, 18, 20), (17, 19, 21)) for a, b in zip(chain, chain[1:])]


@pytest.mark.parametrize("layout", ["AMASS", "plain", "ours"])
def test_limbs_point_where_smpls_point_though_the_free_body_rests_otherwise(soles, tmp_path, layout):
    rng = np.random.default_rng(0)
    orient, pose = np.zeros((9, 3)), 0.3 * rng.normal(size=(9, 69))
    orient[:, 1] = 0.1 * np.arange(9)
    columns = np.zeros((9, 156 if layout == "AMASS" else 72))
    pose[:, 63:] = 0  # hands
    columns[:, :66] = np.concatenate([orient, pose[:, :63]], 1)
    ours = {"world_from_sfm": 1.0} if layout == "ours" else {}
    np.savez(tmp_path / "move.npz", poses=columns, trans=np.zeros((9, 3)), fps=30.0, **ours)

    def limbs(rest, *turns):
        joints, _ = posed_joints(rest, *turns)
        bones = np.stack([joints[:, b] - joints[:, a] for a, b in LIMBS], 1)
        return bones / np.linalg.norm(bones, axis=-1, keepdims=True)

    wanted = limbs(soles.joints if layout == "ours" else smpl_rest(), orient, pose)
    placed, _ = from_file(tmp_path / "move.npz", Manner(30.0), soles, MODEL.parents.tolist(), MODEL.name)
    found = limbs(soles.joints, placed.global_orient, placed.body_pose)
    turned, _ = Rotation.align_vectors(wanted[0], found[0])  # it is made to look ahead
    off = np.degrees(np.arccos(np.clip((turned.apply(found.reshape(-1, 3)) * wanted.reshape(-1, 3)).sum(-1), -1, 1)))
    assert off.max() < 0.01


@pytest.fixture(scope="module")
def fingers():
    return attach(make_avatar(MODEL, every=40), MODEL, read_hands_face(MODEL)).fingers


@pytest.mark.parametrize("layout", ["SMPL-H", "SMPL-X", "arrays", "bvh"])
def test_files_of_each_format_move_a_finger(soles, fingers, tmp_path, layout):
    """The left index bends by half a radian in frame 1, whatever it is at first, and no other finger moves."""
    bend, whole = np.zeros((3, 90)), np.zeros((3, 66))
    bend[1, 2], steps = -0.5, {"trans": np.zeros((3, 3)), "fps": 30.0}
    if layout == "bvh":
        local = np.tile(np.eye(3), (3, 24, 1, 1))
        local[1, 22] = Rotation.from_rotvec([0, 0, -0.5]).as_matrix()
        names = [*bvh_made.MIXAMO[:22], "LeftHandIndex1", "RightHandIndex1"]
        path = tmp_path / "m.bvh"
        bvh_made.write_bvh(path, soles.joints, local, np.zeros((3, 3)), bvh_made.a_pose(), names=names, fps=30)
        hips, left, right = re.split("(?=JOINT .*HandIndex1)", path.read_text())
        ends = [part.replace("OFFSET 0 1 0", f"OFFSET {way} -1 0", 1) for way, part in ((1, left), (-1, right))]
        path.write_text(hips + "".join(ends))
    else:
        columns = {"SMPL-H": [whole, bend], "SMPL-X": [whole, np.zeros((3, 9)), bend]}.get(layout, [whole])
        more = {"left_hand_pose": bend[:, :45], "right_hand_pose": bend[:, 45:]} if layout == "arrays" else {}
        path = tmp_path / "m.npz"
        np.savez(path, poses=np.concatenate(columns, 1), **steps, **more)
    placed, facts = from_file(path, Manner(30.0), soles, MODEL.parents.tolist(), MODEL.name, fingers)
    assert any(holds(fact, "2" if layout == "bvh" else "30", "finger bones") for fact in facts)
    at = Rotation.from_rotvec(placed.hands.reshape(-1, 3)).as_matrix().reshape(3, 30, 3, 3)
    turned = Rotation.from_matrix(at[1, 0] @ at[0, 0].T).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, -0.5], atol=1e-3)
    assert np.abs(at[1, 1:] - at[0, 1:]).max() < 1e-9 and np.abs(at[2] - at[0]).max() < 1e-9
    bare, facts = from_file(path, Manner(30.0), soles, MODEL.parents.tolist(), MODEL.name)
    assert bare.hands is None and any("fingers left out" in fact for fact in facts)
    np.testing.assert_array_equal(bare.body_pose, placed.body_pose)


def test_jaw_and_eyes_of_a_motion_move_any_face_and_expressions_those_that_have_them(soles, tmp_path):
    poses, expression = np.zeros((3, 165)), np.zeros((3, 10))
    poses[2, 66], poses[2, 70], expression[2, 1] = np.radians(22), np.radians(14), 3.0
    path = tmp_path / "m.npz"
    np.savez(path, poses=poses, expression=expression, trans=np.zeros((3, 3)), fps=15.0)
    found = {}
    for shapes in (0, 52, 54, 62):
        face = Face(np.zeros(1, int), np.zeros((shapes, 1, 3))) if shapes else None
        placed, facts = from_file(path, Manner(30.0), soles, MODEL.parents.tolist(), MODEL.name, face=face)
        found[shapes] = "; ".join(facts)
        if shapes:
            assert placed.face.shape == (5, shapes)
            shown = {
                face_names(shapes)[k]: placed.face[:, k].round(6).tolist() for k in placed.face.any(0).nonzero()[0]
            }
            assert shown == {"jawOpen": [0, 0, 0, 0.5, 1], "eyeLookOutLeft": [0, 0, 0, 0.5, 1]} | (
                {"expression2": [0, 0, 0, 1.5, 3]} if shapes > 52 else {}
            )
        else:
            assert placed.face is None
    assert holds(found[0], "jaw, eyes and expressions left out") and holds(found[52], "10 expressions left out")
    assert holds(found[54], "2 expressions", "8 expressions left out")
    assert holds(found[62], "jaw and eyes", "10 expressions") and "expressions left out" not in found[62]


@pytest.mark.slow
def test_a_chin_goes_down_and_gazes_go_where_smplx_turns_them(soles, tmp_path):
    """On the free body a jaw that turns about +x opens and about +y goes to the left; a left eye about +y looks left."""
    record = attach(make_avatar(MODEL, every=1), MODEL, read_hands_face(MODEL))
    poses = np.zeros((5, 165))
    for frame, (column, degrees) in enumerate(((66, 20), (67, 5), (70, 14), (69, 11)), start=1):
        poses[frame, column] = np.radians(degrees)
    np.savez(tmp_path / "m.npz", poses=poses, trans=np.zeros((5, 3)), fps=30.0)
    placed, _ = from_file(tmp_path / "m.npz", Manner(30.0), soles, MODEL.parents.tolist(), MODEL.name, face=record.face)
    avatar = load_avatar(record)
    rest = avatar.resting.means
    jaw, aside, left, down = (mimed(avatar, row).means - rest for row in torch.as_tensor(placed.face[1:]).float())
    chin = (rest[:, 1] < 0.58) & (rest[:, 2] > 0.13) & (rest[:, 1] > 0.53)
    eye = ((rest - torch.tensor([0.031, 0.664, 0.143])).norm(dim=1) < 0.012) & (left.norm(dim=1) > 1e-3)
    assert chin.sum() > 5 and jaw[chin].mean(0)[1] < -0.01 and aside[chin].mean(0)[0] > 0.002
    assert eye.sum() > 2 and left[eye].mean(0)[0] > 1e-3 and down[eye].mean(0)[1] < -5e-4


@pytest.mark.parametrize("time", ["0.033333", "0.0333", "0.03333333", "0.033"])
@pytest.mark.parametrize("frames", [2, 21, 200])
def test_no_frame_is_lost_where_the_time_was_rounded(soles, tmp_path, time, frames):
    local = np.tile(np.eye(3), (frames, 24, 1, 1))
    path = bvh_made.write_bvh(tmp_path / "m.bvh", soles.joints, local, np.zeros((frames, 3)), bvh_made.a_pose(), fps=30)
    path.write_text(path.read_text().replace("Frame Time: 0.03333333", f"Frame Time: {time}"))
    placed, facts = from_file(path, Manner(30.0), soles, MODEL.parents.tolist())
    assert len(placed.transl) == frames and "at 30 fps" in facts[0]


@pytest.mark.parametrize("fps", [29.97, 23.976, 59.94, 60.0])
def test_a_rate_that_is_said_is_rounded_like_any_other(soles, tmp_path, fps):
    np.savez(tmp_path / "m.npz", poses=np.zeros((600, 72)), trans=np.zeros((600, 3)))
    placed, _ = from_file(tmp_path / "m.npz", Manner(fps, motion_fps=fps), soles, MODEL.parents.tolist())
    assert len(placed.transl) == 600


@pytest.mark.parametrize("seconds", [100_000, 1e9, 1e300, 5000])
def test_a_motion_that_claims_to_take_for_ever_is_refused_before_memory_is_taken(soles, tmp_path, seconds):
    local = np.tile(np.eye(3), (3, 24, 1, 1))
    path = bvh_made.write_bvh(tmp_path / "m.bvh", soles.joints, local, np.zeros((3, 3)), bvh_made.a_pose(), fps=30)
    path.write_text(path.read_text().replace("Frame Time: 0.03333333", f"Frame Time: {seconds}"))
    with pytest.raises(StageError, match=r"\bm\.bvh\b") as refused:
        from_file(path, Manner(30.0), soles, MODEL.parents.tolist())
    assert holds(refused.value.facts[1], "108,000") and "--motion-fps" in refused.value.hint
    np.savez(tmp_path / "m.npz", poses=np.zeros((3, 72)), trans=np.zeros((3, 3)), fps=1 / seconds)
    with pytest.raises(StageError, match=r"\bm\.npz\b"):
        from_file(tmp_path / "m.npz", Manner(30.0), soles, MODEL.parents.tolist())
    with pytest.raises(StageError, match=r"\bm\.npz\b"):
        from_file(tmp_path / "m.npz", Manner(30.0, 1e-12, motion_fps=30.0), soles, MODEL.parents.tolist())
    times = np.linspace(0, seconds, FRAMES)
    with pytest.raises(StageError, match=r"\bclip\b.*too many"):
        from_clip(make_poses(), times, make_ground(make_poses(), MODEL), Manner(30.0), soles)


@pytest.mark.parametrize(
    ("stands", "said"), [("z", "-y"), ("y", "z"), ("z", "y"), ("-y", "y"), ("y", "y"), ("z", None)]
)
def test_an_up_that_the_pelvis_contradicts_is_said_with_the_axis_that_it_has(soles, tmp_path, stands, said):
    turn = {"y": [0, 0, 0], "-y": [np.pi, 0, 0], "z": [np.pi / 2, 0, 0]}[stands]
    poses = np.zeros((9, 72))
    poses[:, :3] = turn
    np.savez(tmp_path / "m.npz", poses=poses, trans=np.zeros((9, 3)), fps=30)
    _, facts = from_file(tmp_path / "m.npz", Manner(30.0, up=said), soles, MODEL.parents.tolist())
    contradicted = [fact for fact in facts if "--up" in fact]
    assert len(contradicted) == (said not in (None, stands))
    assert all(f"--up {stands}" in fact for fact in contradicted) and f"{said or stands} is up" in facts


def test_what_is_no_motion_is_refused(soles, tmp_path):
    (tmp_path / "moves.txt").write_text("up and down")
    with pytest.raises(StageError, match="is no motion"):
        from_file(tmp_path / "moves.txt", Manner(30.0), soles, MODEL.parents.tolist())


def test_a_files_rate_can_be_said_otherwise_and_its_drift_is_said(soles, tmp_path):
    columns, trans = np.zeros((41, 72)), np.zeros((41, 3))
    for rise, said in ((0.04, False), (0.2, True)):
        trans[:, 1] = np.linspace(0, rise, 41)
        np.savez(tmp_path / "move.npz", poses=columns, trans=trans, fps=20.0)
        for fps, seconds in ((None, 2.0), (10.0, 4.0), (40.0, 1.0)):
            manner = Manner(30.0, motion_fps=fps)
            placed, facts = from_file(tmp_path / "move.npz", manner, soles, MODEL.parents.tolist(), MODEL.name)
            assert len(placed.transl) == round(30 * seconds) + 1 and f"{seconds:.1f} s at" in facts[0]
        assert any("rose and fell by" in fact for fact in facts) is said, facts


def test_a_clips_motion_goes_on_through_frames_that_show_nobody(soles):
    body, ground = make_poses(), make_ground(make_poses(), MODEL)
    times, confidence = np.arange(FRAMES) * 0.1, body.confidence.copy()
    confidence[2:4] = 0
    whole, holed = (
        from_clip(one, times, ground, Manner(10.0), soles) for one in (body, replace(body, confidence=confidence))
    )
    assert len(holed.transl) == len(whole.transl)
    np.testing.assert_allclose(holed.body_pose[[0, 1, 4, 5]], whole.body_pose[[0, 1, 4, 5]], atol=1e-9)
