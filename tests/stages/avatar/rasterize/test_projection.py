"""From Gaussians to footprints on the screen, where that breaks: section A of the hard cases, each test with its numbers."""

import math
import tracemalloc

import numpy as np
import pytest
import torch

from stages.avatar.rasterize import Camera, Gaussians, cpu, gaussian_axes, reference
from stages.avatar.rasterize import projection as kernels
from stages.avatar.rasterize.rendering import ALPHA_MIN, BLUR, COMPENSATION_MIN, FRUSTUM_MARGIN
from tests.made.rasterized import (
    MAKERS,
    NAMES,
    PICTURE,
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

LONG = torch.tensor([[1000.0, 0, 32], [0, 1000.0, 32], [0, 0, 1]])  # a long lens on 64x64 px


@pytest.mark.parametrize("length", [10.0, 100.0])
def test_a01_no_pose_of_a_needle_loses_its_determinant(length, held):
    """100 000 poses in all. The truth is a product of singular values, the usual a c - b^2 in float32 shows the danger."""
    n = 50_000
    quats = torch.randn(n, 4, generator=torch.Generator().manual_seed(0))
    axes = gaussian_axes(quats, torch.tensor([length, 1e-4, 1e-4]).repeat(n, 1))
    parts = [
        t.numpy() for t in (torch.tensor([[0, 0, 3.0]]).repeat(n, 1), axes, torch.full((n,), 0.7), torch.rand(n, 3))
    ]
    records, means2d, radii = np.empty((n, 16), np.float32), np.empty((n, 2), np.float32), np.empty(n, np.float32)
    K, eye = LONG.double().numpy(), np.eye(4)
    assert kernels.project(*parts, eye, K, 64, 64, False, 0.01, cpu.CHUNKS, records, means2d, radii) == 0
    assert (radii > 0).all(), "all of them are in view"
    rows = 1000 / 3 * axes[:, :2]
    a, b = rows[:, 0], rows[:, 1]
    naive = ((a * a).sum(1) + BLUR) * ((b * b).sum(1) + BLUR) - (a * b).sum(1) ** 2
    assert (naive <= 0).float().mean() > 0.01
    with_blur = torch.cat([rows.double(), math.sqrt(BLUR) * torch.eye(2).double().expand(n, 2, 2)], 2)
    truth = torch.linalg.svdvals(with_blur).prod(1) ** 2
    det = 1 / torch.from_numpy(records[:, kernels.INVERSE_DET]).double()
    assert (det > 0).all()
    held(((det - truth) / truth).abs().max(), 2e-6)


@pytest.mark.parametrize("antialias", [False, True])
def test_a01_needles_never_exceed_their_opacity(antialias, held):
    """100000:1, from everywhere: a determinant that cancels would paint the picture."""
    means, scales, color = torch.tensor([[0.0, 0, 3]]), torch.tensor([[10.0, 1e-4, 1e-4]]), torch.ones(1, 3)
    drawn, faint, errors = 0, 1.01 * ALPHA_MIN, [0.0]
    for quat in torch.randn(200, 1, 4, generator=torch.Generator().manual_seed(0)):
        parts = (means, quat, scales, torch.tensor([0.7]), color)
        fast = show(cpu, parts, STRAIGHT, LONG, 64, 64, antialias=antialias).alpha
        true = show(reference, cast(parts), STRAIGHT, LONG, 64, 64, antialias=antialias).alpha
        drawn += true.max() > (ALPHA_MIN if antialias else 0.5)
        # a pixel whose true value straddles the cut may be left out by one of the two
        kept = torch.minimum(fast.double(), true) > faint
        assert ((fast - true).abs()[~kept] < faint).all() and (~kept & (true > faint)).float().mean() < 4e-3
        errors += (fast - true).abs()[kept].tolist()
    assert drawn > 140
    held(worst(errors), 2e-5)


@pytest.mark.parametrize("maker, dtype", [*MAKERS, (reference, torch.float32)])
def test_a01_a_needle_along_a_row_of_pixels_is_nowhere_above_its_opacity(maker, dtype, held):
    """Where pixel centres lie on the needle, the exponent is 0 but for rounding: as a sum of squares it has one sign."""
    highest, errors, drawn = [], [], 0
    K = LONG - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # the middle of a pixel
    for x, y in ((1, 1), (1, -1), (2, 1), (1, 3), (3, 2), (4, 3), (1, 5), (5, 2), (7, 3), (6, 5)):
        angle = math.atan2(y, x) / 2
        quat = torch.tensor([[math.cos(angle), 0, 0, math.sin(angle)]])
        for length in (10.0, 100.0, 1000.0):
            parts = (torch.tensor([[0.0, 0, 3]]), quat, torch.tensor([[length, 1e-4, 1e-4]]), torch.tensor([0.7]))
            parts = (*parts, torch.ones(1, 3))
            alpha, true = (show(m, cast(parts, d), STRAIGHT, K, 64, 64).alpha for m, d in ((maker, dtype), MAKERS[1]))
            drawn = max(drawn, int((true > 0.6).sum()))
            highest.append(alpha.max().item() - 0.7)
            errors.append(largest(alpha[true > 0.1], true[true > 0.1]))
    assert drawn > 40, "the needle must lie on many pixels"
    held(worst(highest), 1e-6)
    held(worst(errors), 2e-5)


@both
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("scale", [(0.1, 0.1, 0.0), (0.0, 0.2, 0.2), (0.0, 0.0, 0.0)])
def test_a02_a03_flat_and_pointlike_gaussians(maker, dtype, scale, antialias, held):
    """Edge-on pancakes and points stay finite in value and gradient, and as faint as physics says."""
    for angle in (0.0, math.pi / 2):
        parts = ball(8, opacity=0.1)
        parts[1] = torch.tensor([math.cos(angle / 2), 0, math.sin(angle / 2), 0]).repeat(8, 1)
        parts[2][0] = torch.tensor(scale)
        drawn, grads = draw(maker, parts, STRAIGHT, camera()[1], dtype=dtype, antialias=antialias)
        assert drawn.dropped == 0 and drawn.alpha.max() > 0.3
        assert all(g.isfinite().all() for g in grads)
        held(drawn.alpha.max().item() - (1 - 0.9**8), 2e-7)


@both
def test_a02_a_pancake_seen_edge_on_is_a_line_as_wide_as_the_blur(maker, dtype, held):
    """It turns through edge-on: the compensation ends on its floor, and nothing jumps."""
    K = torch.tensor([[60.0, 0, 30.5], [0, 60, 22.5], [0, 0, 1]])
    before, steps = None, []
    for angle in (math.pi / 2 + torch.linspace(-2e-3, 2e-3, 21)).tolist():
        parts = ball(opacity=0.99)
        parts[1] = torch.tensor([[math.cos(angle / 2), 0, math.sin(angle / 2), 0]])
        parts[2] = torch.tensor([[0.4, 0.4, 0.0]])
        line = show(maker, cast(parts, dtype), STRAIGHT, K, 61, 45).alpha
        seen = show(maker, cast(parts, dtype), STRAIGHT, K, 61, 45, antialias=True).alpha
        steps += [] if before is None else [largest(seen, before)]
        before = seen
    assert seen.max() > 0.99 * COMPENSATION_MIN > ALPHA_MIN
    profile = line[22, 28:33].double()
    truth = 0.99 * torch.exp(-(torch.arange(-2, 3).double() ** 2) / (2 * BLUR))
    truth = torch.where(truth < ALPHA_MIN, 0, truth)
    assert largest(profile, truth) < 1e-3 and line[13:32, 30].min() > 0.5
    held(worst(steps), 2e-2)


@both
def test_a04_enormous_scales_are_drawn_and_infinite_ones_dropped(maker, dtype, held):
    """Squares of scales leave float32 from log 44.4 on, scales themselves from 88.7 on."""
    parts = ball(4)
    parts[0] = parts[0] + torch.tensor([0, 0, 0.1]) * torch.arange(4)[:, None]
    for log_scale in (14.0, 28.0, 44.3, 45.0, 88.0):
        parts[2] = torch.full((4, 3), 0.2).index_fill_(0, torch.tensor(1), torch.tensor(log_scale).exp().item())
        drawn, grads = draw(maker, parts, STRAIGHT, camera()[1], dtype=dtype)
        true, true_grads = draw(reference, parts, STRAIGHT, camera()[1], dtype=torch.float64)
        assert drawn.radii[1] > 1e6 and drawn.alpha.min() > 0.49, "it covers the picture"
        held(largest(drawn.image, true.image), 1e-6)
        assert all(g.isfinite().all() for g in grads)
        assert apart(grads[0], true_grads[0]) < 1e-6 and apart(grads[3], true_grads[3]) < 1e-6
    parts[2] = torch.full((4, 3), 0.2).index_fill_(0, torch.tensor(1), torch.tensor(89.0).exp().item())
    drawn, _ = draw(maker, parts, STRAIGHT, camera()[1], dtype=dtype)
    clean, _ = draw(maker, [p[[0, 2, 3]] for p in parts], STRAIGHT, camera()[1], dtype=dtype)
    assert drawn.dropped == 1 and all(torch.equal(getattr(drawn, n), getattr(clean, n)) for n in PICTURE)


@both
def test_a06_c03_depths_at_under_and_near_zero(maker, dtype, held):
    """The picture and all gradients equal those of the rows in front of the camera, bit for bit."""
    depths = torch.tensor([3, 0.2, 1e-6, 0, -0.0, -1e-6, -3, math.nan])
    parts = ball(len(depths))
    parts[0] = torch.stack([0.02 * depths.nan_to_num(1), 0 * depths.nan_to_num(0), depths], 1)
    fine = depths > 0.01
    view, K = STRAIGHT, camera()[1]
    drawn, grads = draw(maker, parts, view, K, dtype=dtype)
    clean, clean_grads = draw(maker, [p[fine] for p in parts], view, K, dtype=dtype)
    assert fine.sum() == 2 and (clean.radii > 0).all() and drawn.dropped == 1
    assert all(torch.equal(getattr(drawn, name), getattr(clean, name)) for name in PICTURE)
    for a, b in zip(grads[:5], clean_grads[:5]):
        assert torch.equal(a[fine], b) and (a[~fine] == 0).all()
    held(apart(grads[5], clean_grads[5]), 1e-6, "the camera's gradient")


@both
def test_a07_nothing_behind_the_camera_is_mirrored_into_view(maker, dtype):
    parts = ball(2)
    parts[0][:, 2] = torch.tensor([-3.0, -0.5])
    assert show(maker, cast(parts, dtype), STRAIGHT, camera()[1], 61, 45).alpha.max() == 0


def test_a07_a_gaussian_around_the_camera_is_no_block_of_one_colour(held):
    parts = ball(z=0.25, sigma=2.0, opacity=0.6)
    parts[0] = torch.tensor([[0.2, 0.1, 0.25]])
    fast, true = (show(m, cast(parts, d), STRAIGHT, camera()[1], 61, 45) for m, d in MAKERS)
    assert 0.5 < fast.alpha.max() <= 0.6
    held(largest(fast.alpha, true.alpha), 8e-7)


def test_a08_beside_the_picture_no_footprint_grows_further(held):
    focal, width, height, z, sigma = 40.0, 48, 32, 3.0, 0.3
    K = torch.tensor([[focal, 0, 20], [0, focal, 16], [0, 0, 1]])
    slopes = torch.cat([torch.linspace(0, 2, 201), torch.tensor([5.0, 100.0])]).double()
    limit = (width - 20 + FRUSTUM_MARGIN * width) / focal
    local = torch.stack([slopes * z, 0 * slopes, torch.full_like(slopes, z)], 1)
    turned = sigma * torch.eye(3).double().expand(len(slopes), 3, 3)
    a = reference._project(local, turned, K.double(), width, height)[1].norm(dim=1)
    truth = focal / z * sigma * (1 + slopes**2).sqrt()
    inside, outside = slopes < limit - 1e-3, slopes > limit + 1e-3
    assert inside.any() and torch.allclose(a[outside], a[-1], rtol=1e-12) and a[-1] < truth[-1] / 50
    held(((a - truth) / truth)[inside].abs().max(), 1e-12)
    parts = (
        local.float(),
        *(p.repeat(len(slopes), 1) for p in ball(sigma=sigma)[1:3]),
        torch.full((len(slopes),), 0.9),
    )
    fast, true = (show(m, cast((*parts, torch.ones(len(slopes), 3)), d), STRAIGHT, K, width, height) for m, d in MAKERS)
    assert torch.equal(fast.radii.double(), true.radii) and (fast.radii[slopes > 2] == 0).all()
    assert (fast.radii[outside] > 0).any(), "some lie beyond the margin and reach into the picture"


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("share", [0.99, 1.01, 3.0])
def test_a09_c01_gradient_on_both_sides_of_the_clamped_direction(side, share):
    """Also the first-hand proof that the reference's gradients are right."""
    focal, width = 20.0, 12
    limit = (0.5 + FRUSTUM_MARGIN) * width / focal
    view, K = STRAIGHT.double(), torch.tensor([[focal, 0, 6], [0, focal, 6], [0, 0, 1]]).double()
    means = torch.tensor([[side * share * limit * 2, 0.1, 2], [0.05, -0.1, 2.5]]).double()
    leaves = [
        means,
        torch.randn(2, 4, generator=torch.Generator().manual_seed(3)).double() * 3,
        torch.tensor([[0.9, 0.5, 0.7], [0.3, 0.2, 0.4]]).double(),
        torch.tensor([0.6, 0.5]).double(),
        torch.rand(2, 3, generator=torch.Generator().manual_seed(4)).double(),
    ]
    leaves = [leaf.requires_grad_() for leaf in leaves]

    def picture(*parts):
        drawn = show(reference, parts, view, K, width, width)
        return drawn.image, drawn.alpha, drawn.depth

    assert all((p.abs().sum() > 0) for p in torch.autograd.grad(picture(*leaves)[0].sum(), leaves))
    # a step of 1e-7 moves few pixels across the cut at 1/255; the tolerance is far below what one would cause
    torch.autograd.gradcheck(
        picture, leaves, eps=1e-7, atol=1e-5, rtol=1e-4, check_undefined_grad=False, fast_mode=True
    )


@pytest.mark.parametrize("share", [0.99, 1.01, 3.0])
def test_a09_the_kernel_has_that_gradient_too(share, held):
    focal, width = 20.0, 12
    K = torch.tensor([[focal, 0, 6], [0, focal, 6], [0, 0, 1]])
    parts = ball(2, sigma=0.7)
    limit = (0.5 + FRUSTUM_MARGIN) * width / focal
    parts[0] = torch.tensor([[share * limit * 2, 0.1, 2], [-0.2, -share * limit * 2.5, 2.5]])
    (_, grads), (true, true_grads) = (draw(m, parts, STRAIGHT, K, width, width, d) for m, d in MAKERS)
    assert (true.radii > 0).all() and (true_grads[0].abs() > 1e-3).any(1).all()
    held(worst(apart(a, b) for a, b in zip(grads[:1] + grads[2:6], true_grads[:1] + true_grads[2:6])), 1e-6)


@pytest.mark.parametrize("cx, cy, left, top", [(20.0, 60.0, 30, 23), (0.02 * 96, 0.9 * 80, 3, 30)])
@pytest.mark.parametrize("maker, dtype, bound", [(cpu, torch.float32, 3e-5), (reference, torch.float64, 1e-13)])
def test_a11_a_crop_is_a_window_of_the_whole(maker, dtype, bound, cx, cy, left, top, held):
    """Off-centre principal points; the clamp of the Jacobian must follow them.

    The clamp's margin is a share of the picture, so this holds for Gaussians that reach less far than a crop's margin.
    """
    parts = list(gaussians(400))
    parts[2] = 0.01 + 0.15 * parts[2]
    width, height = 96, 80
    view, K = camera(width, height, cx=cx, cy=cy)
    cut = K - torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0.0]])
    leaves = [p.to(dtype).requires_grad_() for p in parts]
    whole = show(maker, leaves, view, K, width, height)
    small = show(maker, leaves, view, cut, 48, 40)
    window = (slice(top, top + 40), slice(left, left + 48))
    assert small.alpha.max() > 0.5
    weight = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(2)).to(dtype)
    for name in PICTURE:
        apart_by = (getattr(whole, name)[window] - getattr(small, name)).detach().abs()
        assert (apart_by > bound).float().mean() < 1e-3, name  # float32 may fall on either side of the cut
        assert apart_by.max() < (bound if dtype == torch.float64 else 6 * ALPHA_MIN), name
        held(apart_by.quantile(0.999), bound)
    weight[(whole.image[window] - small.image).detach().abs().amax(-1) > bound] = 0
    a = torch.autograd.grad((whole.image[window] * weight).sum(), leaves)
    b = torch.autograd.grad((small.image * weight).sum(), leaves)
    held(worst(apart(x, y) for x, y in zip(a, b)), bound)


