"""A walk of a step or less and a turn are told apart, and both tell the focal length and how well it is known."""

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import camera_centers
from stages.estimators.cameras import short_walk
from stages.estimators.cameras.adjustment import Observations
from stages.estimators.cameras.intrinsics import Prior, spreads, usual
from stages.estimators.cameras.motion import Pair, camera_rotations, judge_motion
from stages.estimators.cameras.short_walk import TurnOrWalk, all_tracks, compare, leftover, tracks_of
from tests.made.matches import FOCAL, HEIGHT, WIDTH, clip

SIZE, COUNT, USUAL = (WIDTH, HEIGHT), 10, usual(WIDTH)
TRACKS = 200  # half as many as stage sfm takes: of these frames they are enough


def compared(prior: Prior = USUAL, **how) -> tuple[TurnOrWalk, np.ndarray]:
    pairs, views = clip(count=COUNT, noise=0.1, **how)
    motion = judge_motion(pairs, *SIZE)
    turns, _ = camera_rotations(pairs, COUNT, motion.focal_px, motion.k, *SIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(short_walk, "ASKED", TRACKS)
        found = compare(pairs, turns, motion.focal_px, motion.k, SIZE, prior)
    assert found is not None
    return found, views


@pytest.fixture(scope="module")
def turned():
    """What is found of a camera that only turns."""
    return compared(turn=8, travel=0)[0]


def off(found, true: float = FOCAL) -> float:
    """The error of the focal length in stated spreads."""
    return abs(float(np.median(found.bundle.focals)) - true) / spreads(found, WIDTH)["focal_spread_px"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [{"turn": 3, "travel": 0.04}, {"turn": 4, "travel": 0.12, "forward": True}, {"turn": 3, "travel": 0.1, "k": -0.15}],
)
def test_a_walk_of_a_step_is_told_from_a_turn_and_fixes_its_lens(how):
    found, views = compared(**how)
    assert found.walks and not found.turns and found.wins > 1.4
    walk, seen = all_tracks(found, USUAL)
    assert off(walk) < 2 and walk.bundle.focals[0] == pytest.approx(FOCAL, rel=0.03)
    assert walk.bundle.k == pytest.approx(how.get("k", 0), abs=0.02)
    assert (
        np.median(walk.off) < 0.2
        and (walk.bundle.points[:, 3] > 0).all()
        and seen.point.max() + 1 == len(walk.bundle.points)
    )
    there, true = (
        camera_centers(v) - camera_centers(v).mean(0) for v in (walk.bundle.viewmats, views @ np.linalg.inv(views[0]))
    )
    likeness = np.linalg.svd(there.T @ true, compute_uv=False).sum() / np.linalg.norm(there) / np.linalg.norm(true)
    assert likeness > 0.98, "the path has the shape of the true one"


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"k": -0.1}, {"zoom": 1.2}])
def test_a_turn_is_no_walk_also_when_it_zooms(how, turned):
    found = compared(turn=8, travel=0, **how)[0] if how else turned
    assert found.turns and not found.walks and found.wins < 1.15
    true = FOCAL * (1 + how.get("zoom", 1)) / 2
    assert off(found.turn, true) < 2 and spreads(found.turn, WIDTH)["focal_spread_px"] < 0.03 * FOCAL
    assert np.allclose(found.turn.bundle.viewmats[:, :3, 3], 0), "adjusted, a turn stays one"


@pytest.mark.slow
def test_a_turn_that_tells_no_focal_length_keeps_what_is_known_and_says_how_little_that_is(monkeypatch):
    """Of the turn alone: no walk is looked for."""
    monkeypatch.setattr(short_walk, "_best_walk", short_walk._adjusted)
    wide, told = (compared(prior, turn=0.3, travel=0)[0].turn for prior in (USUAL, Prior(600.0, 0.02, "EXIF")))
    assert spreads(wide, WIDTH)["focal_spread_px"] > 0.05 * FOCAL and off(wide) < 2
    assert (
        told.bundle.focals[0] == pytest.approx(600, rel=0.02) and spreads(told, WIDTH)["focal_spread_px"] < 0.03 * 600
    )


@pytest.mark.slow
def test_what_is_no_parallax_is_believed_to_be_neither(turned):
    found = turned
    for wins, behind, px, turns, walks in (
        (1.1, 0.0, 0.1, True, False),
        (2, 0.0, 0.1, False, True),
        (2, 0.4, 0.1, False, False),
        (2, 0.0, 0.4, False, False),
    ):
        walk = found.walk.__class__(found.walk.bundle, np.full(9, px), 0.0, found.walk.covariance, 1.0)
        one = TurnOrWalk(found.turn, walk, [], found.seen, wins, behind)
        assert (one.turns, one.walks) == (turns, walks)


def test_matches_join_to_tracks_and_one_with_two_places_in_a_frame_is_none():
    def pair(first: int, second: int, *places: int) -> Pair:
        a, b = (np.array([[10.0 * place + i, place] for place in places]) for i in (first, second))
        return Pair(first, second, a, b)

    pairs = [pair(0, 1, 1, 2, 3), pair(1, 2, 1, 2, 3), pair(2, 3, 1, 3), pair(0, 3, 1)]
    pairs.append(Pair(0, 2, np.array([[30.0, 3.0]]), np.array([[99.0, 99.0]])))
    seen = tracks_of(pairs, SIZE, 9)
    assert seen.point.tolist() == [0] * 4 + [1] * 3 and seen.frame.tolist() == [0, 1, 2, 3, 0, 1, 2]
    assert np.array_equal(seen.xy[4:], [[20, 2], [21, 2], [22, 2]]) and len(tracks_of(pairs, SIZE, 1).frame) == 4


def test_what_is_left_is_paid_for_by_the_numbers_that_fitted_it():
    rng = np.random.default_rng(0)
    T, F, free = 300, 12, 4
    seen = Observations(np.tile(np.arange(F), T), np.repeat(np.arange(T), F), np.zeros((T * F, 2)), SIZE)
    noise = rng.normal(0, 0.2, (T, 2 * F))
    noise[:, :free] = 0  # as if so many numbers of each point had taken it
    errors = np.linalg.norm(noise.reshape(T, F, 2), axis=-1).ravel()
    assert leftover(errors, seen, 0, free, 1.0) == pytest.approx(0.2, rel=0.03)


def test_too_few_matches_say_nothing():
    pairs, _ = clip(8, 0, count=4)
    few = [Pair(pair.first, pair.second, pair.a[:6], pair.b[:6]) for pair in pairs]
    assert compare(few, np.tile(np.eye(3), (4, 1, 1)), FOCAL, 0.0, SIZE, USUAL) is None
