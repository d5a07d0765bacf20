"""Fingers bent to made points: how near, what is filled in, what is left out."""

import numpy as np

from stages.estimators.hands.bending import bend, palm_turns
from tests.made.hands import hand, points, waving

FRAMES = 30
TIMES = np.arange(FRAMES) / 15


def bent_to(world, sure):
    """Hands bent to points in space, which the picture shows across the view, 400 px a metre."""
    return bend(hand(), world, 400 * world[..., :2] + 100, np.full(sure.shape, 400.0), sure, TIMES[: sure.shape[1]])


def off(bent, angles):
    """Mean distance [F] m of the bones' ends."""
    return (hand().points(bent.angles[0]) - hand().points(angles)).norm(dim=-1).mean((1, 2)).numpy()


def test_fingers_are_found_within_what_is_expected():
    angles = waving(FRAMES)
    bent = bent_to(points(angles, 0.003)[None], np.ones((1, FRAMES), bool))
    apart = off(bent, angles)
    assert apart.mean() < 0.006 and apart.mean() < bent.error.mean() < 5 * apart.mean()
    assert (bent.angles >= hand().low).all() and (bent.angles <= hand().high).all() and bent.fits.mean() > 0.9


def test_frames_that_are_not_sure_are_filled_in_smoothly_with_a_larger_error():
    angles = waving(FRAMES)
    seen, sure = points(angles)[None], np.ones((1, FRAMES), bool)
    sure[0, 10:13] = False
    seen[0, 10:13] = 0
    bent = bent_to(seen, sure)
    assert off(bent, angles)[10:13].max() < 0.03 and not bent.fits[0, 10:13].any()
    assert bent.error[0, 11] > 1.3 * bent.error[0, 5]


def test_points_that_no_hand_makes_are_left_out():
    angles = hand().relaxed.expand(FRAMES, 21)
    seen = points(angles)[None]
    seen[0, 7, 5:] = np.random.default_rng(0).normal(0, 0.05, (16, 3))
    bent = bent_to(seen, np.ones((1, FRAMES), bool))
    assert np.flatnonzero(~bent.fits[0]).tolist() == [7] and off(bent, angles).max() < 0.01


def test_a_palm_is_turned_as_its_points_are_and_never_mirrored():
    rest = hand().palm
    turned = palm_turns(points(waving(4)), rest)
    assert np.allclose(np.linalg.det(turned), 1)
    back = np.einsum("fji,fpj->fpi", turned, points(waving(4))[:, [0, 5, 9, 13, 17]])
    assert np.abs(back - rest).max() < 1e-6
    mirrored = palm_turns(points(waving(4)) * [-1, 1, 1], rest)
    assert np.allclose(np.linalg.det(mirrored), 1)


def test_the_two_hands_do_not_touch_each_other():
    angles = waving(8)
    both = np.stack([points(angles), points(hand().relaxed.expand(8, 21))])
    alone = bent_to(both[:1], np.ones((1, 8), bool))
    pair = bent_to(both, np.ones((2, 8), bool))
    assert np.abs(off(alone, angles) - off(pair, angles)).max() < 2e-3 and off(pair, angles).max() < 0.013