def test_a12_from_a_lens_of_176_degrees_to_an_orthographic_one(held):
    parts = gaussians(200)
    wide = torch.tensor([[2.0, 0, 32], [0, 2, 24], [0, 0, 1]])
    fast, true = (draw(m, parts, STRAIGHT, wide, 64, 48, d) for m, d in MAKERS)
    assert all(g.isfinite().all() for g in fast[1]) and (true[0].radii > 0).any()
    held(largest(fast[0].image, true[0].image), 8e-6)
    pictures = []
    for focal in (6e3, 6e4, 6e5, 6e6):
        K = torch.tensor([[focal, 0, 32], [0, focal, 24], [0, 0, 1]])
        far = [parts[0] + torch.tensor([0, 0, focal / 20]), *parts[1:]]
        fast, true = (show(m, cast(far, d), STRAIGHT, K, 64, 48).image for m, d in MAKERS)
        assert ((fast - true).abs() > 1e-4).float().mean() < 2e-3
        pictures.append(true)
    errors = [(p - pictures[-1]).abs().mean().item() for p in pictures[:-1]]
    assert errors[0] > 1e-5 and errors[1] < 0.2 * errors[0], "the error falls as 1 / focal"


@both
@pytest.mark.parametrize("gauge", [1e-3, 1e3])
def test_a13_the_unit_of_length_does_not_matter(gauge, maker, dtype, held):
    means, quats, scales, opacities, colors = gaussians()
    view, K = camera()
    other = view.clone()
    other[:3, 3] *= gauge
    one = show(maker, cast((means, quats, scales, opacities, colors), dtype), view, K, 61, 45)
    parts = cast((gauge * means, quats, gauge * scales, opacities, colors), dtype)
    two = show(maker, parts, other, K, 61, 45, near=0.01 * gauge)
    assert one.alpha.mean() > 0.3 and torch.equal(one.radii > 0, two.radii > 0)
    held(largest(one.image, two.image), 1e-5)


