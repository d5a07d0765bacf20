"""The page of a film, in a browser: two people, one larger, with their shadows, as we draw them."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from stages.avatar.effects.shading import BANDS, Shading
from stages.avatar.effects.shadow import Shadow
from stages.avatar.model.scene import load_scene
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast, in_colour
from stages.filming.page import figure, lamp, page
from stages.filming.parts import Parts
from stages.filming.setting import load_setting
from stages.filming.shoot import Shoot
from stages.filming.spec import Film, Person
from tests.made import exhibits
from tests.made.devtools import Page

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shoot(tmp_path_factory) -> Shoot:
    run = exhibits.make(tmp_path_factory.mktemp("page") / "run", gestured=True)["train"].parent
    people = [
        Person(avatar=run, motion="count_to_five", at=(-0.4, 0)),
        Person(avatar=run, motion="squats", at=(0.5, 0.3), scale=0.7),
    ]
    film = Film(scene=run, people=people, fps=10.0)
    setting = load_setting(film, "cpu")
    lamp = Shadow(torch.tensor([0.2, -0.1, -0.97]) / 0.9954, 0.6, 0.05, 1.0, 0.8).requires_grad_(False)
    actors = [cast(person, f"p{i}", setting.ground, film.fps, "cpu") for i, person in enumerate(people)]
    actors[1] = in_colour(actors[1], np.array([0.8, 1.0, 1.1]))
    setting = replace(setting, shadow=lamp, splats=load_scene(setting.scene))
    return Shoot(setting, actors, cameras_of("still", 30, film.fps, None, setting, actors), film.fps)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_all_people_move_as_in_the_film_before_its_camera(shoot, tmp_path):
    made, lacks = page(shoot, tmp_path / "film.html", Parts(tmp_path / "kept", ""))
    assert made and lacks == []
    shown = Page(tmp_path / "profile")
    try:
        shown.open(tmp_path / "film.html", "document.body?.matches('.open, .stuck')")
        for number in (0, 17):
            wanted = {"motion": 0, "frame": number, "camera": number, "background": 0}
            url = shown.run(f"hugs.show({json.dumps(wanted)})")
            data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
            theirs = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
            assert psnr(theirs, shoot.picture(number)) >= 47
        assert shown.run("document.getElementById('clip').textContent") == "Camera"
        shown.run("void document.getElementById('clip').click()")
        assert shown.run("[hugs.player.view, document.body.classList.contains('paired')]") == ["clip", False]
        assert shown.run("hugs.player.people.length") == 2 and shown.said == []
    finally:
        shown.close()


def test_hands_and_face_of_the_film_are_in_the_page(shoot):
    counts, squats = ((actor.placed, figure(shoot, actor).moves[0]) for actor in shoot.cast)
    np.testing.assert_array_equal(counts[1].hands, counts[0].hands[:30])
    np.testing.assert_array_equal(counts[1].face, counts[0].face[:30])
    assert squats[1].hands is None and squats[1].face is None


def test_each_stands_in_the_page_as_turned_and_as_large_as_in_the_film(shoot):
    aside = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    for actor in shoot.cast:
        turned = replace(actor, turn=actor.turn @ aside)
        shown = figure(shoot, turned)
        assert shown.scale == actor.scale
        np.testing.assert_array_equal(shown.turn, turned.turn)
        np.testing.assert_array_equal(shown.spot, actor.place)


@pytest.mark.parametrize("cast_shadow", [True, False])
def test_the_light_on_people_is_in_the_page_whether_or_not_a_shadow_falls(shoot, cast_shadow):
    light = Shading(torch.linspace(-0.3, 0.3, 3 * BANDS).view(BANDS, 3))
    setting = replace(shoot.setting, shading=light, shadow=shoot.setting.shadow if cast_shadow else None)
    shown = lamp(replace(shoot, setting=setting))
    np.testing.assert_array_equal(shown.shading, light.bands.detach().numpy())
    assert (shown.light is not None) is cast_shadow
