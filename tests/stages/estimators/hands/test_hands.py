"""Hands in gloves, that hold something, or that something hides: they are read as well as bare ones, or seldom.

Of drawn hands 60 px long; `python -m tests.benchmarks.hands --hidden` has the table.
"""

import numpy as np
import pytest

from stages.estimators.hands.network import HandNetwork
from tests.benchmarks.hands import GLOVES, HIDDEN, looked
from tests.made.networks import fetched

HANDS = 24
NONE, FEW = ("holds a phone", "holds a bottle", "behind the back", "blurred"), {"fingers behind something": 0.6}


@pytest.fixture(scope="module")
def network():
    fetched("hand_landmark_full.tflite")
    return HandNetwork()


@pytest.fixture(scope="module")
def bare(network):
    return looked(60, HANDS, network)


@pytest.mark.slow
@pytest.mark.parametrize("glove", GLOVES)
def test_hands_in_gloves_are_read_as_bare_ones_are(network, bare, glove):
    found = looked(60, HANDS, network, GLOVES[glove])
    assert bare.read.mean() > 0.8 and found.read.mean() > 0.4
    assert np.median(found.off) < 1.2 * np.median(bare.off) and found.off.mean() < 1.3 * found.expected.mean()


@pytest.mark.slow
@pytest.mark.parametrize("how", [*NONE, *FEW])
def test_hands_that_something_hides_are_not_read_or_seldom(network, how):
    found = looked(60, HANDS, network, hide=HIDDEN[how])
    assert found.read.mean() <= FEW.get(how, 0)
