"""From footprints to pixels and back, where that breaks: sections B and C of the hard cases, each test with its numbers."""

import math

import numpy as np
import pytest
import torch

from stages.avatar.model.scene import MOVABLE, START_OPACITY, SceneModel
from stages.avatar.rasterize import Camera, Gaussians, Layer, cpu, gaussian_axes, reference
from stages.avatar.rasterize.rendering import ALPHA_MAX, BLUR
from stages.avatar.splats.gaussians import Splats
from tests.made.learned import compose
from tests.made.rasterized import (
    MAKERS,
    NAMES,
    STRAIGHT,
    apart,
    ball,
    both,
    camera,
    cast,
    draw,
    gaussians,
    largest,
    show,
    worst,
)


@both
def test_b01_opacity_above_the_bound_draws_the_bound_and_gets_no_gradient(maker, dtype, held):
    K = torch.tensor([[60.0, 0, 4.5], [0, 60, 4.5], [0, 0, 1]])
    drawn, grads = draw(maker, ball(sigma=1.0, opacity=1.0), STRAIGHT, K, 9, 9, dtype)
    held(abs(drawn.alpha[4, 4].item() - ALPHA_MAX), 1e-7)
    assert grads[4].abs().min() > 0 and grads[3].abs().max() > 0  # colour everywhere, opacity from the outer pixels
    K[:2, 2] = 0.5
    _, middle = draw(maker, ball(sigma=1.0, opacity=1.0), STRAIGHT, K, 1, 1, dtype)
    assert middle[3].abs().max() == 0 and middle[4].abs().min() > 0


@pytest.mark.parametrize(
    "layers, opacity, low, high", [(1, 1.0, 0.999, 0.999), (6, 1.0, 0.999, 0.9999), (6, 0.98, 0.9996, 0.9999)]
)
def test_b02_the_early_stop_leaves_no_hole(layers, opacity, low, high, held):
    fast, true = (
        show(m, cast(ball(layers, opacity=opacity), d), STRAIGHT, camera()[1], 61, 45).alpha[22, 30] for m, d in MAKERS
    )
    assert low - 1e-6 <= fast.item() <= high + 1e-6
    held(largest(fast, true), 1e-7)


@both
def test_b02_the_second_of_two_opaque_ones_may_fall_on_either_side_of_the_stop(maker, dtype):
    """0.01^2 is the bound itself: what is declared is the band, in which 1 % of the background shows or not."""
    parts = ball(2, opacity=0.99)
    for nudge in (-1e-6, 0.0, 1e-6):
        parts[3] = torch.full((2,), 0.99 + nudge)
        alpha = show(
            maker, cast(parts, dtype), STRAIGHT, torch.tensor([[60.0, 0, 30.5], [0, 60, 22.5], [0, 0, 1]]), 61, 45
        )
        assert 0.99 - 2e-6 <= alpha.alpha[22, 30] <= 0.9999 + 1e-6


@pytest.mark.parametrize("opacity, layers", [(0.5, 300), (0.02, 300), (0.99999, 40)])
def test_b03_hundreds_of_layers(opacity, layers, held):
    """Half-opaque or all but clear, T passes through float32's end or every digit counts; gradients stay right."""
    parts = ball(layers, opacity=opacity)
    (fast, grads), (true, true_grads) = (draw(m, parts, STRAIGHT, camera()[1], dtype=d) for m, d in MAKERS)
    assert true.alpha.max() > 0.99 and (fast.image - true.image).abs().median() < 1e-6
    assert all(g.isfinite().all() for g in grads)
    for name, a, b in zip(NAMES, grads, true_grads, strict=True):
        if name not in ("quats", "viewmat"):  # of round Gaussians on the axis these are 0, or differences
            held(apart(a, b), 3e-5, name)


def test_b04_thirty_thousand_at_random(held):
    parts = gaussians(30_000)
    K = torch.tensor([[16.0, 0, 8], [0, 16, 6], [0, 0, 1]])
    fast, true = (show(m, cast(parts, d), STRAIGHT, K, 16, 12) for m, d in MAKERS)
    assert fast.image.isfinite().all() and 0.999 < fast.alpha.max() <= 1
    held(largest(fast.image, true.image), 4e-6)


@both
def test_b05_opaque_stacks_do_not_blow_gradients_up(maker, dtype, held):
    """1 / (1 - alpha) is 1000 at the bound: 16 opaque layers against 16 half-opaque ones."""
    grads = {}
    for opacity in (0.5, 0.9, 0.99, 0.9989, 1.0):
        parts = ball(16, opacity=opacity)
        parts[0] = parts[0] + 0.01 * torch.arange(16)[:, None] * torch.tensor([1.0, 0.5, 1])
        grads[opacity] = draw(maker, parts, STRAIGHT, camera()[1], dtype=dtype)[1]
        assert all(g.isfinite().all() for g in grads[opacity])
        held(worst(g.abs().max() / h.abs().max() for g, h in zip(grads[opacity], grads[0.5]) if h.any()), 15)


