"""BVH as it is written: our reader and our retargeting find the same joints, Blender too."""

import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.fingers import finger_bones
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.takes import hung
from stages.avatar.motion.placing import Soles
from stages.avatar.motion.takes import made_takes
from stages.filming.motions import Manner, from_file
from stages.formats.body_model import read_body_model
from stages.formats.exchange.bone_names import Names, bone_names
from stages.formats.exchange.motion_bvh import write_motion_bvh
from stages.formats.hands_face import read_hands_face
from stages.formats.motions.bvh import read_bvh
from stages.records import JOINT_NAMES, Take
from tests.made import judges
from tests.made.tiny import make_avatar

FLOOR = -1.1
MODEL = read_body_model()
RIG = rig_of(make_avatar(MODEL))
PARENTS = RIG.parents.tolist()


def tumbling(poses=40):
    """Every joint turns at random, the root by whole turns about all axes."""
    rng = np.random.default_rng(3)
    times = np.arange(poses) / 25
    turns = Rotation.from_rotvec(rng.normal(0, 0.8, (24 * poses, 3))).as_quat(scalar_first=True).reshape(poses, 24, 4)
    whole = Rotation.from_euler("yx", np.stack([times * 9, times * 7], 1))
    turns[:, 0] = whole.as_quat(scalar_first=True)
    return Take("tumbling", times, turns, RIG.joints[0] + rng.normal(0, 0.5, (poses, 3)))


def where(take):
    """The joints [F,24,3] m of a take, and their turns in the world."""
    turns = Rotation.from_quat(take.rotations.reshape(-1, 4), scalar_first=True).as_matrix().reshape(-1, 24, 3, 3)
    at = np.repeat(take.pelvis[:, None], 24, 1)
    for joint, parent in list(enumerate(PARENTS))[1:]:
        at[:, joint] = at[:, parent] + turns[:, parent] @ (RIG.joints[joint] - RIG.joints[parent])
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return at, turns


def read_back(path, names="smpl"):
    """Joints [F,24,3] and turns in the world as the file has them, in our order."""
    bvh, at = read_bvh(path), {}
    turns = {}
    for joint, parent in enumerate(bvh.parents.tolist()):
        at[joint] = (
            bvh.places[:, joint] if parent < 0 else at[parent] + (turns[parent] @ bvh.places[:, joint, :, None])[..., 0]
        )
        turns[joint] = bvh.rotations[:, joint] if parent < 0 else turns[parent] @ bvh.rotations[:, joint]
    order = [bvh.names.index(name) for name in bone_names(names)]
    return np.stack([at[i] for i in order], 1), np.stack([turns[i] for i in order], 1)


@pytest.mark.parametrize("names", get_args(Names))
def test_joints_come_back_to_a_tenth_of_a_degree_and_a_millimetre(tmp_path, names):
    take = tumbling()
    write_motion_bvh(tmp_path / "a.bvh", RIG, take, names, FLOOR)
    (at, turns), (there, found) = where(take), read_back(tmp_path / "a.bvh", names)
    assert np.abs(there - at + [0, FLOOR, 0]).max() < 1e-3, "m, and the floor is at 0"
    away = Rotation.from_matrix((turns.mT @ found).reshape(-1, 3, 3)).magnitude()
    assert np.degrees(away.max()) < 0.1
    assert read_bvh(tmp_path / "a.bvh").fps == 25 and len(read_bvh(tmp_path / "a.bvh")) == len(take)


@pytest.mark.parametrize("names", get_args(Names))
@pytest.mark.parametrize("motion", [0, 3])
def test_we_animate_with_it_as_with_the_take(tmp_path, names, motion):
    take, soles = made_takes(RIG.joints[0])[motion], Soles.of_rig(RIG)
    write_motion_bvh(tmp_path / "a.bvh", RIG, take, names, soles.floor)
    placed, said = from_file(tmp_path / "a.bvh", Manner(30.0), soles, PARENTS)
    turns = Rotation.from_rotvec(np.concatenate([placed.global_orient, placed.body_pose], 1).reshape(-1, 3))
    away = turns.inv() * Rotation.from_quat(take.rotations.reshape(-1, 4), scalar_first=True)
    assert len(placed.transl) == len(take) and "y is up" in said
    assert np.degrees(away.magnitude().max()) < 0.1, f"{np.degrees(away.magnitude().reshape(-1, 24).max(0))}"
    steps = placed.transl - placed.transl[0] - take.pelvis + take.pelvis[0]
    assert np.abs(steps[:, [0, 2]]).max() < 1e-3


