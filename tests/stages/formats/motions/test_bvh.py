"""BVH files: what they mean, and what is said of broken ones."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.motions.bvh import read_bvh
from stages.formats.motions.bvh_names import map_body
from stages.records import JOINT_NAMES
from tests.made.bvh import MIXAMO
from tests.made.said import holds
from tests.made.skeleton import PARENTS

GOOD = """HIERARCHY
ROOT Bip01 Pelvis
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Knee {
    OFFSET 0 -5 0
    CHANNELS 2 Yrotation Xrotation
    End Site
    {
      OFFSET 0 -4 0
    }
  }
  JOINT Slider
  {
    OFFSET 7 8 9
    CHANNELS 1 Yposition
  }
}
MOTION
Frames: 2
Frame Time: .025
10 20 30 90 0 0 0 0 1
11 20 30 30 20 10 50 60 2
"""


def write(tmp_path, text):
    path = tmp_path / "m.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_what_a_file_means(tmp_path):
    bvh = read_bvh(write(tmp_path, GOOD))
    assert bvh.names == ("Bip01 Pelvis", "Knee", "", "Slider") and bvh.parents.tolist() == [-1, 0, 1, 0]
    assert bvh.fps == pytest.approx(40) and len(bvh) == 2
    np.testing.assert_allclose(bvh.places[1], [[11, 20, 30], [0, -5, 0], [0, -4, 0], [7, 2, 9]])
    np.testing.assert_allclose(bvh.rotations[0, 0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    x, y, z = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("x", 10), ("y", 20), ("z", 30)))
    np.testing.assert_allclose(bvh.rotations[1, 0], (z * y * x).as_matrix(), atol=1e-12)
    x, y = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("x", 60), ("y", 50)))
    np.testing.assert_allclose(bvh.rotations[1, 1], (y * x).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(bvh.rotations[:, 2:], np.tile(np.eye(3), (2, 2, 1, 1)))


def test_line_ends_case_and_byte_order_marks_do_not_matter(tmp_path):
    other = "\ufeff" + GOOD.replace("\n", "\r\n\r\n").replace("OFFSET", "offset").replace("Zrotation", "zRotation")
    a, b = read_bvh(write(tmp_path, GOOD)), read_bvh(write(tmp_path, other))
    np.testing.assert_array_equal(a.rotations, b.rotations)


@pytest.mark.parametrize(
    "old,new,line,expected,found",
    [
        ("HIERARCHY", "HIERARCHIE", 1, "HIERARCHY", "HIERARCHIE"),
        ("ROOT Bip01 Pelvis", "ROOT", 2, "name", "ROOT"),
        ("ROOT", "JOINT", 2, "ROOT", "JOINT Bip01 Pelvis"),
        ("{\n  OFFSET 1", "OFFSET 1", 3, "{", "OFFSET 1 2 3"),
        ("OFFSET 1 2 3", "OFFSET 1 2", 4, "3 numbers", "2 numbers"),
        ("OFFSET 1 2 3", "OFFSET 1 2,5 3", 4, "3 numbers", "'2,5'"),
        ("OFFSET 1 2 3", "OFFSET 1 inf 3", 4, "finite", "inf"),
        ("  OFFSET 1 2 3\n", "", 4, "OFFSET", "CHANNELS 6"),
        ("CHANNELS 6", "CHANNELS 5", 5, "count", "'5' and 6 channels"),
        ("CHANNELS 2 Yrotation Xrotation", "CHANNELS", 8, "count", "'none'"),
        ("CHANNELS 1 Yposition", "CHANNELS 1 Wrotation", 17, "Xposition", "'Wrotation'"),
        ("CHANNELS 2 Yrotation Xrotation", "CHANNELS 2 Xrotation Xrotation", 8, "once", "Xrotation"),
        ("JOINT Slider", "JOINT Knee", 14, "name", "'Knee' twice"),
        ("JOINT Slider", "BONE Slider", 14, "JOINT, End Site", "BONE Slider"),
        ("OFFSET 0 -4 0\n    }", "OFFSET 0 -4 0\n    CHANNELS 1 Xrotation }", 12, "}", "CHANNELS 1 Xrotation"),
        ("  }\n}\nMOTION", "  }\nMOTION", 19, "Bip01 Pelvis", "MOTION"),
        ("MOTION", "ROOT Two", 20, "MOTION", "ROOT Two"),
        ("Frames: 2", "Frames: two", 21, "whole number", "Frames: two"),
        ("Frames: 2", "Frames: 0", 21, "at least 1", "Frames: 0"),
        ("Frame Time: .025", "Frame Time: 0", 22, "above 0 s", "Frame Time: 0"),
        ("Frame Time: .025", "Frame Time:", 22, "1 numbers", "0 numbers"),
        ("90 0 0 0 0 1", "90 0 0 0 0", 23, "frame 0", "8 numbers"),
        ("60 2", "60 x", 24, "frame 1", "'x'"),
        ("60 2", "60 nan", 24, "finite numbers", "nan"),
        ("60 2\n", "60 2\n1 2 3\n", 25, "frame 2", "3 numbers"),
    ],
)
def test_broken_files_are_refused_with_line_and_expectation(tmp_path, old, new, line, expected, found):
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(StageError) as refused:
        read_bvh(path)
    assert holds(refused.value.problem, f"line {line}", path, "BVH")
    assert expected in refused.value.facts[0] and found in refused.value.facts[1] and refused.value.hint


@pytest.mark.parametrize(
    "text,problem,facts",
    [
        ("", "ends", ("line 0", "HIERARCHY")),
        (GOOD[: GOOD.index("  JOINT Slider")], "ends", ("JOINT", "End Site")),
        (GOOD[: GOOD.index("11 20")].replace("Frames: 2", "Frames: 4"), "ends", ("line 23", "1 frames of 4")),
        (GOOD[: GOOD.index("10 20")], "ends", ("line 22", "0 frames of 2")),
        (GOOD.replace("Frames: 2", f"Frames: {10**17}"), "ends", (f"2 frames of {10**17}",)),
        (b"HIERARCHY \xff\xfe\x00", "text", ("zero bytes",)),
        (b"\xff\xfeH\0I", "text", ()),
        (b"\xff\xfe\0\xd8H\0", "text", ()),
        (b"PK\3\4\0\0", "text", ()),
    ],
)
def test_cut_files_and_what_is_no_text_are_refused(tmp_path, text, problem, facts):
    with pytest.raises(StageError, match=problem) as refused:
        read_bvh(write(tmp_path, text))
    assert holds(refused.value.facts[0], *facts)


@pytest.mark.parametrize(
    ("promised", "there", "taken"),
    [
        (20, 21, True),
        (21, 20, True),
        (2, 30, True),
        (100, 95, True),
        (100, 94, False),
        (3, 1, False),
        (10**17, 2, False),
    ],
)
def test_rows_that_are_not_as_many_as_promised_are_taken_and_said_or_refused(tmp_path, promised, there, taken):
    rows = "".join(f"{i} 20 30 0 0 0 0 0 1\n" for i in range(there))
    head = GOOD[: GOOD.index("10 20")].replace("Frames: 2", f"Frames: {promised}")
    if not taken:
        with pytest.raises(StageError, match="ends too soon") as refused:
            read_bvh(write(tmp_path, head + rows))
        assert f"{there} frames of {promised}" in refused.value.facts[0]
        return
    bvh = read_bvh(write(tmp_path, head + rows))
    assert len(bvh) == there and bvh.places[-1, 0, 0] == there - 1
    (said,) = bvh.said
    assert holds(said, promised, "frames", there)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp932", "latin-1"])
def test_a_text_in_any_encoding_is_read(tmp_path, encoding):
    name = {"latin-1": "Hüfte", "cp932": "能力"}.get(encoding, "Hüfte能")  # a byte of the second letter is a brace
    bvh = read_bvh(write(tmp_path, GOOD.replace("Knee", name).encode(encoding)))
    np.testing.assert_array_equal(bvh.rotations, read_bvh(write(tmp_path, GOOD)).rotations)
    assert bvh.names[0] == "Bip01 Pelvis" and (bvh.names[1] == name or encoding == "latin-1") and bvh.said == ()


def test_names_and_skeletons_of_any_length_are_refused_at_once(tmp_path):
    with pytest.raises(StageError, match="line 2") as refused:
        read_bvh(write(tmp_path, GOOD.replace("Bip01 Pelvis", "x" * 1_000_000)))
    assert holds(" ".join(refused.value.facts), "1,000,000", "1,000")
    many = "".join(f"JOINT j{i} {{ OFFSET 0 1 0\nCHANNELS 0\n" for i in range(6000))
    with pytest.raises(StageError, match="the skeleton of"):
        read_bvh(write(tmp_path, f"HIERARCHY\nROOT r {{ OFFSET 0 0 0\nCHANNELS 1 Xposition\n{many}"))
    wide = "".join(f"JOINT {i}{'y' * 900} {{ OFFSET 0 1 0\nCHANNELS 0 }}\n" for i in range(200))
    text = f"HIERARCHY\nROOT r {{ OFFSET 0 0 0\nCHANNELS 1 Xposition\n{wide}}}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n"
    with pytest.raises(StageError, match="no person") as refused:
        map_body(read_bvh(write(tmp_path, text)), tmp_path)
    assert max(map(len, refused.value.facts)) < 500


def test_a_thousand_joints_in_a_row_are_no_trouble(tmp_path):
    deep = "".join(f"JOINT j{i} {{ OFFSET 0 1 0\nCHANNELS 0\n" for i in range(2000))
    text = f"HIERARCHY\nROOT r {{ OFFSET 0 0 0\nCHANNELS 1 Xposition\n{deep}{'}' * 2001}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n"
    with pytest.raises(StageError, match="no person"):
        map_body(read_bvh(write(tmp_path, text)), tmp_path)


FAMILIES = {
    "mixamo": [f"mixamorig:{name}" for name in MIXAMO],
    "cmu": """hip LeftHip RightHip abdomen LeftKnee RightKnee chest LeftAnkle RightAnkle chest2 LeftToe RightToe neck
        LeftCollar RightCollar head LeftShoulder RightShoulder LeftElbow RightElbow LeftWrist RightWrist a b""".split(),
    "biped": """Bip01;Bip01 L Thigh;Bip01 R Thigh;Bip01 Spine;Bip01 L Calf;Bip01 R Calf;Bip01 Spine1;Bip01 L Foot;
        Bip01 R Foot;Bip01 Spine2;Bip01 L Toe0;Bip01 R Toe0;Bip01 Neck;Bip01 L Clavicle;Bip01 R Clavicle;Bip01 Head;
        Bip01 L UpperArm;Bip01 R UpperArm;Bip01 L Forearm;Bip01 R Forearm;Bip01 L Hand;Bip01 R Hand;L;R""".split(";"),
    "rigify": """spine thigh.L thigh.R spine.001 shin.L shin.R spine.002 foot.L foot.R spine.003 toe.L toe.R spine.004
        shoulder.L shoulder.R head upper_arm.L upper_arm.R forearm.L forearm.R hand.L hand.R palm.L palm.R""".split(),
    "unreal": """pelvis thigh_l thigh_r spine_01 calf_l calf_r spine_02 foot_l foot_r spine_03 ball_l ball_r neck_01
        clavicle_l clavicle_r head upperarm_l upperarm_r lowerarm_l lowerarm_r hand_l hand_r index_l index_r""".split(),
    "poser": """hip lThigh rThigh abdomen lShin rShin chest lFoot rFoot chest2 lToe rToe neck lCollar rCollar head lShldr
        rShldr lForeArm rForeArm lHand rHand lThumb rThumb""".split(),
    "smpl": [name.replace("left_", "L_").replace("right_", "R_") for name in JOINT_NAMES],
}


def named(tmp_path, names, **more):
    """A body's tree of joints under other names; `more` takes joints out."""
    without = more.get("without", ())

    def told(joint):
        inner = "".join(told(child) for child in range(24) if PARENTS[child] == joint)
        if joint in without:
            return inner
        kind = "ROOT" if joint == 0 else "JOINT"
        return f"{kind} {names[joint].strip()}\n{{\nOFFSET 0 1 0\nCHANNELS 0\n{inner}}}\n"

    return write(
        tmp_path,
        f"HIERARCHY\n{told(0)}MOTION\nFrames: 1\nFrame Time: 1\n".replace("CHANNELS 0", "CHANNELS 1 Xposition", 1)
        + "0\n",
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_bodies_of_all_families_are_found(tmp_path, family):
    names = [name.strip() for name in FAMILIES[family]]
    path = named(tmp_path, names)
    bvh = read_bvh(path)
    body = map_body(bvh, path)
    assert {joint: bvh.names[i] for joint, i in body.limbs.items()} == {
        joint: names[joint] for joint in (*range(1, 12), 13, 14, *range(16, 22)) if joint not in (3, 6, 9)
    }
    assert bvh.names[body.pelvis] == names[0]
    assert [bvh.names[i] for i in (*body.spine, *body.neck)] == [names[i] for i in (3, 6, 9, 12, 15)]
    assert body.used == 22 and len(body.unused) == 2


def test_toes_collars_and_a_head_may_be_missing(tmp_path):
    path = named(tmp_path, MIXAMO, without=(10, 11, 13, 14, 15, 12))
    body = map_body(read_bvh(path), path)
    assert not {10, 11, 13, 14} & set(body.limbs) and body.neck == () and len(body.spine) == 3


def test_a_missing_limb_is_named_with_what_there_is(tmp_path):
    path = named(tmp_path, MIXAMO, without=(4, 21, 23))
    with pytest.raises(StageError, match="legs and arms") as refused:
        map_body(read_bvh(path), path)
    missing, joints = refused.value.facts
    assert (
        holds(missing, "missing", "left knee", "right wrist")
        and "LeftUpLeg" in joints
        and "Mixamo" in refused.value.hint
    )


def test_a_number_of_frames_with_thousands_of_digits_is_refused(tmp_path):
    with pytest.raises(StageError, match="BVH") as refused:
        read_bvh(write(tmp_path, GOOD.replace("Frames: 2", f"Frames: {'1' * 5000}")))
    assert holds(refused.value.facts[0], "whole number of frames", 1)


def test_joints_without_channels_take_no_more_memory_than_a_motion_needs(tmp_path):
    still = "".join(f"JOINT j{i} {{ OFFSET 0 1 0\nCHANNELS 0\n}}\n" for i in range(2000))
    text = f"HIERARCHY\nROOT r {{ OFFSET 0 0 0\nCHANNELS 1 Xposition\n{still}}}\nMOTION\nFrames: 6000\nFrame Time: 1\n"
    path = write(tmp_path, text + "0\n" * 6000)
    tracemalloc.start()
    with pytest.raises(StageError, match="too much memory") as refused:
        read_bvh(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 25
    tracemalloc.stop()
    assert holds(refused.value.facts[0], "2001 joints", "6000 frames", "1.15 GB")
