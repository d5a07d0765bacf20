"""Who is in view: also who is so only for a moment, and neither a hand nor furniture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.contract import Job
from stages.estimators.person.crops import Roi
from stages.estimators.person.sightings import _cut_off, _same_or_within, everybody
from tests.made.eyes import BLUE, RED, SIDE, WIDTH, Eyes, filmed, pose_at
from tests.made.said import holds


def test_a_tiny_one_within_a_large_person_is_their_hand_or_furniture():
    large, beside = (replace(pose_at(x), next_roi=Roi(x, 30.0, side, 0.0)) for x, side in ((60.0, 100.0), (85.0, 60.0)))
    tiny = replace(pose_at(85.0), next_roi=Roi(85.0, 30.0, 20.0, 0.0))
    assert _same_or_within(large, tiny) and not _same_or_within(large, beside)
    assert not _same_or_within(large, replace(pose_at(140.0), next_roi=Roi(140.0, 30.0, 20.0, 0.0)))


def test_who_is_cut_off_at_the_side_of_the_picture_is_nobody_to_begin_with():
    assert _cut_off(Roi(WIDTH, 30.0, SIDE, 0.0), WIDTH) and _cut_off(Roi(3, 30.0, SIDE, 0.0), WIDTH)
    assert not _cut_off(Roi(5, 30.0, SIDE, 0.0), WIDTH)


COUNT = 81
WALKS = np.linspace(30.0, 90.0, COUNT)


def found(second: np.ndarray, said: list[str] | None = None) -> list[tuple[int, float]]:
    """Frame and place of everybody who is found beside one who walks; what the stage says is added to `said`."""
    job = Job(Path(), emit=lambda event: (said if said is not None else []).append(event["text"]))
    return [(one.frame, one.pose.next_roi.x) for one in everybody(job, Eyes(), filmed((RED, BLUE), (WALKS, second)))]


def test_who_is_in_view_only_for_a_moment_is_found_half_way_to_the_frames_beside():
    frames, back = np.arange(COUNT), np.linspace(170.0, 130.0, COUNT)
    assert found(np.where(abs(frames - 40) < 8, back, np.nan)) == [(40, 59.5), (40, 149.5)], "40 alone is one of nine"
    assert found(np.where(frames == 40, back, np.nan)) == [(40, 59.5)], "what one frame alone shows is nobody"
    assert len(found(np.where(frames % 10 == 0, back, np.nan))) == 1, (
        "nor is what each of nine shows, but no frame between"
    )


def test_what_never_changes_before_a_camera_that_stands_is_no_person():
    said: list[str] = []
    assert len(found(np.full(COUNT, 150.0), said)) == 1
    assert len(said) == 1 and holds(said[0], "scene", "x 150", "y 30", "40 px")
    assert len(found(150.0 + 3 * np.sin(np.arange(COUNT)))) == 2


def test_the_frame_with_the_most_people_counts_and_who_is_alone_is_nobody_to_tell_apart():
    assert found(np.full(COUNT, np.nan)) == []
    leaving = np.where(np.arange(COUNT) > 60, np.linspace(240.0, 110.0, COUNT), np.nan)
    assert {frame for frame, _ in found(leaving)} <= {70, 80}
