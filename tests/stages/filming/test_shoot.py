"""All that a picture shows is in the digest of what it is made of: nothing is served stale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.avatar.effects.shading import BANDS, Shading
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast, in_colour, moved
from stages.filming.setting import load_setting
from stages.filming.shoot import Shoot
from stages.filming.spec import Film, Person

FPS = 4.0


@pytest.fixture(scope="module")
def shoot(tiny) -> Shoot:
    run = tiny["train"].parent
    film = Film(scene=run, people=[Person(avatar=run, motion="squats", at=(x, 0)) for x in (-0.4, 0.5)], light="above")
    setting = load_setting(film, "cpu")
    actors = [cast(person, f"p{i}", setting.ground, FPS, "cpu") for i, person in enumerate(film.people)]
    return Shoot(setting, actors, cameras_of("still", 4, FPS, (24, 32), setting, actors), FPS)


def light(strength: float) -> Shading:
    return Shading(torch.linspace(-strength, strength, 3 * BANDS).view(BANDS, 3))


def with_setting(**more):
    return lambda shoot: replace(shoot, setting=replace(shoot.setting, **more))


def with_first(change):
    return lambda shoot: replace(shoot, cast=[change(shoot.cast[0]), *shoot.cast[1:]])


OTHERWISE = {
    "lit from a side": with_setting(shading=light(0.4)),
    "lit more": with_setting(shading=light(0.5)),
    "no shadow": with_setting(shadow=None),
    "no scene": with_setting(splats=None),
    "another scene": lambda shoot: with_setting(splats=shoot.setting.splats._replace(opacities=torch.ones(441)))(shoot),
    "antialiased": lambda shoot: with_setting(splats=shoot.setting.splats._replace(antialias=True))(shoot),
    "one moved": with_first(lambda actor: moved(actor, np.array([0.1, 0, 0]))),
    "one larger": with_first(lambda actor: replace(actor, scale=1.1)),
    "one in another colour": with_first(lambda actor: in_colour(actor, np.array([1.1, 1, 1]))),
    "one later": with_first(lambda actor: replace(actor, first=-2)),
    "one fewer": lambda shoot: replace(shoot, cast=shoot.cast[:1]),
    "seen from elsewhere": lambda shoot: replace(
        shoot, cameras=cameras_of("before", 4, FPS, (24, 32), shoot.setting, shoot.cast)
    ),
}


def test_whatever_is_otherwise_in_a_picture_is_otherwise_in_its_digest(shoot):
    assert replace(shoot).made_of([1]) == shoot.made_of([1]) != shoot.made_of([2])
    found = {name: change(shoot) for name, change in OTHERWISE.items()}
    digests = [one.made_of([1]) for one in (shoot, *found.values())]
    assert len(set(digests)) == len(digests)
    drawn = shoot.picture(1)
    for name, one in found.items():
        assert name == "antialiased" or not np.array_equal(one.picture(1), drawn), f"{name}: it shows"


def test_a_film_is_its_pictures_to_a_grey_step(shoot):
    for alone, one in ((False, shoot.picture), (True, shoot.people)):
        film = list(shoot.pictures(range(4), alone))
        for number, drawn in enumerate(film):
            off = np.abs(drawn.astype(int) - one(number))
            assert off.max() <= 1 and (off > 0).mean() < 0.1
        assert (film[0] != film[2]).any()


def test_hands_and_a_face_are_in_the_digest(shoot):
    """Of the pictures that show them, not of others."""
    still = np.zeros((99, 2, 15, 3)), np.zeros((99, 52))
    for name, part in zip(("hands", "face"), still, strict=True):
        bent = part.copy()
        bent[2:] = 1

        def given(value, name=name):
            return with_first(lambda actor: replace(actor, placed=actor.placed._replace(**{name: value})))(shoot)

        assert given(part).made_of([1]) == given(bent).made_of([1]) != shoot.made_of([1])
        assert given(part).made_of([2]) != given(bent).made_of([2])
