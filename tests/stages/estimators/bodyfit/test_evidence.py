"""Landmarks as evidence: what the picture's border cuts off is a guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import (
    CUT,
    LandmarkEvidence,
    drop_cut,
    drop_strangers,
    gather,
    joint_trust,
    mirrored_columns,
    model_landmarks,
    vote_sides,
)
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips
from tests.made.odd_clips import carried, make

NAMES = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_ankle", "left_heel")


def evidence(ankle: tuple[float, float], weight: float = 0.8) -> LandmarkEvidence:
    xy = np.full((1, 6, 2), 100.0)
    xy[0, 4] = ankle
    return LandmarkEvidence(
        NAMES, xy, np.full((1, 6), weight), np.zeros((1, 6, 3)), np.ones(1, bool), np.full(1, 100.0)
    )


def test_a_landmark_on_the_border_is_dropped_and_one_inside_stays():
    for ankle in ((100, 200 - 50 * CUT), (50 * CUT, 100), (100, 260), (-5, 100)):
        found = drop_cut(evidence(ankle), (150, 200)).weight[0]
        assert found[4] == 0 and (found[[0, 1, 2, 3, 5]] == 0.8).all()
    assert (drop_cut(evidence((100, 200 - 150 * CUT)), (150, 200)).weight == 0.8).all()


def test_a_joint_is_as_visible_as_its_landmark_and_the_spine_as_the_trunk():
    trust = dict(zip(JOINT_NAMES, joint_trust(drop_cut(evidence((-5, 100), 0.3), (150, 200)))[0], strict=True))
    assert trust["left_ankle"] == 0 and trust["left_foot"] == trust["spine2"] == trust["pelvis"] == 0.6
    assert joint_trust(evidence((100, 100)))[0].max() == 1


@pytest.mark.parametrize(
    ("run", "share"),
    [
        pytest.param(slice(12, 22), 1.0, id="a third of the clip in one piece"),
        pytest.param(slice(24, 30), 0.5, id="somebody who walks away: until the end, seen half as well"),
    ],
)
def test_sides_that_are_exchanged_are_set_right(run, share):
    model = read_body_model()
    names, _ = model_landmarks(model)
    evidence, _ = vote_sides(gather(bodyfit_clips.make(model, frames=30).tracks, names))
    exchanged = replace(evidence, xy=evidence.xy.copy(), world=evidence.world.copy(), weight=evidence.weight.copy())
    exchanged.weight[run] *= share
    for values in (exchanged.xy, exchanged.world, exchanged.weight):
        values[run] = values[run][:, mirrored_columns(names)]
    voted, changed = vote_sides(exchanged)
    assert np.flatnonzero(changed).tolist() == [i for i in range(30)[run] if evidence.seen[i]]
    np.testing.assert_array_equal(voted.xy[evidence.seen], evidence.xy[evidence.seen])


def test_a_third_of_a_clip_of_many_frames_is_set_right_as_one_of_few_is():
    """Each frame twelve times, as a camera of twelve times the rate sees them."""
    model = read_body_model()
    names, _ = model_landmarks(model)
    few = gather(bodyfit_clips.make(model, frames=30).tracks, names)
    parts = {key: getattr(few, key).repeat(12, 0) for key in ("xy", "weight", "world", "seen", "height", "deep")}
    evidence, _ = vote_sides(replace(few, **parts))
    run = slice(144, 264)
    exchanged = replace(evidence, xy=evidence.xy.copy(), world=evidence.world.copy(), weight=evidence.weight.copy())
    for values in (exchanged.xy, exchanged.world, exchanged.weight):
        values[run] = values[run][:, mirrored_columns(names)]
    voted, changed = vote_sides(exchanged)
    assert np.flatnonzero(changed).tolist() == [i for i in range(360)[run] if evidence.seen[i]]
    np.testing.assert_array_equal(voted.xy[evidence.seen], evidence.xy[evidence.seen])


@pytest.mark.parametrize("mirrored", [False, True], ids=["somebody else", "a mirror"])
def test_frames_that_show_somebody_else_or_a_mirror_image_are_left_out(mirrored):
    clip, beside = make(), make(carried(lambda times: np.tile([1.1, 0, -0.4], (len(times), 1))))
    names, _ = model_landmarks(read_body_model())
    others = [9, 10, 11, 12, 15]
    tracks = list(clip.tracks)
    for i in others:
        tracks[i] = (clip if mirrored else beside).tracks[i]
        if mirrored and tracks[i] is not None:
            tracks[i].xy[:, 0] = 2 * 0.7 * bodyfit_clips.WIDTH - tracks[i].xy[:, 0]
    seen = [i for i in others if tracks[i] is not None]
    found, strangers = drop_strangers(gather(tracks, names), clip.masks())
    assert np.flatnonzero(strangers).tolist() == seen
    kept, _ = vote_sides(drop_cut(found, (bodyfit_clips.WIDTH, bodyfit_clips.HEIGHT)))
    assert not kept.seen[seen].any() and (kept.weight[seen] == 0).all()


def test_where_the_mask_is_empty_the_landmarks_are_of_somebody_else():
    clip = make()
    masks, gone = clip.masks(), [0, 1, 2, 3, 4]
    for i in gone:
        masks[i] = np.zeros_like(masks[i])
    names, _ = model_landmarks(read_body_model())
    found, strangers = drop_strangers(gather(clip.tracks, names), masks)
    assert np.flatnonzero(strangers).tolist() == gone and not found.seen[gone].any()


def test_a_frame_whose_landmarks_all_lie_at_the_border_shows_nobody():
    names, _ = model_landmarks(read_body_model())
    evidence = gather(make().tracks, names)
    xy = evidence.xy.copy()
    xy[3] = [1.0, 50.0]
    found = drop_cut(replace(evidence, xy=xy), (bodyfit_clips.WIDTH, bodyfit_clips.HEIGHT))
    assert evidence.seen[3] and not found.seen[3] and (found.weight[3] == 0).all()
    assert found.seen[4] == evidence.seen[4]


def test_somebody_who_walks_away_is_not_turned_front_to_back_in_the_last_frames(monkeypatch):
    """From behind and far away a detector takes them for somebody who looks at the camera: sides and depth are exchanged."""
    pose = bodyfit_clips.motion
    monkeypatch.setattr(bodyfit_clips, "motion", lambda times: (np.full(len(times), np.pi), pose(times)[1]))
    model = read_body_model()
    names, _ = model_landmarks(model)
    evidence, _ = vote_sides(gather(bodyfit_clips.make(model, frames=30).tracks, names))
    faced = replace(evidence, xy=evidence.xy.copy(), world=evidence.world.copy(), weight=evidence.weight.copy())
    last = slice(23, 30)
    for values in (faced.xy, faced.world, faced.weight):
        values[last] = values[last][:, mirrored_columns(names)]
    faced.world[last, :, 2] *= -1
    faced.weight[last] *= 0.6
    voted, changed = vote_sides(faced)
    assert np.flatnonzero(changed).tolist() == list(range(23, 30))
    np.testing.assert_array_equal(voted.xy[evidence.seen], evidence.xy[evidence.seen])
    np.testing.assert_array_equal(voted.world[evidence.seen], evidence.world[evidence.seen])


@pytest.mark.parametrize("first", [5, 24])
def test_two_frames_whose_depth_alone_is_reversed_are_set_right_and_no_others(monkeypatch, first):
    """Without a way back of their own, all others were exchanged to agree with them."""
    pose = bodyfit_clips.motion
    monkeypatch.setattr(bodyfit_clips, "motion", lambda times: (np.pi / 3 * times, pose(times)[1]))
    model = read_body_model()
    names, _ = model_landmarks(model)
    evidence, _ = vote_sides(gather(bodyfit_clips.make(model, frames=30).tracks, names))
    world, rows = evidence.world.copy(), [first, first + 1]
    world[rows, :, 2] *= -1
    voted, changed = vote_sides(replace(evidence, world=world))
    assert np.flatnonzero(changed).tolist() == rows
    np.testing.assert_array_equal(voted.world, evidence.world)
    np.testing.assert_array_equal(voted.xy, evidence.xy)