@both
def test_b06_equal_depths_are_drawn_in_the_order_of_rows(maker, dtype, held):
    parts = ball(50, opacity=0.3)
    first = show(maker, cast(parts, dtype), STRAIGHT, camera()[1], 61, 45)
    again = (show(maker, cast(parts, dtype), STRAIGHT, camera()[1], 61, 45).image for _ in range(9))
    assert all(torch.equal(first.image, image) for image in again)
    true = show(reference, cast(parts), STRAIGHT, camera()[1], 61, 45)
    held(largest(first.image, true.image), 3e-6)
    backwards = show(maker, cast([p.flip(0) for p in parts], dtype), STRAIGHT, camera()[1], 61, 45)
    assert largest(first.image, backwards.image) > 0.01, "the colours must tell the order"
    cloned = [torch.cat([p, p[20:21]]) for p in parts]
    two = [show(maker, cast(cloned, dtype), STRAIGHT, camera()[1], 61, 45).image for _ in range(2)]
    assert torch.equal(*two)
    parts[4][:] = 0.5
    one, two = (show(maker, cast(p, dtype), STRAIGHT, camera()[1], 61, 45) for p in (parts, [p.flip(0) for p in parts]))
    held(largest(one.image, two.image), 1e-6)


@both
def test_b07_a_change_of_order_is_no_more_than_the_two_share(maker, dtype, held):
    """A step of alpha^2 |c1 - c2| where both cover, nothing elsewhere: what a pop can be, and that it is not avoided."""
    parts = ball(2, opacity=0.9)
    parts[0] = torch.tensor([[-0.1, 0, 3.0], [0.1, 0, 3.0]])
    parts[4] = torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    one, two = (p[0].clone() for p in (parts, parts))
    two[0, 2], two[1, 2] = torch.nextafter(two[0, 2], torch.tensor(9.0)), torch.nextafter(two[1, 2], torch.tensor(0.0))
    pictures = [
        show(maker, cast([m, *parts[1:]], dtype), STRAIGHT, camera()[1], 61, 45).image[..., 0] for m in (one, two)
    ]
    singles = [
        show(maker, cast([p[i : i + 1] for p in parts], dtype), STRAIGHT, camera()[1], 61, 45).alpha for i in (0, 1)
    ]
    jump = (pictures[0] - pictures[1]).abs()
    assert jump.max() > 0.3
    held((jump - singles[0] * singles[1]).max(), 1e-6)


@both
def test_b08_an_outlier_far_away_changes_no_bit(maker, dtype):
    parts = gaussians(100)
    outlier = ball(1, z=1e7)
    outlier[0] = outlier[0] + torch.tensor([2e7, 0, 0])  # beside the picture
    outlier = [torch.cat([p, q]) for p, q in zip(parts, outlier)]
    view, K = camera()
    one, two = (show(maker, cast(p, dtype), view, K, 61, 45) for p in (parts, outlier))
    assert one.alpha.max() > 0.5 and torch.equal(one.image, two.image)


@both
@pytest.mark.parametrize("n, z", [(5, -3.0), (0, 3.0)])
def test_b09_nothing_to_draw_is_exactly_the_background(n, z, maker, dtype):
    background = torch.tensor([0.2, 0.5, 0.7])
    drawn, grads = draw(maker, ball(n, z=z), *camera(), dtype=dtype, background=background)
    assert torch.equal(drawn.image, background.to(dtype).expand(45, 61, 3)) and drawn.alpha.max() == drawn.dropped == 0
    for p, g in zip(ball(n, z=z), grads):
        assert g.shape == p.shape and (g == 0).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (37, 1), (17, 16), (31, 33), (32, 64), (64, 32), (65, 97)])
@pytest.mark.parametrize("n", [1, 60])
def test_b10_sizes(size, n, held):
    """Edge tiles, one tile, powers of two, a single Gaussian: every pixel written, last row and column included."""
    width, height = size
    parts = gaussians(60) if n > 1 else ball(sigma=0.5)
    view, K = camera(width, height, focal=30)
    (fast, grads), (true, true_grads) = (draw(m, parts, view, K, width, height, d) for m, d in MAKERS)
    assert fast.image.shape == (height, width, 3) and (true.radii > 0).any()
    assert ((fast.image - true.image).abs() > 3e-5).float().mean() < 1e-3
    held(worst(apart(a, b) for a, b in zip(grads[:1] + grads[2:5], true_grads[:1] + true_grads[2:5])), 1.5e-5)


