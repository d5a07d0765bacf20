"""Which frame a pose belongs to: by name, number or time, at any frame rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.estimators.bodyfit import frames as module
from stages.formats.given_fits.record import SmplFit
from tests.made.fits import listed
from tests.made.said import any_holds, holds

AXES = np.random.default_rng(0).normal(size=(24, 3))


def motion(times):
    """Every joint turns at a steady speed, some through a whole turn in 2 s; the body walks along a line."""
    speed = np.pi * AXES / np.linalg.norm(AXES, axis=1, keepdims=True) * np.linspace(0.1, 1, 24)[:, None]
    turns = Rotation.from_rotvec((times[:, None, None] * speed).reshape(-1, 3)).as_rotvec().reshape(-1, 72)
    walk = np.stack([times, 0 * times, 3 + 0.5 * times], 1)
    return {"global_orient": turns[:, :3], "body_pose": turns[:, 3:], "transl": walk}


def join_frames(fit, names, times, sources=(), total=0):
    return module.join_frames(fit, listed(names, times, sources, total))


def fit_of(times, /, **more):
    return SmplFit("f.npz", "npz", betas=np.zeros((len(times), 10)), **motion(times), **more)


def names_of(numbers):
    return [f"{n:06d}" for n in numbers]


@pytest.mark.parametrize("theirs,ours", [(30, 24), (25, 30), (120, 29.97), (12, 30)])
def test_other_frame_rates_are_read_off_between_the_poses(theirs, ours):
    stored, taken = np.arange(0, 2, 1 / theirs), np.arange(3, 2 * ours - 3, 2) / ours
    fit, frames = join_frames(fit_of(stored, times=stored), names_of(range(len(taken))), taken)
    assert frames.tolist() == list(range(len(taken)))
    wanted = motion(taken)
    for key in ("global_orient", "body_pose"):
        a, b = (Rotation.from_rotvec(v.reshape(-1, 3)) for v in (getattr(fit, key), wanted[key]))
        assert (a.inv() * b).magnitude().max() < 1e-9
    np.testing.assert_allclose(fit.transl, wanted["transl"], atol=1e-12)


def test_nothing_is_made_up_in_gaps_or_beyond_the_ends():
    stored = np.concatenate([np.arange(0, 1, 1 / 30), np.arange(1.5, 2, 1 / 30)])
    taken = np.arange(0, 2.5, 0.1)
    _, frames = join_frames(fit_of(stored, times=stored), names_of(range(len(taken))), taken)
    assert np.allclose(taken[frames], [*np.arange(0, 1, 0.1), *np.arange(1.5, 2, 0.1)])
    with pytest.raises(StageError, match="40 of 40 frames") as caught:
        join_frames(fit_of(stored, times=stored), names_of(range(40)), 10 + np.arange(40) / 30)
    assert holds(caught.value.facts[0], "0.00 to 1.97 s")


def test_one_pose_is_the_pose_of_its_own_moment():
    at = np.array([0.5])
    fit, frames = join_frames(fit_of(at, times=at), names_of([15]), at)
    assert frames.tolist() == [0] and np.allclose(fit.transl, motion(at)["transl"])


def test_pictures_are_joined_by_their_own_names_first():
    """A folder of pictures: our names count them, the tool has their names, which may look like other numbers."""
    times = np.arange(4) / 30
    fit = replace(fit_of(times), tool="ROMP", names=("000002.jpg", "000004.jpg", "000006.jpg", "000001.jpg"))
    names, sources = names_of([0, 1, 2, 3]), ["000001", "000002", "000003", "000004"]
    joined, frames = join_frames(fit, names, times, sources)
    assert frames.tolist() == [0, 1, 3] and joined.names == ("000001.jpg", "000002.jpg", "000004.jpg")
    ours, frames = join_frames(replace(fit, tool="npz"), names, times, sources)
    assert frames.tolist() == [1, 2] and ours.names == ("000001.jpg", "000002.jpg")  # names as in frames.json


def test_a_tool_that_numbers_pictures_from_one_is_joined_by_its_count():
    times = np.arange(3) / 30
    fit = replace(fit_of(times), tool="PHALP", tracks=("1",) * 3)
    fit = replace(fit, names=("img/000001.jpg", "img/000002.jpg", "img/000003.jpg"), numbers=np.array([0, 1, 2]))
    _, frames = join_frames(fit, names_of([0, 2, 3]), times)
    assert frames.tolist() == [0, 1]
    joined, frames = join_frames(fit, names_of([0, 1, 2]), times, ["000002", "000003", "000004"])
    assert frames.tolist() == [0, 1] and joined.names == ("img/000002.jpg", "img/000003.jpg")


@pytest.mark.parametrize("tool", ["npz", "ROMP"])
def test_pictures_that_ffmpeg_numbered_from_one_are_not_taken_for_the_frame_after(tool):
    times, names = np.arange(4) / 30, names_of([0, 1, 2, 3])
    fit = replace(fit_of(times), tool=tool, names=("000001.jpg", "000002.jpg", "000003.jpg", "000004.jpg"))
    joined, frames = join_frames(fit, names, times, total=4)
    assert frames.tolist() == [0, 1, 2, 3] and np.array_equal(joined.transl, fit.transl)
    assert "counted from 1" in joined.notes[0]
    joined, _ = join_frames(fit, names, times, total=4, sources=["000001", "000002", "000003", "000004"])
    assert not joined.notes
    joined, _ = join_frames(fit, names, times, total=5)
    assert holds(joined.notes[0], "frames", "1 to 4 of 5")
    with pytest.raises(StageError, match="other pictures"):
        join_frames(fit, names[:3], times[:3], total=3)


def test_people_of_one_frame_stay_together_and_in_the_clips_order():
    times = np.arange(4) / 30
    fit = replace(fit_of(times), tracks=("a", "b", "a", "b"), numbers=np.array([6, 6, 3, 3]))
    joined, frames = join_frames(fit, names_of([3, 6]), times[:2])
    assert frames.tolist() == [0, 0, 1, 1] and joined.tracks == ("a", "b", "a", "b")
    assert np.array_equal(joined.transl, fit.transl[[2, 3, 0, 1]])


def test_pictures_without_a_number_are_of_no_frame():
    times, names = np.arange(10) / 30, names_of(range(10))
    called = (*(f"frame_{i:04d}.jpg" for i in range(1, 11)), "cover.jpg", "mean.jpg")
    fit = replace(fit_of(np.arange(12) / 30), tool="ROMP", names=called)
    joined, frames = join_frames(fit, names, times, total=10)
    assert frames.tolist() == list(range(10)) and np.array_equal(joined.transl, fit.transl[:10])


def test_rows_by_count_need_most_of_the_clip():
    fit = fit_of(np.arange(10) / 30)
    with pytest.raises(StageError, match="7 of 10 frames") as caught:
        join_frames(fit, names_of(range(0, 40, 4)), np.arange(10) / 7.5)
    assert "add `names`" in caught.value.hint


def test_rows_without_names_are_joined_only_where_there_is_one_for_each_frame_of_the_clip():
    """Every second frame of a film of 60: each pose would belong to a frame at half its time."""
    names, taken = names_of(range(0, 60, 2)), np.arange(0, 60, 2) / 30
    with pytest.raises(StageError, match="frames") as caught:
        join_frames(fit_of(np.arange(30) / 15), names, taken, total=60)
    assert holds(caught.value.facts[0], "30 poses", "60 frames") and holds(caught.value.hint, "names")
    _, frames = join_frames(fit_of(np.arange(60) / 30), names, taken, total=60)
    assert frames.tolist() == list(range(30))


def test_a_tool_with_more_or_fewer_poses_than_the_clip_has_frames_is_joined_by_number_and_that_is_said():
    times = np.arange(10) / 30
    for total, said in ((10, False), (0, False), (12, True)):
        fit, frames = join_frames(
            fit_of(times, numbers=np.arange(10)), names_of(range(0, 10, 3)), times[::3], total=total
        )
        assert frames.tolist() == [0, 1, 2, 3] and fit.numbers.tolist() == [0, 3, 6, 9]
        assert any_holds(fit.notes, "f.npz", "0 to 9 of 12") == said
