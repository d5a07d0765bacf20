"""How the person's surface moves between frames: found by optical flow, and held against by the body."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from stages.estimators.bodyfit.flow import LONGEST, SurfaceFlow, flow_cost, surface_flow

RNG = np.random.default_rng(0)
CLOTH = cv2.resize(RNG.integers(0, 255, (60, 40, 3), np.uint8), (120, 180), interpolation=cv2.INTER_CUBIC)
WALL = cv2.resize(RNG.integers(0, 255, (60, 80, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
TIMES = np.array([0.0, 0.1])


def filmed(*left: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures and masks of a piece of cloth that stands so many px from the left, before a still wall."""
    images, masks = [], []
    for x in left:
        image, mask = WALL.copy(), np.zeros(WALL.shape[:2], np.uint8)
        image[30:210, x : x + 120], mask[30:210, x : x + 120] = CLOTH, 255
        images.append(image)
        masks.append(mask)
    return images, masks


def flow_between(first: int, second: int, times: np.ndarray = TIMES) -> SurfaceFlow:
    return surface_flow(*filmed(first, second), times)


INSIDE = torch.tensor([[[150.0, 80.0], [120, 120], [180, 180]]])


def test_what_moves_is_found_within_a_fraction_of_a_pixel_and_nothing_is_said_outside():
    way, sure = flow_between(90, 97).at(INSIDE)
    assert (sure > 0.9).all()
    torch.testing.assert_close(way, torch.tensor([7.0, 0.0]).expand(1, 3, 2), atol=0.3, rtol=0)
    _, sure = flow_between(90, 97).at(torch.tensor([[[20.0, 20.0], [86, 40], [1e6, -1e6]]]))
    assert not sure.any(), "the wall, beside the cloth, and far out of the picture"


def test_frames_far_apart_and_frames_without_a_person_say_nothing():
    assert not flow_between(90, 97, np.array([0, 2 * LONGEST])).field.any()
    images, masks = filmed(90, 97)
    assert not surface_flow(images, [masks[0], 0 * masks[1]], TIMES).field.any()
    assert len(surface_flow(images[:1], masks[:1], TIMES[:1]).field) == 0


def test_a_body_that_moves_as_the_picture_does_costs_nearly_nothing():
    flow, height, shown = flow_between(90, 97), torch.full((2,), 200.0), torch.ones(2, 3)

    def cost(step: float, shown: torch.Tensor = shown) -> float:
        return float(flow_cost(flow, torch.cat([INSIDE, INSIDE + torch.tensor([step, 0])]), shown, height))

    assert cost(7.0) < 0.2 and cost(7.0) < cost(8.0) < cost(10.0)
    assert cost(10.0, 0 * shown) == 0, "what is hidden says nothing"
    assert cost(1e4) <= 9 * 3 / 2, "bounded by 3 standard deviations of each of three points"


def test_gradients_are_finite_and_one_frame_has_no_cost():
    pixels = INSIDE.expand(2, 3, 2).clone().requires_grad_()
    flow_cost(flow_between(90, 97), pixels, torch.ones(2, 3), torch.full((2,), 200.0)).backward()
    assert torch.isfinite(pixels.grad).all() and pixels.grad.any()
    images, masks = filmed(90)
    alone = surface_flow(images, masks, TIMES[:1])
    assert flow_cost(alone, INSIDE, torch.ones(1, 3), torch.ones(1)) == 0