@both
def test_b11_the_background_shows_through_what_is_left(maker, dtype, held):
    parts = cast(gaussians(), dtype)
    grounds = [torch.full((3,), b, dtype=dtype, requires_grad=True) for b in (0.0, 1.0)]
    black, white = (show(maker, parts, *camera(), 61, 45, layers=[Layer(background=b)]) for b in grounds)
    left = (1 - black.alpha)[..., None]
    held(largest(white.image - black.image, left.expand_as(black.image)), 4e-7)
    assert torch.equal(white.alpha, black.alpha)
    (slope,) = torch.autograd.grad(white.image.sum(), grounds[1])
    held(apart(slope, left.sum().expand(3)), 4e-7)


def test_b12_no_seam_between_tiles(held):
    K = torch.tensor([[60.0, 0, 33], [0, 60, 31], [0, 0, 1]])
    parts = ball(sigma=0.6, opacity=1.0)  # 12 px
    fast, true = (show(m, cast(parts, d), STRAIGHT, K, 96, 96).alpha for m, d in MAKERS)
    assert (true > 0).float().mean() > 0.3
    held(largest(fast, true), 1e-6)


def seen_at(reach, opacity, maker, dtype):
    """dL/d opacity of a Gaussian of which only pixels from `reach` sigma on are in the picture."""
    sigma = 4.0  # px, with the blur
    parts = ball(sigma=math.sqrt(sigma**2 - BLUR) / 20, opacity=opacity)
    K = torch.tensor([[60.0, 0, 0.5 - reach * sigma], [0, 60, 0.5], [0, 0, 1]])
    return draw(maker, parts, STRAIGHT, K, 8, 1, dtype)[1][3].item()


@both
def test_b13_no_opacity_in_training_hides_the_tails(maker, dtype):
    """Fainter than 1/255 is skipped in the backward pass too: after a reset to 0.01, all beyond 1.37 sigma is dead.

    There is no reset here. Rows start where three sigma are alive, and growth keeps their opacities (test_densify).
    """
    assert seen_at(1.3, 0.01, maker, dtype) > 0 == seen_at(1.5, 0.01, maker, dtype), "what a reset would do"
    assert seen_at(2.0, 0.01, maker, dtype) == 0 < seen_at(2.0, 0.03, maker, dtype)
    assert seen_at(3.0, START_OPACITY, maker, dtype) > 1e-3


def test_b14_every_number_is_written(monkeypatch):
    """Buffers begin with whatever memory holds: here not-a-number, and the pictures are the same."""
    parts, (view, K) = gaussians(), camera(45, 70)
    layers = [Layer(), Layer(torch.arange(300) < 40, (3, 9, 40, 62)), Layer(torch.zeros(300, dtype=torch.bool))]

    def everything():
        leaves = [p.clone().requires_grad_() for p in (*parts, view)]
        axes = cpu.gaussian_axes(*leaves[1:3])
        drawn = cpu.rasterize(Gaussians(leaves[0], axes, *leaves[3:5]), Camera(leaves[5], K, 45, 70), layers)
        sum(d.image.sum() + d.alpha.sum() + d.depth.sum() for d in drawn).backward()
        return [t for d in drawn for t in (d.image, d.alpha, d.depth, d.screen_grad, d.screen_grad_abs)] + [
            leaf.grad for leaf in leaves
        ]

    clean, empty, filled = everything(), np.empty, []

    def garbage(shape, dtype=float):
        array = empty(shape, dtype)
        array.view(np.uint8).fill(255)  # not-a-number, and -1
        filled.append(array.size)
        return array

    monkeypatch.setattr(cpu.np, "empty", garbage)
    assert all(torch.equal(a, b) for a, b in zip(everything(), clean, strict=True)) and sum(filled) > 1e4


def test_b17_two_sets_are_sorted_as_one(held):
    human, scene = gaussians(80, seed=1), gaussians(80, seed=2)
    view, K = camera()
    one = show(cpu, [torch.cat(p) for p in zip(human, scene)], view, K, 61, 45)
    two = show(cpu, [torch.cat(p) for p in zip(scene, human)], view, K, 61, 45)
    held(largest(one.image, two.image), 1e-6)
    sets = [Splats(p[0], gaussian_axes(*p[1:3]), p[3], p[4][:, None]) for p in (human, scene)]
    seen = Camera(view, K, 61, 45)
    joint, front, back = (compose(*pair, seen)[0] for pair in (sets, (sets[0], None), (None, sets[1])))
    pasted = front.image + (1 - front.alpha)[..., None] * back.image
    assert largest(joint.image, pasted) > 0.05, "interleaved in depth, not one before the other"
    nobody = Splats(*(t[:0] for t in sets[0][:4]))
    for pair in ((sets[0], nobody), (nobody, sets[0])):
        assert torch.equal(compose(*pair, seen)[0].image, front.image)


