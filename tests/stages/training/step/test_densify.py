"""Growth and pruning of the scene's Gaussians, whatever the unit of length."""

import pytest
import torch

from stages.avatar.model.scene import SceneModel
from stages.training.step.densify import Growth, Plan, Rules, _regrow, displacement, grow_scene, plan, thinner

RULES = Rules(grad=1.0, dense_size=0.1, max_size=1.0, max_radius=0.3, min_opacity=0.01, cap=100)


def growth(gradients: list[float], radii: list[float] | None = None) -> Growth:
    g = Growth(len(gradients))
    g.grad, g.count = torch.tensor(gradients), torch.ones(len(gradients))
    if radii:
        g.radius = torch.tensor(radii)
    return g


def test_small_is_cloned_large_is_split_faint_and_huge_are_pruned():
    sizes = torch.tensor([0.05, 0.5, 0.05, 0.05, 2.0])
    opacities = torch.tensor([0.5, 0.5, 0.5, 0.001, 0.5])
    p = plan(growth([2, 2, 0, 2, 2]), sizes, opacities, RULES, room=100)
    assert (p.cloned, p.split, p.pruned) == (1, 1, 2)
    assert p.source.tolist() == [0, 2, 0, 1, 1]
    assert p.fresh.tolist() == [False, False, True, True, True]
    assert p.child.tolist() == [False, False, False, True, True]


def test_h06_the_cap_holds_exactly_and_the_largest_gradients_win():
    gradients = [float(i) for i in range(1, 41)]
    p = plan(growth(gradients), torch.full((40,), 0.05), torch.full((40,), 0.5), RULES._replace(cap=47), room=100)
    assert len(p.source) == 47
    assert p.source[40:].tolist() == list(range(33, 40))
    assert len(plan(growth(gradients), torch.ones(40) * 0.5, torch.ones(40), RULES, room=5).source) == 45


def test_h16_a_gaussian_that_covers_the_screen_is_split_whatever_its_gradient():
    p = plan(growth([0, 0], [0.9, 0.01]), torch.full((2,), 0.05), torch.ones(2), RULES, room=9)
    assert p.split == 1 and p.source.tolist() == [1, 0, 0]


def test_h05_nothing_left_is_an_error_with_the_reasons():
    with pytest.raises(ValueError, match=r"all 3 Gaussians.*2 with opacity.*1 larger"):
        plan(growth([0, 0, 0]), torch.tensor([0.1, 0.1, 5]), torch.tensor([0, 0, 0.5]), RULES, room=9)


def test_h05_h14_rows_that_are_not_finite_are_pruned_and_never_chosen():
    sizes = torch.tensor([0.05, float("nan"), 0.05])
    p = plan(growth([2, 9, 0]), sizes, torch.tensor([0.5, 0.5, float("inf")]), RULES, room=9)
    assert p.pruned == 2 and p.source.tolist() == [0, 0]


def test_h14_statistics_do_not_depend_on_resolution_or_unseen_views():
    full, half = Growth(2), Growth(2)
    full.add(torch.tensor([[2.0, 0], [0, 0]]), torch.tensor([20.0, 0]), 200, 100)
    half.add(torch.tensor([[4.0, 0], [0, 0]]), torch.tensor([10.0, 0]), 100, 50)
    assert torch.equal(full.mean(), half.mean()) and torch.equal(full.radius, half.radius)
    full.add(torch.tensor([[float("nan"), 0], [7.0, 0]]), torch.tensor([3.0, 0]), 200, 100)
    assert full.mean().tolist() == [200.0, 0.0]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a13_i05_decisions_do_not_depend_on_the_unit_of_length(scale):
    g = torch.Generator().manual_seed(0)
    sizes, opacities = torch.rand(50, generator=g) * scale, torch.rand(50, generator=g)
    rules = RULES._replace(dense_size=0.4 * scale, max_size=0.9 * scale)
    p = plan(growth(torch.rand(50, generator=g).mul(2).tolist()), sizes, opacities, rules, room=30)
    g = torch.Generator().manual_seed(0)
    sizes, opacities = torch.rand(50, generator=g), torch.rand(50, generator=g)
    gradients = torch.rand(50, generator=g).mul(2).tolist()
    unit = plan(growth(gradients), sizes, opacities, RULES._replace(dense_size=0.4, max_size=0.9), room=30)
    assert torch.equal(p.source, unit.source) and torch.equal(p.child, unit.child)


def test_h03_h10_adam_moments_follow_their_rows():
    parameter = torch.nn.Parameter(torch.arange(10.0)[:, None].repeat(1, 2))
    adam = torch.optim.Adam([parameter], fused=True)
    parameter.grad = torch.ones_like(parameter)
    adam.step()
    adam.state[parameter]["exp_avg"] = torch.arange(10.0)[:, None].repeat(1, 2)
    opacities, sizes = torch.ones(10), torch.full((10,), 0.05)
    opacities[0], sizes[5] = 0, 0.5
    gradients = [0.0] * 10
    gradients[2] = gradients[5] = 9
    rows = plan(growth(gradients), sizes, opacities, RULES, room=9)
    grown = _regrow(adam, parameter, rows)
    assert rows.source.tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 2, 5, 5]
    assert adam.state[grown]["exp_avg"][:, 0].tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 0, 0, 0]
    assert len(adam.state) == 1 and adam.param_groups[0]["params"] == [grown]
    assert (adam.state[grown]["exp_avg_sq"] >= 0).all() and (adam.state[grown]["exp_avg_sq"][:8] > 0).all()
    grown.grad = torch.ones_like(grown)
    adam.step()
    assert grown.isfinite().all()