@both
@pytest.mark.parametrize("sigma", [0.25, 0.4, 0.8])
def test_a15_antialiasing_keeps_the_light_of_what_is_smaller_than_a_pixel(sigma, maker, dtype, held):
    K = torch.tensor([[60.0, 0, 24.3], [0, 60, 20.8], [0, 0, 1]])
    parts = ball(sigma=sigma / 20, opacity=1.0)
    alpha, plain = (
        show(maker, cast(parts, dtype), STRAIGHT, K, 48, 40, antialias=on).alpha.sum().item() for on in (True, False)
    )
    light = 2 * math.pi * sigma**2
    assert plain > 1.3 * light, "without it, the blur adds light"
    held(abs(alpha / light - 1), 0.05)


def test_a15_antialiasing_makes_a_small_picture_the_mean_of_the_large_one(held):
    parts = list(gaussians(400))
    parts[2] = 0.02 + 0.2 * parts[2]
    view, K = camera(128, 96, 120.0)
    large = show(cpu, parts, view, K, 128, 96, antialias=True).image
    mean = torch.nn.functional.avg_pool2d(large.permute(2, 0, 1), 4).permute(1, 2, 0)
    K = torch.diag(torch.tensor([0.25, 0.25, 1])) @ K
    errors = [(show(cpu, parts, view, K, 32, 24, antialias=on).image - mean).square().mean() for on in (True, False)]
    assert errors[1] > 5 * errors[0]
    held(errors[0], 10 ** (-40 / 10), "under 40 dB:")