def test_c01_gradients_at_points_that_are_chosen(held):
    """On the axis, a needle, a long quaternion, faint, opaque just under the bound, two behind each other."""
    K = torch.tensor([[20.0, 0, 4], [0, 20, 4], [0, 0, 1]]).double()
    means = torch.tensor([[0, 0, 2.0], [0.1, -0.05, 2.2], [0.1, -0.05, 2.4], [-0.2, 0.1, 3], [0.15, 0.2, 2.7]]).double()
    quats = torch.tensor([[1, 0, 0, 0], [0.3, 0.2, 0.9, 0.1], [3, 0, 0, 0.1], [0.5, 0.5, 0.5, 0.6], [1, 2, -1, 1.0]])
    scales = torch.tensor([[0.6, 0.6, 0.6], [3, 0.003, 0.003], [0.5, 0.7, 0.6], [0.9, 0.5, 0.4], [0.5, 0.5, 0.8]])
    opacities = torch.tensor([0.02, 0.5, 0.97, 0.9989, 0.4])
    leaves = [t.double().requires_grad_() for t in (means, quats, scales, opacities, torch.full((5, 3), 0.4))]

    def picture(*parts):
        return show(reference, parts, STRAIGHT.double(), K, 8, 8).image

    analytic = torch.autograd.grad(picture(*leaves).sum(), leaves)
    assert all(g.abs().max() > 1e-3 for g in analytic)
    assert torch.autograd.gradcheck(
        picture, leaves, eps=1e-7, atol=1e-5, rtol=1e-4, check_undefined_grad=False, fast_mode=True
    )
    fast = draw(cpu, [t.detach().float() for t in leaves], STRAIGHT, K.float(), 8, 8)[1]
    true = draw(reference, [t.detach().float() for t in leaves], STRAIGHT, K, 8, 8, torch.float64)[1]
    held(worst(apart(a, b) for a, b in zip(fast[:5], true[:5])), 8e-6)


def test_c04_an_opaque_gaussian_can_still_become_clear():
    """float32's sigmoid is 1 from 17 on, and its slope 0; opacities are held where they move."""
    logits = torch.tensor([MOVABLE, 17.0], requires_grad=True)
    logits.sigmoid().sum().backward()
    assert logits.grad[0] >= 2.9e-7 and logits.grad[1] == 0
    scene = SceneModel(torch.rand(3, 3), torch.rand(3, 3), 0, 1.0)
    with torch.no_grad():
        scene.logit_opacities.copy_(torch.tensor([40.0, -40, 3.123]))
    scene.clamp_opacities()
    assert scene.logit_opacities.tolist() == [MOVABLE, -MOVABLE, torch.tensor(3.123).item()]
    adam = torch.optim.Adam([scene.logit_opacities], lr=0.5, eps=1e-15)
    for _ in range(30):
        adam.zero_grad()
        scene.splats().opacities[0].backward()
        adam.step()
    assert scene.splats().opacities[0] < 0.999


@pytest.mark.parametrize("sigma", [1e-4, 1e-2, 1.0, 1e2, 1e4])
def test_c05_gradients_of_the_inverse_covariance_from_a_hundredth_of_a_pixel_to_a_million(sigma, held):
    """A damped 1 / det^2 would be wrong at both ends. Determinants go from 0.1 to 1e21 px^4."""
    parts = ball(3, sigma=sigma, opacity=0.7)
    parts[0] = torch.tensor([[0.01, 0.02, 3], [0.03, -0.02, 3.2], [-0.02, 0.03, 2.8]])
    parts[2] = parts[2] * torch.tensor([1.0, 0.5, 2])
    parts[1] = torch.tensor([[0.9, 0.2, -0.3, 0.4]]).repeat(3, 1)
    (_, grads), (_, true_grads) = (draw(m, parts, STRAIGHT, camera()[1], dtype=d) for m, d in MAKERS)
    assert all(g.abs().max() > 0 for g in true_grads[:5])
    held(worst(apart(a, b) for a, b in zip(grads[:5], true_grads[:5])), 1e-5)


def test_c07_what_is_out_of_reach_gets_exactly_nothing():
    parts = ball(2)
    parts[0] = parts[0].clone()
    parts[0][1, 0] = 20.0
    drawn, grads = draw(cpu, parts, STRAIGHT, camera()[1])
    assert drawn.radii[0] > 0 and drawn.radii[1] == 0
    assert all((g[1] == 0).all() for g in grads[:5]) and (drawn.screen_grad[1] == 0).all()
