"""A network's error as its landmarks and the outline show it, and the weight that follows."""

from __future__ import annotations

import numpy as np
import pytest

from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.landmark_error import measured_errors, weighed

NAMES = tuple(f"{side}_{part}" for part in ("shoulder", "hip", "knee") for side in ("left", "right"))
COUNT, HEIGHT = 60, 200.0
MASK = np.zeros((400, 400), np.uint8)
MASK[100:300, 150:250] = 255


def evidence(noise=0.0, aside=0.0):
    """Six landmarks inside the mask that swing evenly, each with `noise` px; the first `aside` px out of the mask."""
    rng, time = np.random.default_rng(0), np.arange(COUNT)
    xy = np.full((COUNT, len(NAMES), 2), 200.0) + np.linspace(-30, 30, len(NAMES))[:, None]
    xy[..., 0] += 8 * np.sin(time / 6)[:, None]
    xy[:, 0] = [250 + aside, 200]
    xy += rng.normal(0, noise, xy.shape)
    world, weight = np.zeros((COUNT, len(NAMES), 3)), np.ones((COUNT, len(NAMES)))
    return LandmarkEvidence(NAMES, xy, weight, world, np.ones(COUNT, bool), np.full(COUNT, HEIGHT))


@pytest.mark.parametrize("noise", [0.5, 2.0, 6.0])
def test_jitter_is_measured_and_motion_is_not(noise):
    errors = measured_errors(evidence(noise), [MASK] * COUNT)
    assert errors[1:].mean() * HEIGHT / (np.sqrt(2) * noise) == pytest.approx(1, rel=0.15)


def test_what_lies_outside_the_outline_counts():
    errors = measured_errors(evidence(0.5, 8.0), [MASK] * COUNT)
    assert errors[0] == pytest.approx(8.5 / HEIGHT, rel=0.1) and errors[1:].max() < 0.006


def test_a_worse_network_weighs_less_and_a_better_one_a_little_more():
    trusts = [weighed(evidence(noise), evidence(0.6), [MASK] * COUNT)[0].trust[1:].mean() for noise in (0.1, 0.6, 4.0)]
    assert 1 < trusts[0] < 1.5 and trusts[1] == pytest.approx(1, abs=0.05) and trusts[2] < 0.2


def test_of_a_few_frames_nothing_is_measured():
    few = evidence()
    few.weight[5:] = 0
    assert np.isnan(measured_errors(few, [MASK] * COUNT)).all() and weighed(few, few, [MASK] * COUNT)[0].trust is None
