"""A film's next picture, of which only what changed is drawn again, is the one that is drawn whole."""

import numpy as np
import pytest
import torch

from stages.avatar.rasterize import Camera, Gaussians, Kept, Layer, cpu, rasterize
from tests.made.rasterized import HEIGHT, PICTURE, WIDTH, camera, gaussians

HALF = 0.5 / 255 + 1e-6
GROUND = torch.tensor([0.2, 0.5, 0.7])
SOME = torch.arange(300) % 7 == 0


def stuff(seed=0, kind="mixed", **more):
    means, quats, scales, opacities, colors = gaussians(kind=kind, seed=seed)
    return Gaussians(means, cpu.gaussian_axes(quats, scales), opacities, colors, **more)


def lens(**more):
    return Camera(*camera(**more), WIDTH, HEIGHT)


def pictures(film, kept):
    """The pictures of a film, each (Gaussians, camera, background), and how many bits of blocks were drawn."""
    for one, seen, ground in film:
        (drawn,) = rasterize(one, seen, [Layer(background=ground, kept=kept)])
        yield drawn, kept and int(np.unpackbits(kept.state.wanted.view(np.uint8)).sum())


def changed(one, name, value, rows=SOME):
    part = getattr(one, name).clone()
    part[rows] = value
    return one._replace(**{name: part})


def states():
    """Gaussians that move, fade, leave the picture and return, come before others, and are no numbers for a while."""
    one, other = stuff(), stuff(1)
    yield one
    for name in ("means", "axes", "opacities", "colors"):
        yield changed(one, name, getattr(other, name)[SOME])
    yield changed(one, "means", one.means[SOME] + torch.tensor([100.0, 0, 0]))
    yield changed(one, "opacities", 0.0)
    yield changed(one, "means", torch.nan)
    yield changed(one, "colors", torch.inf)
    yield changed(one, "means", one.means[SOME.roll(1)])  # at the depth of another row
    yield one._replace(means=one.means.flip(0))
    yield one


@pytest.mark.parametrize("antialias", [False, True])
def test_whatever_moves_the_picture_is_the_whole_one_to_the_bit(antialias):
    film = [(one._replace(antialias=antialias), lens(), GROUND) for one in states()]
    for (once, _), (whole, _) in zip(pictures(film, Kept()), pictures(film, None), strict=True):
        for name in (*PICTURE, "means2d", "radii"):
            assert torch.equal(getattr(once, name).nan_to_num(), getattr(whole, name).nan_to_num()), name
        assert once.dropped == whole.dropped


def test_another_camera_or_ground_or_number_of_gaussians_is_drawn_whole():
    one, other = stuff(), stuff(1)
    fewer = Gaussians(*(part[:200] for part in one[:4]))
    film = [(one, lens(), GROUND), (one, lens(focal=70.0), GROUND), (one, lens(focal=70.0), None)]
    film += [(fewer, film[1][1], None), (other, lens(), GROUND), (other._replace(antialias=True), lens(), GROUND)]
    for (once, bits), (whole, _) in zip(pictures(film, Kept()), pictures(film, None), strict=True):
        assert bits == 64 * 4 and torch.equal(once.image, whole.image)


def test_only_blocks_that_change_are_drawn():
    one = stuff(kind="tiny")
    moved = changed(one, "means", one.means[7] + 0.01, torch.arange(300) == 7)
    film = [(some, lens(), GROUND) for some in (one, one, moved, moved)]
    (first, all_bits), (_, none), (third, few), (_, again_none) = pictures(film, Kept())
    assert all_bits == 64 * 4 and none == again_none == 0 and 0 < few <= 9
    assert 0 < (first.image != third.image).any(2).sum() <= 16 * few


def test_colours_that_hardly_change_stay_and_never_drift():
    one = stuff()
    film = [(one._replace(colors=one.colors + 0.4 / 255 * number), lens(), GROUND) for number in range(12)]
    found = list(zip(pictures(film, Kept()), pictures(film, None), strict=True))
    off = [(once.image - whole.image).abs().max().item() for (once, _), (whole, _) in found]
    assert 0.2 / 255 < max(off) < HALF
    drawn = [bits for (_, bits), _ in found]
    assert drawn[1] == 0 < drawn[2], "the second step is more than half a grey step from what was drawn"


def test_a_picture_stays_as_it_is_when_the_next_is_drawn():
    film = [(stuff(seed), lens(), GROUND) for seed in (0, 1)]
    shown = pictures(film, Kept())
    first, _ = next(shown)
    before = first.image.clone()
    next(shown)
    assert torch.equal(first.image, before)


def test_what_is_kept_does_not_depend_on_threads():
    film = [(one, lens(), GROUND) for one in states()]
    found = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append([drawn.image for drawn, _ in pictures(film, Kept())])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_rows_and_windows_are_not_kept():
    for layer in (Layer(SOME, kept=Kept()), Layer(window=(0, 0, 8, 8), kept=Kept())):
        with pytest.raises(ValueError, match="whole"):
            rasterize(stuff(), lens(), [layer])