@pytest.mark.parametrize("maker, dtype", [*MAKERS, (reference, torch.float32)])
def test_a16_compensation_of_tiny_gaussians_has_finite_gradients(maker, dtype):
    """Its determinant is a fourth power: 1e-24 px^4 here, and denormal numbers are flushed to 0."""
    parts = ball(20, sigma=1e-4, opacity=0.99)
    parts[2] = parts[2] * torch.linspace(1, 3000, 20)[:, None] * torch.tensor([1.0, 0.7, 1.3])
    parts[1] = torch.randn(20, 4, generator=torch.Generator().manual_seed(0))
    K = torch.tensor([[0.03, 0, 1.55], [0, 0.03, 1.6], [0, 0, 1]])
    torch.set_flush_denormal(True)
    try:
        drawn, grads = draw(maker, parts, STRAIGHT, K, 4, 4, dtype, antialias=True)
    finally:
        torch.set_flush_denormal(False)
    assert (drawn.radii > 0).all() and drawn.dropped == 0
    assert all(g.isfinite().all() for g in grads) and grads[0].abs().max() > 0


def test_a17_thousands_of_gaussians_as_large_as_the_picture_fit_into_memory(held):
    parts = gaussians(2000, kind="huge")
    tracemalloc.start()
    drawn, grads = draw(cpu, parts, *camera(640, 360, 600.0), 640, 360)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (drawn.radii > 300).float().mean() > 0.9, "the test must draw large ones"
    assert all(g.isfinite().all() for g in grads) and drawn.image.isfinite().all()
    held(peak / 2**20, 100, "MiB:")


