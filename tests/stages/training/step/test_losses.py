"""Losses: what they pull, what they leave alone, and their size at every resolution."""

import pytest
import torch

from stages.training.step import losses
from stages.training.views import person_box


def picture(seed: int = 0) -> torch.Tensor:
    return torch.rand(40, 32, 3, generator=torch.Generator().manual_seed(seed))


def step_towards(loss, rendered: torch.Tensor, rate: float) -> tuple[float, float]:
    """The loss before and after one step against its gradient, as long as `rate` of the largest change allowed."""
    rendered = rendered.clone().requires_grad_()
    before = loss(rendered)
    before.backward()
    assert rendered.grad.isfinite().all()
    return before.item(), loss(rendered.detach() - rate * rendered.grad.sign()).item()


def test_g02_a_black_render_is_moved_and_a_black_target_met():
    black, wall = torch.zeros(40, 32, 3), picture()
    before, after = step_towards(lambda x: losses.photometric(x, wall), black, 0.05)
    assert after < before - 0.03
    still = black.clone().requires_grad_()
    loss = losses.photometric(still, black)
    loss.backward()
    assert loss.item() < 1e-6 and still.grad.abs().max() < 1e-6


def test_b15_g12_pixels_too_bright_or_negative_are_pulled_back():
    target = torch.full((20, 20, 3), 1.0)
    target[:, :10] = 0
    rendered = target.clone()
    rendered[5, 15], rendered[5, 4] = 1.3, -0.2
    rendered.requires_grad_()
    losses.photometric(rendered, target).backward()
    assert (rendered.grad[5, 15] > 0).all() and (rendered.grad[5, 4] < 0).all()


def smooth(size: int) -> tuple[torch.Tensor, ...]:
    """A smooth scene at `size` x `size` px: rendered, image, mask."""
    y, x = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    image = torch.stack([x, y, 0.5 + 0.4 * torch.sin(6 * x + 3 * y)], -1)
    return image + 0.1 * torch.cos(5 * x)[..., None], image, ((x - 0.5).square() + (y - 0.5).square() < 0.1).float()


def test_g18_losses_do_not_depend_on_resolution(held):
    both = []
    for size in (48, 96):
        rendered, image, mask = smooth(size)
        both.append(
            [
                losses.photometric(rendered, image).item(),
                losses.photometric(losses.outside_person(rendered, image, mask), image).item(),
                losses.person_only(rendered, 0.9 * mask, image, mask, torch.zeros(3)).item(),
            ]
        )
    assert min(both[0]) > 0.01
    held(max(abs(a / b - 1) for a, b in zip(*both, strict=True)), 0.2)


def test_g07_what_lies_around_the_persons_window_does_not_count():
    rendered, image, mask = smooth(96)
    K, points = torch.tensor([[60.0, 0, 48], [0, 60, 48], [0, 0, 1]]), torch.tensor([[0.0, 0, 3]])
    wide = [torch.nn.functional.pad(t.reshape(96, 96, -1), (0, 0, 48, 48, 48, 48)) for t in (rendered, image, mask)]
    found = []
    for pictures, shift in (((rendered, image, mask[..., None]), 0), (wide, 48)):
        moved = K.clone()
        moved[:2, 2] += shift
        left, top, right, bottom = person_box(pictures[2][..., 0], points, torch.eye(4), moved)
        drawn, target, seen = (p[top:bottom, left:right] for p in pictures)
        assert left > shift and right < shift + 96, "precondition: the window is not cut by the picture's border"
        found.append(losses.person_only(drawn, seen[..., 0] * 0.9, target, seen[..., 0], torch.ones(3)).item())
    assert found[0] == found[1] > 0.01


@pytest.mark.parametrize("fill", [0.0, 1.0, 0.5])
def test_g06_person_only_is_finite_for_every_mask(fill):
    image, mask = picture(), torch.full((40, 32), fill)
    rendered, alpha = picture(1).requires_grad_(), torch.rand(40, 32, requires_grad=True)
    losses.person_only(rendered, alpha, image, mask, torch.rand(3)).backward()
    assert rendered.grad.isfinite().all() and alpha.grad.isfinite().all()


