"""The person's shadow: where it falls, what it does to colours, and that it is learned."""

import pytest
import torch

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shadow import Casters, Shadow, casters
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import sh_from_rgb

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def body(lift: float = 0.0, width: float = 0.08) -> Casters:
    """Five parts of a person who stands at the origin, `lift` m over the floor y = 0."""
    heights = torch.tensor([0.05, 0.45, 0.9, 1.3, 1.6], dtype=torch.float64)
    middles = torch.stack([0 * heights, heights + lift, 0 * heights], 1)
    covariances = torch.diag(torch.tensor([width, 0.15, width]).double() ** 2).expand(5, 3, 3)
    nothing = torch.zeros(19, 3, 3, dtype=torch.float64)  # bones that have no part
    return Casters(torch.cat([middles, nothing[..., 0]]), torch.cat([covariances, nothing]))


def floor(side: int = 25, reach: float = 1.8) -> torch.Tensor:
    x, z = torch.meshgrid(*[torch.linspace(-reach, reach, side, dtype=torch.float64)] * 2, indexing="ij")
    return torch.stack([x.flatten(), 0 * x.flatten(), z.flatten()], 1)


def leaning(slope) -> Shadow:
    shadow = Shadow(UP, darkness=0.6, softness=0.05, density=3.0, size=1.0)
    shadow.slope.data = torch.tensor(slope, dtype=torch.float64)
    return shadow


def test_parts_are_the_bones_shares_of_the_person(held):
    g = torch.Generator().manual_seed(0)
    spread = torch.randn(3, 3, generator=g, dtype=torch.float64) * 0.1
    means = torch.randn(20000, 3, generator=g, dtype=torch.float64) @ spread.T + torch.tensor([5.0, -2, 1])
    weights = torch.zeros(20000, 24, dtype=torch.float64)
    weights[:10000, 3], weights[10000:, 7] = 1, 1  # 22 bones have nothing
    found = casters(means, weights)
    assert found.middles.shape == (24, 3) and not found.covariances[[0, 23]].any()
    held((found.middles[3] - means[:10000].mean(0)).abs().max(), 1e-10)
    held((found.covariances[7] - means[10000:].T.cov(correction=0)).abs().max(), 1e-10)


def test_it_falls_away_from_the_light_and_with_the_person_in_the_air_farther(held):
    points = floor(61, 3.0)
    for slope in ([0.0, 0.0], [0.5, -0.3]):
        shadow = leaning(slope)
        light = shadow.light()
        for lift in (0.0, 1.0):
            lost = 1 - shadow.light_left(points, [body(lift)])
            middle = (lost[:, None] * points).sum(0) / lost.sum()
            heights = body(lift).middles[:5, 1].mean()
            held((middle[[0, 2]] + heights * light[[0, 2]] / light[1]).norm().item(), 0.05)
            assert 0.4 < lost.max() < 0.6 and lost.min() < 1e-6


def test_nothing_above_the_person_is_shaded():
    above = floor() + torch.tensor([0, 2.2, 0])
    assert (leaning([0.0, 0.0]).light_left(above, [body()]) > 0.999).all()


def test_colours_are_multiplied_whatever_their_degree_and_rows_out_of_reach_stay_to_the_bit():
    g = torch.Generator().manual_seed(1)
    points = floor(reach=4.0).float()
    sh = torch.rand(len(points), 4, 3, generator=g) * torch.tensor([1.0, 0.1, 0.1, 0.1])[:, None]
    scene = Splats(points, torch.zeros(len(points), 3, 3), torch.ones(len(points)), sh)
    shadow, parts = leaning([0.3, 0.2]).float(), Casters(*(t.float() for t in body()))
    lit, eye = shadow(scene, [parts]), torch.tensor([0.0, 2.0, 5.0])
    shares = shadow.light_left(points, [parts])
    torch.testing.assert_close(lit.colors(eye), scene.colors(eye) * shares[:, None], atol=2e-3, rtol=0)
    far = points.norm(dim=1) > 3
    assert torch.equal(lit.sh[far], scene.sh[far]) and not torch.equal(lit.sh, scene.sh)
    assert lit.means is scene.means and lit.axes is scene.axes


def test_what_is_left_is_how_colours_fade_and_how_deep_the_shadow_is():
    shadow, points = leaning([0.2, 0.1]), floor()
    left = shadow.light_left(points, [body()])
    white = Splats(
        points,
        torch.eye(3).expand(len(points), 3, 3),
        torch.ones(len(points)),
        sh_from_rgb(torch.ones(len(points), 1, 3).double()),
    )
    torch.testing.assert_close(shadow(white, [body()]).colors(torch.zeros(3))[:, 0], left)
    effects = FrameEffects()
    assert not effects.shadow_depth(points, [body()]).any()
    effects.shadow = shadow
    dark = effects.shadow_depth(points, [body()])
    assert dark.max() == pytest.approx(1.0, abs=0.05) and dark.min() == 0
    assert not effects.shadow_depth(points, []).any(), "nobody is there"