@pytest.mark.parametrize("length", [1e-25, 1e-20, 1e-3, 1e3, 1e19, 1e30, -1.0])
def test_a18_d08_length_and_sign_of_a_quaternion_do_not_matter(length, held):
    means, quats, scales, opacities, colors = gaussians(100)
    one = gaussian_axes(quats, scales)
    two = gaussian_axes(quats * length, scales)
    held(largest(one, two), 5e-7)
    drawn, grads = draw(cpu, (means, quats * length, scales, opacities, colors), *camera())
    assert drawn.dropped == 0 and (grads[1].abs().amax(1) > 0).float().mean() > 0.5
    along = (grads[1].double() * quats).sum(1).abs() / (quats.norm(dim=1) * grads[1].double().norm(dim=1) + 1e-300)
    held(along.max(), 1e-6, "the gradient along the quaternion")


@both
def test_a19_a_zero_quaternion_is_dropped(maker, dtype):
    parts = ball(3)
    parts[1][1] = 0
    drawn, clean = (show(maker, cast(p, dtype), *camera(), 61, 45) for p in (parts, [p[[0, 2]] for p in parts]))
    assert drawn.dropped == 1 and drawn.radii[1] == 0 and drawn.alpha.max() > 0.5
    assert torch.equal(drawn.image, clean.image)


