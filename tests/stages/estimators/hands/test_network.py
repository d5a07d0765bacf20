"""The hand network on the kitchen clip, and crops that fit."""

import numpy as np

from stages.estimators.hands.network import HandNetwork, around
from stages.estimators.person.crops import Roi
from tests.made.hands import seen
from tests.made.networks import fetched

TIPS = [4, 8, 12, 16, 20]


def test_a_crop_fits_a_hand_whose_fingers_point_anywhere():
    upright = seen(100, 200).xy
    roi = around(upright)
    for degrees in (30, 120, 250):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = around(upright @ np.array([[c, s], [-s, c]]))
        assert np.isclose((turned.angle - roi.angle) % (2 * np.pi), np.radians(degrees)) and np.isclose(
            turned.side, roi.side
        )


def test_the_kitchen_mans_five_fingers_are_seen(kitchen):
    """His raised open right hand from a crop beside it; in the mirror it is a left one, with its points mirrored."""
    fetched("hand_landmark_full.tflite")
    network, image = HandNetwork(), kitchen[50]
    hand = network.read(image, Roi(156, 300, 122, 0.0), False)
    apart = np.linalg.norm(np.diff(hand.xy[TIPS], axis=0), axis=1)
    assert (
        hand.presence > 0.9 and hand.side > 0.7 and (apart > 9).all() and (hand.xy[TIPS, 1] < hand.xy[0, 1] - 20).all()
    )
    mirrored = np.ascontiguousarray(image[:, ::-1])
    there = Roi(image.shape[1] - 156, 300, 122, 0.0)
    other = network.read(mirrored, there, True)
    assert np.abs(other.xy * [-1, 1] + [image.shape[1], 0] - hand.xy).max() < 2
    assert np.abs(other.world * [-1, 1, 1] - hand.world).max() < 0.01
    assert network.read(mirrored, there, False).side < 0.5