def test_h10_a_scene_grows_with_all_its_rows():
    g = torch.Generator().manual_seed(0)
    scene = SceneModel(torch.rand(30, 3, generator=g), torch.rand(30, 3, generator=g), 1, 1.0)
    adam = torch.optim.Adam([{"params": [getattr(scene, n)]} for n in scene.ROWS], fused=True)
    stats = growth([5.0] * 10 + [0.0] * 20)
    grow_scene(scene, adam, stats, RULES._replace(cap=40, dense_size=1e-6), 1, g)
    assert len(scene) == 40 and len(stats.grad) == 40
    assert {len(getattr(scene, n)) for n in scene.ROWS} == {40}
    held = {id(p) for group in adam.param_groups for p in group["params"]}
    assert held == {id(p) for p in scene.parameters()}


def test_h06_growth_without_limits_stays_within_its_cap():
    g = torch.Generator().manual_seed(0)
    scene = SceneModel(torch.rand(30, 3, generator=g), torch.rand(30, 3, generator=g), 1, 1.0)
    adam = torch.optim.Adam([{"params": [getattr(scene, n)]} for n in scene.ROWS], fused=True)
    rules, sizes = RULES._replace(grad=0.0, cap=100, dense_size=1e-6, max_size=1e9), []
    for left in (5, 4, 3, 2, 1):
        grow_scene(scene, adam, Growth(len(scene)), rules, left, g)
        sizes.append(len(scene))
    assert sizes == sorted(sizes) and sizes[0] > 30 and sizes[-1] == 100


def test_two_that_come_of_one_are_together_as_opaque():
    opacities = torch.tensor([0.5, 0.99, 0.3, 0.01, 0.7])
    rows = plan(growth([9.0, 9, 0, 9, 0]), torch.tensor([0.05, 0.5, 0.05, 0.05, 0.05]), opacities, RULES, room=9)
    assert rows.cloned == 2 and rows.split == 1
    now = (opacities[rows.source].logit() + thinner(opacities, rows)).sigmoid()
    for i, old in enumerate(opacities):
        through = (1 - now[rows.source == i]).prod()
        assert through.item() == pytest.approx(1 - old.item(), abs=1e-5)
    ends = torch.tensor([0.0, 1.0])
    assert thinner(ends, rows._replace(source=torch.tensor([0, 1, 0, 1]))).isfinite().all()


@pytest.mark.parametrize("log_scale", [-200.0, -90.0])
def test_h08_h09_gaussians_without_size_or_transparency_are_copied_and_stay_finite(log_scale):
    g = torch.Generator().manual_seed(0)
    scene = SceneModel(torch.rand(6, 3, generator=g), torch.rand(6, 3, generator=g), 1, 1.0)
    scene.log_scales.data[0] = log_scale  # exp gives 0, or the least there is
    scene.logit_opacities.data[:2] = 20  # the sigmoid is exactly 1
    scene.log_scales.data[1] = -1.0
    adam = torch.optim.Adam([{"params": [getattr(scene, n)]} for n in scene.ROWS], fused=True)
    rows = grow_scene(scene, adam, growth([5.0, 5, 0, 0, 0, 0]), RULES, 1, g)
    assert (rows.cloned, rows.split) == (1, 1), "only what has a size is split"
    assert all(getattr(scene, name).isfinite().all() for name in scene.ROWS)
    twins = scene.means[rows.source == 0]
    assert len(twins) == 2 and torch.equal(twins[0], twins[1])
    assert (scene.logit_opacities[rows.source <= 1] == 20).all(), "no correction that could overflow"


def test_lost_rows_are_pruned_whatever_else_they_are():
    lost = torch.tensor([False, True, False])
    p = plan(growth([0, 9, 0]), torch.full((3,), 0.05), torch.ones(3), RULES, 9, lost)
    assert p.pruned == 1 and p.source.tolist() == [0, 2]


def test_new_gaussians_are_drawn_from_the_ellipsoid_of_their_parent():
    """Axes are columns: the covariance of the offsets is axes axes^T, and axes^T axes is another one."""
    axes = torch.tensor([[[0.0, -0.1, 0], [2.0, 0, 0], [0, 0, 0.3]], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    source = torch.tensor([0, 1] + 4000 * [0])
    fresh = torch.arange(len(source)) > 1
    moved = displacement(axes, Plan(source, fresh, fresh, 0, 2000, 0), torch.Generator().manual_seed(0))
    assert moved[:2].abs().max() == 0, "those that stay do not move"
    torch.testing.assert_close(moved[2:].T.cov(), axes[0] @ axes[0].T, atol=0.01, rtol=0.1)
