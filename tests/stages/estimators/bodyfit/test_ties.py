"""Frames far apart that show the same cloth: laid over each other by the body, and tied where they are off."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from stages.estimators.bodyfit.ties import Ties, correlation

RNG = np.random.default_rng(0)
SIZE, FOCAL = (240, 320), 300.0
K = np.array([[FOCAL, 0, 160], [0, FOCAL, 120], [0, 0, 1]])
CLOTH = cv2.resize(RNG.integers(0, 255, (40, 30, 3), np.uint8), (150, 200), interpolation=cv2.INTER_CUBIC)
COUNT, FAR = 11, 10


def plate(at: float, z: float = 3.0) -> np.ndarray:
    """Vertices [4,3] m of an upright plate, `at` m to the right."""
    return np.array([[-0.75, -1, 0], [0.75, -1, 0], [0.75, 1, 0], [-0.75, 1, 0]]) + [at, 0, z]


FACES = np.array([[0, 1, 2], [0, 2, 3]])


def frames(moves: np.ndarray, gain: float = 1.0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures and masks of the plate in its cloth at each place; the last one `gain` times as bright."""
    images, masks = [], []
    for i, x in enumerate(moves):
        corners = plate(x)[:, :2] / 3.0 * FOCAL + [160, 120]
        into = cv2.getAffineTransform(np.float32([[0, 0], [150, 0], [150, 200]]) - 0.5, np.float32(corners[:3]) - 0.5)
        image = cv2.warpAffine(CLOTH, into, SIZE[::-1], flags=cv2.INTER_LINEAR)
        masks.append(cv2.warpAffine(np.full(CLOTH.shape[:2], 255, np.uint8), into, SIZE[::-1]))
        images.append(np.clip(image * (gain if i == len(moves) - 1 else 1.0), 0, 255).astype(np.uint8))
    return images, masks


def tied(moves: np.ndarray, believed: np.ndarray, gain: float = 1.0):
    images, masks = frames(moves, gain)
    ties = Ties(images, masks, np.tile(K, (len(moves), 1, 1)), FACES)
    return ties.find(np.stack([plate(x) for x in believed]))


MOVES = np.linspace(0, 0.2, COUNT)


@pytest.mark.parametrize("gain", [1.0, 0.7])
def test_a_body_in_the_wrong_place_is_told_where_the_cloth_is(gain):
    wrong = MOVES.copy()
    wrong[5:] += 0.05  # 5 px
    flow, off = tied(MOVES, wrong, gain)
    assert off * 256 == pytest.approx(5 * 256 / 240, rel=0.25)
    pair = int(((flow.first == 0) & (flow.second == FAR)).nonzero()[0, 0])
    way, sure = flow.at(torch.tensor([[160.0, 120.0], [140, 100], [180, 150]]).expand(len(flow.first), 3, 2))
    assert (sure[pair] > 0.9).all()
    true = torch.tensor([0.2 / 3.0 * FOCAL, 0.0]).expand(3, 2)
    torch.testing.assert_close(way[pair], true, atol=0.5, rtol=0)


def test_where_the_body_is_right_nothing_is_off():
    flow, off = tied(MOVES, MOVES)
    assert len(flow.first) == (COUNT - 5) + (COUNT - 10) and off * 256 < 0.2


def test_other_cloth_is_not_tied_and_an_empty_mask_is_left_out():
    images, masks = frames(MOVES)
    images[FAR] = np.roll(images[FAR][..., ::-1][::-1], 7, 0)  # upside down
    ties = Ties(images, masks, np.tile(K, (COUNT, 1, 1)), FACES)
    flow, _ = ties.find(np.stack([plate(x) for x in MOVES]))
    assert FAR not in flow.second.tolist()
    nobody = Ties(images, [0 * mask for mask in masks], np.tile(K, (COUNT, 1, 1)), FACES)
    flow, off = nobody.find(np.stack([plate(x) for x in MOVES]))
    assert len(flow.first) == 0 and np.isnan(off)


def test_pictures_without_a_pattern_are_not_alike():
    flat = np.full((40, 40), 128, np.uint8)
    noise = RNG.integers(0, 255, (40, 40), np.uint8)
    assert abs(correlation(flat, flat)).max() < 0.05 and correlation(noise, noise).min() > 0.95
    assert np.isfinite(correlation(flat, noise)).all() and abs(correlation(noise, 255 - noise) + 1).max() < 0.05
