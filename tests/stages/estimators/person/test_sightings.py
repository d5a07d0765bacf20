"""Who is in view: also who is so only for a moment, and neither a hand nor furniture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.estimators.person.blazepose import Sighting
from stages.estimators.person.crops import Roi
from stages.estimators.person.sightings import _cut_off, _same_or_within, everybody, sight_everybody
from tests.made.eyes import BLUE, RED, SIDE, WIDTH, Eyes, filmed, pose_at


def test_of_a_few_frames_those_with_the_most_people_count_and_one_of_many_is_no_proof():
    def seen(frame: int, x: float) -> Sighting:
        return Sighting(frame, 0.9, pose_at(x).roi, pose_at(x))

    assert everybody([]) == []
    two = [seen(0, 40), seen(3, 40), seen(3, 160)]
    assert everybody(two) == two[1:], "of two frames that were looked at"
    alone = [seen(i, 40) for i in range(5)]
    assert everybody([*alone, seen(3, 160)]) == [alone[0]]
    assert len(everybody([*alone, seen(3, 160), seen(4, 160)])) == 2


def test_a_tiny_one_within_a_large_person_is_their_hand_or_furniture():
    large, beside = (replace(pose_at(x), next_roi=Roi(x, 30.0, side, 0.0)) for x, side in ((60.0, 100.0), (85.0, 60.0)))
    tiny = replace(pose_at(85.0), next_roi=Roi(85.0, 30.0, 20.0, 0.0))
    assert _same_or_within(large, tiny) and not _same_or_within(large, beside)
    assert not _same_or_within(large, replace(pose_at(140.0), next_roi=Roi(140.0, 30.0, 20.0, 0.0)))


def test_who_is_cut_off_at_the_side_of_the_picture_is_nobody_to_begin_with():
    assert _cut_off(Roi(WIDTH, 30.0, SIDE, 0.0), WIDTH) and _cut_off(Roi(3, 30.0, SIDE, 0.0), WIDTH)
    assert not _cut_off(Roi(5, 30.0, SIDE, 0.0), WIDTH)


def test_who_is_in_view_only_for_a_moment_is_found_half_way_to_the_frames_beside():
    frames, there = np.arange(81), np.full(81, 50.0)
    passing = np.where(abs(frames - 40) < 8, 150.0, np.nan)
    sightings = sight_everybody(Eyes(), filmed((RED, BLUE), (there, passing)))
    assert [one.frame for one in sightings if one.pose.next_roi.x > 100] == [35, 40, 45], "only 40 is one of nine"
    assert len(everybody(sightings)) == 2
    flicker = np.where(frames == 40, 150.0, np.nan)
    assert len(everybody(sight_everybody(Eyes(), filmed((RED, BLUE), (there, flicker))))) == 1