@both
def test_a21_the_first_pixel_centre_is_at_a_half(maker, dtype, held):
    K = torch.tensor([[60.0, 0, 10.5], [0, 60, 7.5], [0, 0, 1]])
    alpha = show(maker, cast(ball(sigma=0.1), dtype), STRAIGHT, K, 24, 16).alpha
    assert alpha.argmax() == 7 * 24 + 10
    held(max(abs(alpha[7, 9] - alpha[7, 11]), abs(alpha[6, 10] - alpha[8, 10])), 1e-6)


@both
def test_a22_a_round_footprint_has_a_radius_and_a_gradient(maker, dtype, held):
    """The longer axis of a circle has no direction: a root of a difference that is 0 there."""
    parts = ball(sigma=0.2, opacity=0.5)
    K = torch.tensor([[60.0, 0, 30.5], [0, 60, 22.5], [0, 0, 1]])
    drawn, grads = draw(maker, parts, STRAIGHT, K, dtype=dtype)
    assert drawn.radii[0] == math.ceil(math.sqrt(2 * math.log(0.5 / ALPHA_MIN) * (16 + BLUR)))
    assert all(g.isfinite().all() for g in grads) and grads[2].abs().max() > 0.1
    true_grads = draw(reference, [p + 1e-9 for p in cast(parts)], STRAIGHT, K, dtype=torch.float64)[1]
    held(worst(apart(a, b) for a, b in zip(grads[:1] + grads[2:5], true_grads[:1] + true_grads[2:5])), 1.5e-6)