@pytest.mark.parametrize("names", get_args(Names))
def test_we_bend_fingers_with_it_as_with_the_take(tmp_path, names):
    rng, poses = np.random.default_rng(0), 12
    avatar = attach(make_avatar(MODEL, every=5), MODEL, read_hands_face(MODEL), rng.normal(0, 0.2, (2, 15, 3)))
    hands = rng.normal(0, 0.4, (poses, 2, 15, 3))
    baked, rig = load_avatar(avatar), rig_of(avatar)
    take = hung(baked, replace(tumbling(poses), hands=hands, rotations=made_takes(rig.joints[0])[3].rotations[:poses]))
    write_motion_bvh(tmp_path / "a.bvh", rig, take, names)
    placed, said = from_file(tmp_path / "a.bvh", Manner(25.0), Soles.of_rig(rig), PARENTS, fingers=avatar.fingers)
    assert "30 finger bones" in said
    found, ours = (ends(avatar.fingers, turns) for turns in (placed.hands, hands))
    assert np.abs(found - ours).max() < 1e-3, "m: bones may twist otherwise"


def ends(fingers, turns):
    """Where finger bones begin and fingers end [F,40,3] m, of hands at rest."""
    joints = torch.as_tensor(fingers.joints).double()
    bones = finger_bones(joints, torch.as_tensor(turns).double(), torch.eye(4).double().expand(len(turns), 24, 4, 4))
    points = torch.cat([joints, torch.as_tensor(fingers.tips).double()])
    bones = torch.cat([bones, bones[:, 2::3]], 1)
    return ((bones[..., :3, :3] @ points[..., None])[..., 0] + bones[..., :3, 3]).numpy()


def test_angles_do_not_jump_where_nothing_does(tmp_path):
    """Players and retargeters go straight from number to number: a whole turn goes on beyond 180 degrees."""
    rest = np.tile([1.0, 0, 0, 0], (100, 24, 1))
    take = Take("turn", np.arange(100) / 25, rest, np.tile(RIG.joints[0], (100, 1)))
    knee, elbow = JOINT_NAMES.index("left_knee"), JOINT_NAMES.index("left_elbow")
    shoulder, bend = JOINT_NAMES.index("left_shoulder"), np.linspace(0, 150, 100)
    for joint, axis, turn in ((0, "y", 8 * bend), (knee, "x", bend), (elbow, "y", -bend), (shoulder, "z", -bend)):
        take.rotations[:, joint] = Rotation.from_euler(axis, turn[:, None], degrees=True).as_quat(scalar_first=True)
    write_motion_bvh(tmp_path / "a.bvh", RIG, take)
    rows = (tmp_path / "a.bvh").read_text().partition("Frame Time:")[2].splitlines()[1:]
    angles = np.array([row.split() for row in rows], float)[:, 3:]
    assert np.abs(np.diff(angles, axis=0)).max() < 13 and np.ptp(angles, axis=0).max() == pytest.approx(1200)


def test_one_pose_is_a_motion_of_a_second_and_two_last_as_long_as_they_do(tmp_path):
    take = tumbling(1)
    write_motion_bvh(tmp_path / "a.bvh", RIG, replace(take, times=np.zeros(1)))
    assert len(read_bvh(tmp_path / "a.bvh")) == 1 and read_bvh(tmp_path / "a.bvh").fps == 1
    write_motion_bvh(tmp_path / "a.bvh", RIG, replace(tumbling(2), times=np.array([0, 0.25])))
    assert len(read_bvh(tmp_path / "a.bvh")) == 2 and read_bvh(tmp_path / "a.bvh").fps == 4


def test_bones_without_a_child_end_above_the_head_ahead_of_the_toes_and_beyond_the_hands(tmp_path):
    write_motion_bvh(tmp_path / "a.bvh", RIG, tumbling(1))
    found = re.findall(
        r"JOINT (\w+)\s+\{\s+OFFSET.*\s+CHANNELS.*\s+End Site\s+\{\s+OFFSET (.*)", (tmp_path / "a.bvh").read_text()
    )
    ends = {name: [float(number) for number in place.split()] for name, place in found}
    foot = [0, 0, 0.08]
    assert ends == {
        "head": [0, 0.2, 0],
        "left_foot": foot,
        "right_foot": foot,
        "left_hand": [0.08, 0, 0],
        "right_hand": [-0.08, 0, 0],
    }


@pytest.mark.slow
def test_blender_moves_the_bones_as_we_do(tmp_path):
    take = tumbling()
    write_motion_bvh(tmp_path / "a.bvh", RIG, take, floor=FLOOR)
    found = judges.blender("bvh_in_blender.py", tmp_path / "a.bvh")
    assert set(found) == set(JOINT_NAMES)
    heads = np.stack([found[name] for name in JOINT_NAMES], 1)
    assert np.abs(heads - where(take)[0] + [0, FLOOR, 0]).max() < 1e-3, "m, z up as Blender has it"