def test_g16_a_perfect_render_costs_nothing_for_any_background(held):
    image, mask = picture(), (picture(2)[..., 0] > 0.5).float()
    for background in torch.tensor([[0.1, 0.2, 0.9], [1, 1, 1], [0, 0.8, 0.3]]):  # none is nearly its own opposite
        rendered = losses.over_background(image, mask, background)
        held(losses.person_only(rendered, mask, image, mask, background).item(), 1e-6)
        other = losses.over_background(image, mask, 1 - background)
        assert losses.person_only(other, mask, image, mask, background).item() > 0.05, "another draw would show"


def test_a_pixel_that_person_and_scene_share_by_blur_teaches_coverage_and_no_colour():
    mask = torch.linspace(0, 1, 40)[:, None].repeat(1, 32)
    rendered, alpha = picture(1).requires_grad_(), torch.rand(40, 32, requires_grad=True)
    target = picture(), mask, torch.rand(3)
    losses.person_only(losses.unmixed(rendered, *target), alpha, *target).backward()
    taught = (rendered.grad.abs().sum(-1) > 0).float().mean(1)
    assert (taught[[0, -1]] > 0.99).all() and (taught[1:-1] == 0).all()
    assert (alpha.grad != 0).all()


def test_person_pixels_and_a_seam_around_them_teach_the_scene_nothing():
    image, mask = picture(), torch.zeros(40, 32)
    mask[10:30, 8:20] = 1
    rendered = picture(1).requires_grad_()
    losses.photometric(losses.outside_person(rendered, image, mask), image).backward()
    wide = torch.zeros_like(mask)
    wide[9:31, 7:21] = 1  # one pixel, the least
    assert (rendered.grad[wide > 0] == 0).all()
    assert (rendered.grad[wide == 0].abs().sum(-1) > 0).float().mean() > 0.99


def test_g17_g19_skinning_is_a_mean_and_its_reference_a_constant():
    a = torch.tensor([[1.0, 0.0], [0.25, 0.75]], requires_grad=True)
    b = torch.tensor([[0.5, 0.5], [0.25, 0.75]], requires_grad=True)
    loss = losses.skinning(a, b)
    assert loss.item() == pytest.approx(losses.LBS * 0.5 / 4)
    loss.backward()
    assert b.grad is None
    assert losses.skinning(a.repeat(3, 1), b.repeat(3, 1)).item() == pytest.approx(loss.item())


@pytest.mark.parametrize("shape", [(100, 80), (300, 40), (400, 300), (1, 1)])
@pytest.mark.parametrize("where", ["nowhere", "corner", "all"])
def test_g08_a_patch_is_always_a_window_of_the_picture(shape, where):
    mask = torch.zeros(shape)
    if where == "corner":
        mask[-1, -1] = 1
    if where == "all":
        mask[:] = 1
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        window = losses.random_patch(mask, 128, generator)
        assert mask[window].shape == tuple(min(128, n) for n in shape)
        assert where != "corner" or mask[window].sum() == 1


@pytest.mark.parametrize("shape", [(40, 32), (1, 1), (2, 9)])
def test_a_mask_grows_by_a_square(shape):
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(3))
    for width in (0.0, 0.02, 0.1):
        by = max(1, round(width * max(shape)))
        want = torch.nn.functional.max_pool2d(mask[None, None], 2 * by + 1, 1, by)[0, 0]
        assert torch.equal(losses.dilated(mask, width), want)


def test_a_gaussian_off_the_surface_is_rough_and_moves_along_the_normal_only():
    flat = torch.stack(torch.meshgrid(*[torch.arange(5.0) / 100] * 2, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3)
    near = torch.cdist(flat, flat).argsort(1)[:, 1:5]
    normals = torch.tensor([0.0, 0, 1]).expand(25, 3)
    assert losses.roughness(flat, near, normals) == 0
    assert losses.roughness(flat + torch.tensor([0, 0, 0.3]), near, normals) == 0, "cloth may lie off the body"
    dot = flat.clone()
    dot[12, 2] = losses.ROUGH
    dot.requires_grad_()
    rough = losses.roughness(dot, near, normals)
    assert 1 / 25 < rough.item() < 2 / 25
    rough.backward()
    assert (dot.grad[:, :2] == 0).all() and dot.grad[12, 2] > 0 and (dot.grad[near[12], 2] < 0).all()