@both
@pytest.mark.parametrize("what", range(5), ids=NAMES[:5])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a23_c09_a_bad_row_is_counted_and_harms_no_other(what, value, maker, dtype, held):
    parts = [p.clone() for p in gaussians(60)]
    parts[what].view(60, -1)[17, 0] = value
    keep = torch.arange(60) != 17
    view, K = camera()
    drawn, grads = draw(maker, parts, view, K, dtype=dtype)
    clean, clean_grads = draw(maker, [p[keep] for p in parts], view, K, dtype=dtype)
    assert (drawn.dropped, clean.dropped) == (1, 0) and drawn.radii[17] == 0
    assert all(torch.equal(getattr(drawn, name), getattr(clean, name)) for name in PICTURE)
    for name, a, b in zip(NAMES, grads, clean_grads, strict=True):
        if name in ("viewmat", "background"):
            held(apart(a, b), 1e-6)  # sums over other ranges of rows
            continue
        assert torch.equal(a[keep], b), name
        # axes of a bad quaternion are themselves not finite, and so is what flows back through them
        assert name in ("quats", "scales") or a[17].abs().max() == 0, name


def by_the_book(mean, covariance, opacity, K, width, height):
    """Coverage [H,W] of one Gaussian before a camera at the origin, by explicit covariances in numpy (EWA splatting)."""
    x, y, z = mean
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    J = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    inverse = np.linalg.inv(J @ covariance @ J.T + BLUR * np.eye(2))
    ys, xs = np.mgrid[:height, :width] + 0.5
    d = np.stack([xs - fx * x / z - cx, ys - fy * y / z - cy], -1)
    alpha = opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, inverse, d))
    return torch.from_numpy(np.where(alpha < ALPHA_MIN, 0, alpha))


def elbow(degrees):
    """Half of a bone that stands still and half of one that has turned: no rotation."""
    t = math.radians(degrees)
    return (np.eye(3) + np.array([[math.cos(t), -math.sin(t), 0], [math.sin(t), math.cos(t), 0], [0, 0, 1]])) / 2


@both
@pytest.mark.parametrize(
    "blend",
    [np.eye(3), elbow(90), elbow(180), -np.eye(3) / 3, np.diag([1.0, 1, -0.2]), np.diag([1.0, 0, 0])],
    ids=["none", "elbow", "twist", "three half turns", "mirror", "flattened"],
)
def test_a24_e11_e12_e13_any_linear_blend_is_drawn_as_its_covariance(blend, maker, dtype, held):
    """B Sigma B^T, be B singular or mirrored; only axes can be handed over, so no covariance has a negative eigenvalue."""
    quat = torch.tensor([[0.9, 0.2, -0.3, 0.4]]).double()
    axes = torch.from_numpy(blend) @ reference.gaussian_axes(quat, torch.tensor([[0.3, 0.25, 0.03]]).double())
    mean, K = torch.tensor([[0.2, -0.1, 3.0]]), torch.tensor([[60.0, 0, 30], [0, 60, 22], [0, 0, 1]])
    truth = by_the_book(*(t.double().numpy() for t in (mean[0], axes[0] @ axes[0].T)), 0.75, K.numpy(), 61, 45)
    grads = []
    for m, d in ((maker, dtype), (reference, torch.float64)):
        leaves = [t.to(d).requires_grad_() for t in (mean, axes, torch.tensor([0.75]))]
        (drawn,) = m.rasterize(Gaussians(*leaves, torch.ones(1, 3).to(d)), Camera(STRAIGHT.to(d), K.to(d), 61, 45))
        grads.append(torch.autograd.grad((drawn.alpha * truth.to(d)).sum(), leaves))
        assert drawn.alpha.max() <= 0.75 and (drawn.alpha > 0.3).any()
        same = (drawn.alpha > 0) == (truth > 0)
        assert (~same).sum() <= 2, "at the cut rounding decides"
        held(largest(drawn.alpha[same], truth[same]), 1e-6 if d == torch.float32 else 1e-12)
    assert all(g.isfinite().all() and g.abs().max() > 0 for g in grads[0])
    held(worst(apart(a, b) for a, b in zip(*grads)), 2e-5)
