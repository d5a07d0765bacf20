import pytest
import torch

from stages.avatar import losses


def picture(seed: int = 0) -> torch.Tensor:
    return torch.rand(40, 32, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("fill", [0.0, 1.0, 0.5])
def test_g06_person_only_is_finite_for_every_mask(fill):
    image, mask = picture(), torch.full((40, 32), fill)
    rendered, alpha = picture(1).requires_grad_(), torch.rand(40, 32, requires_grad=True)
    losses.person_only(rendered, alpha, image, mask, torch.rand(3)).backward()
    assert rendered.grad.isfinite().all() and alpha.grad.isfinite().all()


def test_g16_a_perfect_render_costs_nothing_for_any_background():
    image, mask = picture(), (picture(2)[..., 0] > 0.5).float()
    for _ in range(3):
        background = torch.rand(3)
        rendered = losses.over_background(image, mask, background)
        assert losses.person_only(rendered, mask, image, mask, background).item() < 1e-5


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
        window = losses.patch(mask, 128, generator)
        assert mask[window].shape == tuple(min(128, n) for n in shape)
        assert where != "corner" or mask[window].sum() == 1


@pytest.mark.parametrize("shape", [(40, 32), (1, 1), (2, 9)])
def test_a_mask_grows_by_a_square(shape):
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(3))
    for width in (0.0, 0.02, 0.1):
        by = max(1, round(width * max(shape)))
        want = torch.nn.functional.max_pool2d(mask[None, None], 2 * by + 1, 1, by)[0, 0]
        assert torch.equal(losses.widened(mask, width), want)


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
