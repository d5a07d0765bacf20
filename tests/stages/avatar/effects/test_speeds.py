"""Motion at a frame, and what a shutter that takes its time makes of it."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from stages.avatar.effects.motion_blur import LENGTHS, MOMENTS, OPEN, BlurredRendering, expose, from_linear, to_linear
from stages.avatar.effects.rolling_shutter import roll_shutter
from stages.avatar.effects.speeds import SWIFT, Speeds, around, drift, move, px_a_moment
from stages.avatar.rasterize import Camera, Gaussians, rasterize
from stages.avatar.splats.gaussians import Splats

TWIST = np.zeros((4, 4))
TWIST[:3] = [[0, 0.03, -0.05, 0.04], [-0.03, 0, 0.02, -0.01], [0.05, -0.02, 0, 0.03]]
START = np.eye(4)
START[:3, 3] = [0.1, -0.2, 3.0]
SIZE = WIDTH, HEIGHT = 60, 80
K = torch.tensor([[90.0, 0, WIDTH / 2], [0, 90, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)


def screw(times) -> np.ndarray:
    """A camera that moves evenly."""
    return np.stack([expm(t * TWIST) @ START for t in times])


def cloud(count: int = 200) -> Splats:
    g = torch.Generator().manual_seed(0)
    means = (torch.rand(count, 3, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([2.0, 2.6, 1.0])
    axes = 0.04 * torch.randn(count, 3, 3, generator=g, dtype=torch.float64)
    sh = torch.randn(count, 1, 3, generator=g, dtype=torch.float64)
    return Splats(means, axes, torch.full((count,), 0.8, dtype=torch.float64), sh)


def seen(means: torch.Tensor, viewmat: np.ndarray) -> torch.Tensor:
    """Pixels [N,2] of points."""
    local = means @ torch.tensor(viewmat[:3, :3]).T + torch.tensor(viewmat[:3, 3])
    return (local / local[:, 2:] @ K.T)[:, :2]


def field_of(i: int = 2) -> torch.Tensor:
    views = screw(np.arange(5))
    return torch.tensor(drift(views, around(np.arange(5), i), i))


@pytest.mark.parametrize("i", [0, 2, 4])
def test_an_even_motion_is_met_at_all_frames_also_the_first_and_the_last(i, held):
    times = np.array([0, 1, 3, 4, 6])
    views = screw(times)
    field = torch.tensor(drift(views, around(times, i), i))
    points = cloud().means
    step = 1e-5
    ahead, behind = (expm((times[i] + s) * TWIST) @ START for s in (step, -step))
    there = move(cloud(), points @ field[:, :3].T + field[:, 3], field[:, :3], torch.tensor(step).double())
    held((seen(there.means, views[i]) - seen(points, ahead)).abs().max() / step, 1e-2)  # of some 5 px a moment
    assert (seen(points, ahead) - seen(points, behind)).abs().max() / step > 2


def test_where_there_is_no_neighbour_nothing_moves():
    for moments in (np.zeros(1, int), np.array([4, 4, 4])):  # one frame; three cameras at one moment
        assert around(moments, 0).gap == 0
        assert not drift(screw(np.arange(3)), around(moments, 0), 0).any()
    assert around(np.array([0, 0, 2, 2, 5]), 2) == (1, 4, 5)


def test_a_person_beside_a_frame_without_pose_stands_still():
    Ks = K.float().expand(3, 3, 3)
    speeds, places = (
        Speeds(screw(range(3)), Ks, HEIGHT, np.arange(3)),
        [torch.full((4, 3), float(i) ** 2) for i in range(3)],
    )
    assert torch.equal(speeds.own(1, places.__getitem__), torch.full((4, 3), 2.0))
    places[2] = None
    assert speeds.own(1, places.__getitem__) is None
    assert torch.equal(speeds.own(0, places.__getitem__), torch.ones(4, 3))


def read_rows(splats: Splats, readout: float) -> torch.Tensor:
    """Pixels [N,2] at which a camera that reads its rows one after the other sees each point, by fixed-point steps."""
    share = torch.full((len(splats.means),), 0.5, dtype=torch.float64)
    for _ in range(30):
        times = readout * (share - 0.5)
        pixels = torch.stack(
            [seen(m[None], expm((2 + t) * TWIST) @ START)[0] for m, t in zip(splats.means, times.tolist())]
        )
        share = pixels[:, 1] / HEIGHT
    return pixels


@pytest.mark.slow
def test_a_rolling_shutter_is_met_to_second_order(held):
    splats, field = cloud(40), field_of()
    view, speeds = screw([2.0])[0], splats.means @ field[:, :3].T + field[:, 3]
    still = torch.zeros((), dtype=torch.float64)
    errors = []
    for readout in (0.8, 0.2):
        told = torch.tensor([readout], dtype=torch.float64)
        there = roll_shutter(splats, speeds, field[:, :3], torch.tensor(view), K, HEIGHT, told, still)
        errors.append((seen(there.means, view) - read_rows(splats, readout)).abs().max())
    shift = (seen(splats.means, view) - read_rows(splats, 0.8)).abs().max()
    assert shift > 1  # px
    held(errors[0] / shift, 0.014)  # 0.02 without the share of `rush`
    assert errors[1] < errors[0] / 8  # second order: a 16th


def test_gaussians_shear_as_the_places_around_them_do(held):
    splats, field = cloud(30), field_of()
    view, readout = torch.tensor(screw([2.0])[0]), torch.tensor([0.6], dtype=torch.float64)
    time = torch.tensor(0.1, dtype=torch.float64)

    def there(means: torch.Tensor) -> Splats:
        speeds = means @ field[:, :3].T + field[:, 3]
        return roll_shutter(splats._replace(means=means), speeds, field[:, :3], view, K, HEIGHT, readout, time)

    slopes = torch.autograd.functional.jacobian(lambda means: there(means).means.sum(0), splats.means).movedim(0, 1)
    wanted = slopes @ splats.axes
    bend = (wanted - splats.axes).abs().max()
    held((there(splats.means).axes - wanted).abs().max() / bend, 0.1)  # the slope of `rush` is left out


@pytest.mark.parametrize("place", [[0, 0, -3.0], [0, 0, -6.0], [0, 0, -3.0 - 1e-9], [50, 50, 0]])
def test_singular_places_have_finite_values_and_slopes(place):
    means = torch.tensor([place, [0.1, 0.2, 0.0]], dtype=torch.float64, requires_grad=True)
    splats = cloud(2)._replace(means=means)
    readout = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    view = torch.tensor(screw([0.0])[0])
    view[:3, 3] = torch.tensor([0.0, 0, 3])  # the first place is the camera's own, the second behind it
    field = field_of()
    there = roll_shutter(
        splats, means @ field[:, :3].T + field[:, 3], field[:, :3], view, K, HEIGHT, readout, readout * 0
    )
    assert torch.equal(there.means, means) and torch.equal(there.axes, splats.axes)  # a readout of 0 moves nothing
    (there.means.square().sum() + there.axes.square().sum()).backward()
    assert means.grad.isfinite().all() and readout.grad.isfinite().all() and readout.grad.abs().sum() > 0


def draw(splats: Splats, view: np.ndarray, bend=lambda s, t: s):
    def at(time: torch.Tensor):
        s = bend(splats, time)
        colors = (s.sh[:, 0] * 0.3 + 0.5).clamp(0, 1)
        return rasterize(Gaussians(s.means, s.axes, s.opacities, colors), Camera(torch.tensor(view), K, *SIZE))

    return at


def blurred(shutter: torch.Tensor, speed: float) -> tuple[Splats, BlurredRendering]:
    """A cloud that passes, as an open shutter sees it, drawn as often as a picture of that `speed` px a moment needs."""
    splats, field = cloud(60), field_of()
    view, speeds = screw([2.0])[0], splats.means @ field[:, :3].T + field[:, 3]
    splats.means.requires_grad_()
    return splats, expose(draw(splats, view, lambda s, t: move(s, speeds, field[:, :3], t)), shutter, speed)[0]


def mean_of(times: np.ndarray) -> torch.Tensor:
    """The mean light of the same cloud at `times` moments from when its picture is taken."""
    light = [to_linear(draw(cloud(60), screw([2 + t])[0])(None)[0].image) for t in times]
    return from_linear(torch.stack(light).mean(0))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "bound"), [(2, 0.25), (3, 0.1)])
def test_blur_is_the_mean_light_of_what_passes(count, bound, held):
    shutter = torch.tensor([0.8], dtype=torch.float64)
    found = blurred(shutter, LENGTHS[count - 2] / 0.8 * 1.01)[1]
    assert len(found.draws) == count
    truth, sharp = mean_of(0.8 * ((np.arange(40) + 0.5) / 40 - 0.5)), mean_of(np.zeros(1))
    assert (sharp - truth).abs().mean() > 0.01
    held((found.image.detach() - truth).abs().mean() / (sharp - truth).abs().mean(), bound)


def test_as_many_pictures_are_drawn_as_the_blur_is_long():
    """One where it is under a pixel, and never more than three."""
    shutter = torch.tensor([0.5], dtype=torch.float64)
    for speed, count in ((0.0, 1), (1.9, 1), (2.1, 2), (7.9, 2), (8.1, 3), (1e6, 3)):
        assert len(blurred(shutter, speed)[1].draws) == count, speed


@pytest.mark.parametrize("times", MOMENTS)
def test_moments_have_the_mean_of_all_up_to_the_third_power(times, held):
    powers = range(4) if len(times) > 1 else range(2)
    for power in powers:
        found, truth = np.mean(np.power(times, power)), 0.5**power / (power + 1) * (power % 2 == 0)
        held(abs(found - truth), 1e-12, f"power {power}")


def test_speeds_in_the_picture_are_those_that_pixels_have(held):
    points, field, view = cloud().means, field_of(), screw([2.0])[0]
    camera, speeds = Camera(torch.tensor(view), K, *SIZE), points @ field[:, :3].T + field[:, 3]
    inside = ((seen(points, view) > 0) & (seen(points, view) < torch.tensor(SIZE))).all(1)
    step = 1e-6
    moved = (seen(points + step * speeds, view) - seen(points, view)).norm(dim=1) / step
    assert 0 < inside.sum() < len(points)
    truth = moved[inside].quantile(SWIFT)
    held(abs(px_a_moment(points, speeds, camera) / truth - 1), 1e-5)
    behind = points - torch.tensor(view[2, :3]) * 10
    assert px_a_moment(behind, speeds, camera) == 0, "nothing is in the picture"
    assert px_a_moment(points[:0], speeds[:0], camera) == 0


def test_a_shutter_of_zero_is_sharp_and_can_open():
    shutter = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    splats, one = blurred(shutter, 5 / OPEN)
    torch.testing.assert_close(one.image, mean_of(np.zeros(1)), atol=1e-12, rtol=0)
    one.image.square().mean().backward()
    assert shutter.grad.isfinite().all() and splats.means.grad.isfinite().all()
    assert len(one.draws) == 3 and one.screen_grad_abs.sum() > one.draws[0].screen_grad_abs.sum() > 0


def test_light_and_values_are_inverse_and_smooth_at_black(held):
    values = torch.tensor([-0.1, 0.0, 1e-9, 0.04045, 0.5, 1.0, 1.3], dtype=torch.float64, requires_grad=True)
    back = from_linear(to_linear(values))
    held((back - values).abs().max(), 1e-6)
    back.sum().backward()
    held((values.grad - 1).abs().max(), 0.02)  # the standard's two pieces meet almost