def test_behind_two_it_is_darker_than_behind_one_and_each_casts_its_own_parts():
    shadow, points = leaning([0.2, 0.1]), floor()
    one, away = body(), torch.tensor([0.15, 0.0, 0.1]).double()
    other, far = (Casters(one.middles + way, 0.3 * one.covariances) for way in (away, away + 50))
    depths = [
        -torch.log(1 - (1 - shadow.light_left(points, [each])) / shadow.darkness.sigmoid()) for each in (one, other)
    ]
    deep, both = sum(depths), shadow.light_left(points, [one, other])
    expected = 1 - shadow.darkness.sigmoid() * (1 - (-deep).exp())
    torch.testing.assert_close(both, expected, atol=0.02, rtol=0)  # beyond REACH a part casts nothing
    assert (both <= shadow.light_left(points, [one]) + 1e-9).all() and both.min() < expected.max() - 0.3
    torch.testing.assert_close(shadow.light_left(points, [one, far]), shadow.light_left(points, [one]))
    both.sum().backward()
    assert shadow.slope.grad.abs().max() > 0
    effects = FrameEffects()
    effects.shadow = shadow
    assert (effects.shadow_depth(points, [one, other]) >= effects.shadow_depth(points, [one]) - 1e-9).all()


@pytest.mark.parametrize("width", [0.08, 0.0])
def test_light_straight_down_and_bodies_without_width_have_finite_slopes(width):
    shadow, points = leaning([0.0, 0.0]), torch.cat([floor(), body().middles])
    shadow.light_left(points, [body(width=width)]).square().sum().backward()
    for parameter in shadow.parameters():
        assert parameter.grad.isfinite().all()
    points = floor() + torch.tensor([0.3, 0, 0])  # where straight down is no minimum
    (slopes,) = torch.autograd.grad(shadow.light_left(points, [body(width=width)]).square().mean(), shadow.slope)
    assert slopes.isfinite().all()


def test_slopes_are_those_of_finite_differences():
    points, shadow = floor(9), leaning([0.2, 0.1])

    def loss(slope, darkness, softness, density, size):
        parts = {"slope": slope, "darkness": darkness, "softness": softness, "density": density, "size": size}
        called = torch.func.functional_call(_Shares(shadow), {f"shadow.{n}": v for n, v in parts.items()}, (points,))
        return called.square().sum()

    assert torch.autograd.gradcheck(loss, [p.detach().clone().requires_grad_() for p in shadow.parameters()])


class _Shares(torch.nn.Module):
    def __init__(self, shadow: Shadow):
        super().__init__()
        self.shadow = shadow

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.shadow.light_left(points, [body()])


def test_the_direction_of_the_light_is_learned_from_straight_down(held):
    points, truth = floor(), leaning([0.4, -0.25])
    wanted = truth.light_left(points, [body()]).detach()
    shadow = Shadow(UP)
    adam = torch.optim.Adam(shadow.parameters(), lr=0.03)
    for _ in range(120):
        adam.zero_grad()
        (shadow.light_left(points, [body()]) - wanted).square().mean().backward()
        adam.step()
    held((shadow.light() - truth.light()).norm().item(), 0.02)
    held((shadow.light_left(points, [body()]) - wanted).abs().max().item(), 0.1)


def test_what_is_said_of_it_makes_it_again(held):
    shadow = leaning([0.4, -0.25])
    said = shadow.known()
    again = Shadow(torch.as_tensor(said.pop("light")), **said)
    held((again.light_left(floor(), [body()]) - shadow.light_left(floor(), [body()])).abs().max().item(), 1e-6)


def test_without_gradients_it_is_the_same_shadow(held):
    """The kernel against plain torch, of two bodies that share some of it, and where nothing falls."""
    shadow, points = leaning([0.3, 0.2]).float(), floor(61, 3.0).float()
    bodies = [Casters(*(t.float() for t in body())), Casters(*(t.float() for t in body(0.3, 0.2)))]
    assert shadow.light_left(points, bodies).requires_grad
    with torch.no_grad():
        quick, exact = (
            shadow.light_left(points, bodies),
            leaning([0.3, 0.2]).light_left(points.double(), bodies_of(bodies)),
        )
    held((quick - exact).abs().max().item(), 2e-6)
    assert quick.min() < 0.5 and (quick == 1).any()


def bodies_of(bodies: list[Casters]) -> list[Casters]:
    """The same in double precision, for which there is no kernel."""
    return [Casters(*(part.double() for part in one)) for one in bodies]
