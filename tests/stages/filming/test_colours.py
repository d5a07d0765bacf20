"""Exposure and tint of clips, and what people's colours are multiplied by in another one's scene."""

import numpy as np
import pytest
import torch

from stages.avatar.model.scene import load_scene
from stages.filming.colours import (
    DOUBT_EXPOSURE,
    DOUBT_TINT,
    MOST_EXPOSURE,
    MOST_TINT,
    Look,
    gain_between,
    look_of,
    look_of_clip,
    look_of_scene,
    match,
)
from stages.formats.clip import load_clip
from stages.records import Ground, Scene
from tests.made.said import holds
from tests.made.tiny import spots


def room(seed: int, gain: np.ndarray | float = 1.0) -> np.ndarray:
    """Pixels of grey walls, white paint, brown wood and bright toys, as a camera with these gains shows them."""
    rng = np.random.default_rng(seed)
    parts = [((0.55, 0.54, 0.52), 5000), ((0.8, 0.8, 0.79), 1500), ((0.5, 0.35, 0.2), 3000), ((0.8, 0.1, 0.1), 800)]
    pixels = np.concatenate([np.array(color) * rng.normal(1, 0.08, (count, 1)) for color, count in parts])
    return np.rint((pixels * gain).clip(0, 1) * 255).astype(np.uint8)


@pytest.mark.parametrize("gain", [(0.7, 0.7, 0.7), (1.05, 0.95, 0.85), (0.8, 0.9, 1.0)])
def test_what_a_camera_multiplies_colours_by_is_measured(gain):
    plain, other = look_of(room(0)), look_of(room(1, np.array(gain)))
    assert np.exp(other.exposure - plain.exposure) == pytest.approx(np.prod(gain) ** (1 / 3), rel=0.03)
    ratios = np.array([gain[0], gain[2]]) / gain[1]
    np.testing.assert_allclose(np.exp(other.tint - plain.tint), ratios, rtol=0.03)
    found = gain_between(look_of(room(2)), other, always=True)
    np.testing.assert_allclose(found, gain, rtol=0.05)


def test_dark_and_clipped_pixels_tell_nothing():
    assert look_of(np.zeros((5000, 3), np.uint8)) is None and look_of(np.full((5000, 3), 255, np.uint8)) is None
    assert look_of(room(0)[:900]) is None
    plain = look_of(room(0))
    for channel in range(3):
        for value in (0, 19, 251, 255):
            spoiled = room(1)[:6000]
            spoiled[:, channel] = value
            assert look_of(spoiled) is None, "one channel is enough"
            both = look_of(np.concatenate([room(0), spoiled]))
            assert both.exposure == plain.exposure and (both.tint == plain.tint).all() and both.sure == plain.sure


def test_a_lawn_or_a_wall_of_one_colour_tells_no_light_and_the_person_is_left_as_they_are():
    rng = np.random.default_rng(0)
    shades = rng.normal(1, 0.25, (9000, 1))
    lawn = np.r_[np.array([0.25, 0.3, 0.1]) * shades, np.full((900, 1), 0.5) * rng.normal(1, 0.1, (900, 3))]
    for colour in (lawn, np.array([0.7, 0.72, 0.7]) * shades, np.array([0.8, 0.5, 0.4]) * shades):
        look = look_of(np.rint((colour * rng.normal(1, 0.02, colour.shape)).clip(0, 1) * 255).astype(np.uint8))
        for there in (look_of(room(0)), look_of(room(1, 0.6)), look_of(room(1, np.array([1.0, 0.9, 0.75])))):
            gain, done = match(look, there, always=False)
            assert (gain == 1).all() and holds(done, "unchanged", "their clip", "too few")
            assert holds(match(there, look, always=False)[1], "unchanged", "the scene", "too few")


def test_what_was_done_is_said():
    own, there = look_of(room(0)), look_of(room(1, 0.6))
    assert own.sure == 1
    gain, done = match(own, there, always=False)
    assert gain == pytest.approx(0.6, rel=0.05) and holds(done, "red", "green", "blue", *(f"{g:.2f}" for g in gain))
    assert holds(match(own, look_of(room(2)), False)[1], "unchanged", "clips differ")
    assert holds(match(None, own, True)[1], "unchanged", "their clip", "measured")
    assert holds(match(own, None, True)[1], "unchanged", "the scene", "measured")


def test_small_differences_may_be_the_rooms_and_large_ones_are_believed():
    own = Look(-0.4, np.zeros(2), 1.0)
    for exposure, tint in ((0.9, 0.9), (-0.9, -0.9), (0.5, 0.0)):
        there = Look(-0.4 + exposure * DOUBT_EXPOSURE, np.array([tint, -tint]) * DOUBT_TINT, 1.0)
        np.testing.assert_allclose(gain_between(own, there, always=False), 1)
    there = Look(-0.4 - 2.1 * DOUBT_EXPOSURE, np.zeros(2), 1.0)
    np.testing.assert_allclose(gain_between(own, there, always=False), gain_between(own, there, always=True))


def test_unless_sure_no_gain_is_farther_off_than_none_as_long_as_rooms_differ_by_less_than_is_doubted():
    rng, own = np.random.default_rng(0), Look(0.0, np.zeros(2), 1.0)
    for _ in range(300):
        true = np.r_[rng.uniform(-0.4, 0.4), rng.uniform(-0.18, 0.18, 2)]
        error = rng.uniform(-1, 1, 3) * [DOUBT_EXPOSURE, DOUBT_TINT, DOUBT_TINT]
        found = true + error
        logs = np.log(gain_between(own, Look(found[0], found[1:], 1.0), always=False))
        exposure, tint = logs.mean(), logs[[0, 2]] - logs[1]
        left = np.abs(true - np.r_[exposure, tint])
        assert (left <= np.abs(true) + 1e-9).all()


def test_no_gain_leaves_the_limits():
    far = Look(3.0, np.array([2.0, -2.0]), 1.0)
    logs = np.log(gain_between(Look(0.0, np.zeros(2), 1.0), far, always=True))
    assert logs.mean() == pytest.approx(np.log(MOST_EXPOSURE[1]))
    np.testing.assert_allclose(logs[[0, 2]] - logs[1], np.log(MOST_TINT)[::-1])


def test_a_clip_is_measured_beside_its_person_and_a_scene_from_where_people_stand(tiny):
    """The person is of bright colours, the wall grey-green: 0.9, 1, 0.95."""
    clip = load_clip(tiny["sfm"], tiny["smpl"], tiny["train"])
    np.testing.assert_allclose(np.exp(look_of_clip(clip).tint), [0.9, 0.95], atol=0.04)
    rng = np.random.default_rng(0)
    away = rng.normal(size=(4000, 3))
    away = 3 * away / np.linalg.norm(away, axis=1, keepdims=True)
    ball = Scene(**spots(away, np.tile([0.6, 0.5, 0.4], (4000, 1)), 0.15))
    ground = Ground(np.array([0, 1.5, 0]), np.array([0, -1.0, 0]), np.array([0, 0, 1.0]), 1, 0, 0, 0, "")
    look = look_of_scene(load_scene(ball), ground)
    np.testing.assert_allclose(np.exp(look.tint), [1.2, 0.8], atol=0.02)
    dark = load_scene(ball)
    assert look_of_scene(dark._replace(sh=torch.full_like(dark.sh, -1.77)), ground) is None
