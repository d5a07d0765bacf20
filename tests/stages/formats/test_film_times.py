"""Whatever times a film gives, each slot of time gets a picture, and times rise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.formats.film_times import FilmTimes, TimesFall

STEPS = st.lists(st.floats(0.001, 100), min_size=7, max_size=60)


@settings(max_examples=60, deadline=None)
@given(STEPS, st.integers(2, 80), st.sampled_from([1e-9, 0.001, 0.01]))
def test_no_slot_is_empty_and_times_rise(steps, count, rounded_to):
    times = np.append(0, np.cumsum(steps))
    times = np.round(times / rounded_to) * rounded_to
    film = FilmTimes(times, times[-1] + 0.03, count)
    spots = [spot for time in times if (spot := film.at(time)) is not None]
    assert len(spots) >= len(times) - 2 * max(1, 0.01 * len(times)), "a few may be strays"
    assert (np.diff([second for second, _ in spots]) > 0).all() and (np.diff([place for _, place in spots]) >= 0).all()
    assert {int(place + 1e-6) for _, place in spots} == set(range(film.slots)) and film.slots == min(count, len(spots))


def test_even_times_are_cut_evenly():
    film = FilmTimes(np.arange(60) / 30, 2.0, 20)
    assert [int(film.at(i / 30)[1] + 1e-6) for i in range(60)] == [i // 3 for i in range(60)] and not film.said


@pytest.mark.parametrize(
    ("times", "left_out"),
    [
        ([0, 1, 2, 900, 4, 5, 6, 7, 8], [3]),  # in the middle
        ([0, -900, 2, 3, 4, 5, 6, 7, 8], [1]),
        ([0, 1, 2, 3, 4, 5, 6, 7, -900], [8]),
        ([0, 1, 2, 3, 4, 5, 6, 7, 60], [8]),
        ([0, 1, 2, 3, 4, 5, 6, 7, 12], []),  # no longer than the film itself
        ([0, 1, 2, 3, 60, 61, 62, 63, 64], []),  # a pause
        ([0, 8, 12, 14, 15, 15.25, 15.5, 15.75], [0]),  # each step half of the one before
    ],
)
def test_a_time_far_from_all_others_is_left_out_wherever_it_stands(times, left_out):
    film = FilmTimes(sorted(times), max(times) + 1 - min(min(times), 0), 80)
    spots = [film.at(time) for time in times]
    assert [i for i, spot in enumerate(spots) if spot is None] == left_out and film.slots == len(times) - len(left_out)


@pytest.mark.parametrize(
    "times", [[0, 3, 1, 2, 6, 4, 5, 7, 8], [0, 1, 2, 3, 4, 1, 2, 3, 4], [4, 3, 2, 1, 0, -1, -2, -3]]
)
def test_times_that_fall_are_refused(times):
    film = FilmTimes(sorted(times), 9.0, 80)
    with pytest.raises(TimesFall):
        [film.at(time) for time in times]


def test_equal_times_and_times_that_lack_are_those_between():
    film = FilmTimes([0, 1, 1, 2, 3, 3, 3, 4], 5.0, 80)
    told = [0, 1, 1, float("nan"), 3, 3, 3, 4]
    assert np.allclose([film.at(time)[0] for time in told], [0, 1, 1.5, 2, 3, 3 + 1 / 3, 3 + 2 / 3, 4])
