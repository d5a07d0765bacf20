"""A picture of a film: who is before whom, whose shadow falls where, and one antialiasing for all."""

import numpy as np
import pytest
import torch

from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import Casters, Shadow
from stages.avatar.splats.gaussians import facing
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast
from stages.filming.picture import draw_picture, everybody, shaded
from stages.filming.setting import load_setting
from stages.filming.spec import Film, Person
from tests.made.tiny import HEIGHT, WIDTH, colour_of

NEAR, FAR = 0.8, -1.0  # m ahead of where the person stood, who is 1.5 m before the wall


@pytest.fixture(scope="module")
def stage(tiny):
    run = tiny["train"].parent
    film = Film(
        scene=run, people=[Person(avatar=run, motion="wave", at=(0, z), turn=180 * (z < 0)) for z in (FAR, NEAR)]
    )
    setting = load_setting(film, "cpu")
    people = [cast(person, "a", setting.ground, 30.0, "cpu") for person in film.people]
    return setting, people, cameras_of("still", 1, 30.0, None, setting, people)[0]


def picture(setting, people, camera, shadow=None):
    image, _ = draw_picture(setting.splats, shadow, people, 0, camera, 0.0)
    return np.rint(image.clip(0, 1) * 255)


def lamp(*way):
    """A light from the direction `way` [3], of 0.6 of all."""
    nobody = Casters(torch.zeros(24, 3), torch.zeros(24, 3, 3))
    return Shadow(torch.tensor(way), nobody, 0.6, 0.05, 1.0, 1.0).requires_grad_(False)


def test_who_is_nearer_is_before_the_other_in_whatever_order_they_are_named(stage):
    """The far one shows their back, blue; the near one their front, red, and is the larger."""
    setting, (far, near), camera = stage
    both = picture(setting, [far, near], camera)
    np.testing.assert_allclose(picture(setting, [near, far], camera), both, atol=1)
    alone = picture(setting, [near], camera)
    covered = colour_of(alone) >= 0
    assert (np.abs(both - alone).max(-1)[covered] <= 2).mean() > 0.93, "but for the outline"
    assert (colour_of(picture(setting, [far], camera)) == 1).sum() > 100


def test_a_person_behind_the_wall_is_not_seen(tiny, stage):
    setting, _, camera = stage
    run = tiny["train"].parent
    hidden = cast(Person(avatar=run, motion="wave", at=(0, -2.5)), "a", setting.ground, 30.0, "cpu")
    empty, _ = draw_picture(setting.splats, None, [hidden], 0, camera, 0.0)
    assert (colour_of(np.rint(empty.clip(0, 1) * 255)) >= 0).sum() == 0 and empty.shape == (HEIGHT, WIDTH, 3)


def test_each_casts_a_shadow_and_two_are_darker_than_one_but_never_darker_than_the_light_is_strong(stage):
    setting, (far, near), _ = stage
    shadow = lamp(0.0, 0.0, -1.0)
    plain = setting.splats.sh[:, 0] * 0.2820948 + 0.5

    def light(people):
        lit = shaded(setting.splats, shadow, [one.casters(0) for one in people]).sh[:, 0] * 0.2820948 + 0.5
        return (lit / plain).mean(1)

    one, other, both = light([far]), light([near]), light([far, near])
    assert one.min() < 0.8 and other.min() < 0.8 and one.max() == 1
    assert (both <= torch.minimum(one, other) + 1e-5).all() and both.min() >= 0.4 - 1e-5
    depth = [-torch.log(1 - (1 - share) / 0.6 + 1e-9) for share in (one, other, both)]
    thin = both > 0.45
    torch.testing.assert_close(depth[2][thin], (depth[0] + depth[1])[thin], atol=2e-3, rtol=1e-3)
    assert shaded(setting.splats, None, [far.casters(0), near.casters(0)]) is setting.splats


def test_a_person_darkens_whoever_is_behind_them_and_not_themselves(stage):
    """The lamp is ahead, where the near one stands; z of the world falls that way."""
    setting, (far, near), _ = stage
    plain = [one.sh for one in everybody(setting.splats, None, [far, near], 0)]
    lit = [one.sh for one in everybody(setting.splats, lamp(0.0, 0.0, -1.0), [far, near], 0)]
    falls = [((new - old) * 0.2820948)[:, 0].mean(1) for old, new in zip(plain, lit, strict=True)]
    assert falls[0].min() < -0.2 and falls[0].max() < 1e-6, "behind"
    assert falls[1].abs().max() < 0.02 and falls[2].min() < -0.2
    (alone, _) = everybody(setting.splats, lamp(0.0, 0.0, -1.0), [far], 0)
    assert alone.sh is far.baked.resting.sh, "off changes no bit"


def test_people_stand_in_the_light_of_the_film_and_the_scene_keeps_its_own(stage):
    setting, people, _ = stage
    shading = Shading(torch.linspace(-0.6, 0.6, 24).view(8, 3)).requires_grad_(False)
    plain, lit = (everybody(setting.splats, None, people, 0, light) for light in (None, shading))
    for before, after in zip(plain[:-1], lit[:-1], strict=True):
        wanted = shading.light(facing(before.axes)) * (0.5 + 0.2820948 * before.sh[:, 0])
        torch.testing.assert_close(0.5 + 0.2820948 * after.sh[:, 0], wanted)
        assert (wanted - 0.5 - 0.2820948 * before.sh[:, 0]).abs().max() > 0.05
    assert lit[-1].sh is plain[-1].sh


@pytest.mark.parametrize("flag", [True, False])
def test_antialiasing_is_the_scenes_for_all(stage, flag):
    setting, people, _ = stage
    sets = everybody(setting.splats._replace(antialias=flag), None, people, 0)
    assert [one.antialias for one in sets] == [flag] * 3
    assert [one.antialias for one in everybody(None, None, people, 0)] == [False] * 2
