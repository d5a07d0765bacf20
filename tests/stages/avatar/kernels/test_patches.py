"""Patches that look alike are found, and laid over each other."""

import numpy as np
import pytest

from stages.avatar.kernels.patches import ASIDE, REACH, overlay, search

SIZE = 40
FAR = 1e6  # how far apart patches are does not count


def window(picture, at):
    y, x = at
    return picture[y - REACH : y + REACH + 1, x - REACH : x + REACH + 1]


def asked(seed=0, colours=3):
    """A random picture, four patches of it that are wanted, and where else one may look for them."""
    rng = np.random.default_rng(seed)
    picture = rng.random((SIZE, SIZE, colours)).astype(np.float32)
    wanted = np.array([[10, 10], [10, 11], [11, 10], [30, 30]])
    row = np.full((SIZE, SIZE), -1)
    row[tuple(wanted.T)] = np.arange(len(wanted))
    sources = np.zeros((SIZE, SIZE), bool)
    sources[REACH:-REACH, 22 : SIZE - REACH] = True
    found = np.argwhere(sources)[rng.integers(0, sources.sum(), len(wanted))]
    return picture, wanted, row, found, sources


@pytest.mark.parametrize("far", [FAR, 10.0])
def test_costs_are_squares_of_differences_and_of_distances(far):
    picture, wanted, row, found, sources = asked()
    costs = search(picture, wanted, row, found, sources, far, np.random.default_rng(0))
    assert sources[tuple(found.T)].all()
    for at, source, cost in zip(wanted, found, costs):
        down, aside = (source - at) / [far, ASIDE * far]
        apart = (window(picture, at) - window(picture, source)) ** 2
        assert cost == pytest.approx(apart.sum(dtype=float) + down**2 + aside**2, rel=1e-5)


def test_what_goes_on_beside_a_patch_that_was_found_is_found_at_once():
    picture, wanted, row, found, sources = asked()
    picture[5:17, 24:36] = picture[5:17, 5:17]  # all of the first three patches, 19 px to the right
    found[0] = [10, 29]
    costs = search(picture, wanted, row, found, sources, FAR, np.random.default_rng(0))
    assert (found[:3] == wanted[:3] + [0, 19]).all() and (costs[:3] < 1e-6).all()


def test_the_same_patch_is_found_by_chance_in_the_end():
    picture, wanted, row, found, sources = asked()
    picture[5:17, 24:36] = picture[5:17, 5:17]
    rng = np.random.default_rng(0)
    for _ in range(100):
        search(picture, wanted, row, found, sources, FAR, rng)
    assert (found[:3] == wanted[:3] + [0, 19]).all()


def test_searching_again_never_makes_it_worse():
    picture, wanted, row, found, sources = asked(1)
    before = search(picture, wanted, row, found, sources, FAR, np.random.default_rng(0))
    after = search(picture, wanted, row, found, sources, FAR, np.random.default_rng(1))
    assert (after <= before).all() and (after < before).any()


def test_a_pixel_is_the_mean_of_what_patches_over_it_say_or_that_of_the_best():
    picture, wanted, row, found, _ = asked(2)
    hole = np.zeros((SIZE, SIZE), bool)
    hole[10, 10] = True
    costs = np.array([1.0, 2.0, 3.0, 0.0])
    said = [picture[tuple(found[t] + [10, 10] - wanted[t])].astype(float) for t in range(3)]
    for spread, counts in ((0.5, np.exp([0.0, -1.0, -2.0])), (1e-6, [1.0, 0, 0])):
        filled = overlay(picture, hole, row, found, costs, spread)
        assert filled[10, 10] == pytest.approx(np.average(said, axis=0, weights=counts), rel=1e-5)
        assert np.array_equal(filled[~hole], picture[~hole])
