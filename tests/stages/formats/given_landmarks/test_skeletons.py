"""Points known by the names that programs give them, and by their number and order."""

from __future__ import annotations

import pytest

from stages.formats.given_landmarks.skeletons import SKELETONS, our_name
from stages.formats.landmarks import NAMES


@pytest.mark.parametrize(
    "theirs, ours",
    [
        *(("RHip", "right_hip"), ("left-hip", "left_hip"), ("l_hip", "left_hip"), ("hip_right", "right_hip")),
        *(("leftKnee", "left_knee"), ("LBigToe", "left_foot_index"), ("left_big toe", "left_foot_index")),
        *(("right-pinky-third-joint", "right_pinky"), ("left_forefinger1", "left_index"), ("Nose", "nose")),
        *(("lear", "left_ear"), ("REye", "right_eye"), ("MidHip", ""), ("Neck", ""), ("", ""), ("left_right_hip", "")),
    ],
)
def test_names_of_other_programs(theirs, ours):
    assert our_name(theirs) == ours


def test_every_skeleton_has_both_points_of_each_pair():
    for name, order in SKELETONS.items():
        known = [point for point in order if point]
        assert set(known) <= set(NAMES) and len(set(known)) == len(known), name
        assert {p.replace("left", "right") for p in known if "left" in p} == {p for p in known if "right" in p}, name
    counts = {len(order) for order in SKELETONS.values()}
    assert counts == {17, 18, 23, 25, 26, 33, 60, 67, 70, 133, 136, 308}
