"""Where a film is set: whose floor, and from where its light falls."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from stages.avatar.effects.shadow import DARKNESS
from stages.contract import StageError
from stages.filming.setting import DIM, lamp_of, load_setting
from stages.filming.spec import Film, Floor, Person
from stages.formats.effects import write_effects
from stages.formats.exchange.ply import write_ply
from stages.formats.ground import read_ground, write_ground
from stages.formats.splats import read_scene
from stages.records import Effects
from tests.made.said import any_holds


@pytest.fixture
def run(tiny, tmp_path):
    """A run whose files may be changed."""
    for stage in ("frames", "sfm", "smpl", "survey", "train"):
        shutil.copytree(tiny[stage], tmp_path / "run" / stage)
    return tmp_path / "run"


def film(scene, **more):
    return Film(scene=scene, people=[Person(avatar="a")], **more)


def survey(run, start=None, **shadow):
    path = run / "survey" / "survey.json"
    facts = json.loads(path.read_text())
    facts["effects"]["shadow"] |= shadow
    facts["starts"] = {} if start is None else {"shadow": start}
    path.write_text(json.dumps(facts))


def test_light_falls_as_training_learned_it(run):
    light = np.array([0.6, -0.8, 0.0])
    write_effects(run / "train" / "effects.npz", Effects(light, 0.37, 0.02, 2.0, 0.5))
    shadow, said = lamp_of(run, read_ground(run / "smpl" / "ground.json"), "auto")
    np.testing.assert_allclose(shadow.light(), light, atol=1e-6)
    assert shadow.darkness.sigmoid().item() == pytest.approx(0.37) and said == ()


def test_else_as_the_survey_saw_it(run):
    survey(run, start=[0.0, -0.6, 0.8, 0.21])
    shadow, said = lamp_of(run, read_ground(run / "smpl" / "ground.json"), "auto")
    np.testing.assert_allclose(shadow.light(), [0, -0.6, 0.8], atol=1e-6)
    assert shadow.darkness.sigmoid().item() == pytest.approx(0.21) and said == ()


@pytest.mark.parametrize(("share", "cast"), [(0.999, DARKNESS), (1.0, DARKNESS), (5.0, DARKNESS), (0.0, 0.05)])
def test_a_shadow_takes_neither_all_light_nor_none_whatever_the_survey_saw(run, share, cast):
    survey(run, start=[0.0, -0.6, 0.8, share])
    shadow, _ = lamp_of(run, read_ground(run / "smpl" / "ground.json"), "auto")
    assert shadow.darkness.sigmoid().item() == pytest.approx(cast)


def test_where_the_survey_saw_none_none_is_cast_and_that_is_said(run):
    survey(run, value=0.01, on=False)
    shadow, said = lamp_of(run, read_ground(run / "smpl" / "ground.json"), "auto")
    assert shadow is None and "saw no shadow" in said[0]


@pytest.mark.parametrize("light", ["auto", "above"])
def test_where_it_could_not_see_or_above_is_asked_for_it_falls_from_above(run, light):
    survey(run, value=None, on=False)
    ground = read_ground(run / "smpl" / "ground.json")
    shadow, said = lamp_of(run, ground, light)
    np.testing.assert_allclose(shadow.light(), ground.up, atol=1e-6)
    assert shadow.darkness.sigmoid().item() == pytest.approx(DIM)
    assert said == () if light == "above" else "fall from above" in said[0]
    assert lamp_of(run, ground, "off") == (None, ())


@pytest.mark.parametrize(("light", "lit"), [("auto", True), ("above", False), ("off", False)])
def test_people_stand_in_the_light_that_the_scenes_clip_told(run, light, lit):
    assert load_setting(film(run), "cpu").shading is None
    bands = np.linspace(-0.4, 0.4, 24).reshape(8, 3)
    write_effects(run / "train" / "effects.npz", Effects(shading=bands))
    shading = load_setting(film(run, light=light), "cpu").shading
    assert (shading is not None) is lit
    assert not lit or np.abs(shading.bands.numpy() - bands).max() < 1e-6


def test_a_guessed_floor_is_said(run):
    ground = read_ground(run / "smpl" / "ground.json")
    write_ground(run / "smpl" / "ground.json", replace(ground, points=0, how="guessed from the bodies"))
    assert any_holds(load_setting(film(run), "cpu").facts, "guessed", "bodies")


def test_a_file_needs_its_floor_and_stands_on_it(run, tmp_path):
    write_ply(tmp_path / "room.ply", read_scene(run / "train" / "scene.npz"))
    with pytest.raises(StageError, match=r"floor.*room\.ply") as refused:
        load_setting(film(tmp_path / "room.ply"), "cpu")
    assert "ground: {point:" in refused.value.hint
    with pytest.raises(StageError, match="parallel"):
        load_setting(film(tmp_path / "room.ply", ground=Floor(point=(0, 1, 3), up=(0, 2, 0), ahead=(0, -1, 0))), "cpu")
    setting = load_setting(film(tmp_path / "room.ply", ground=Floor(point=(0, 1, 3), ahead=(1, 5, -1))), "cpu")
    np.testing.assert_allclose(setting.ground.up, [0, -1, 0])
    np.testing.assert_allclose(setting.ground.ahead, [0.5**0.5, 0, -(0.5**0.5)], atol=1e-12)
    assert len(setting.splats.means) == 441 and setting.clip is None
    alone = load_setting(film(tmp_path / "room.ply", ground=Floor(point=(0, 1, 3)), only="human"), "cpu")
    assert alone.splats is None and alone.shadow is None
    np.testing.assert_allclose(alone.ground.point, [0, 1, 3])
    np.testing.assert_allclose(setting.shadow.light(), [0, -1, 0], atol=1e-6)


def test_an_edited_scene_takes_the_place_of_the_trained_one(run, tmp_path):
    scene = read_scene(run / "train" / "scene.npz")
    write_ply(tmp_path / "edited.ply", replace(scene, means=scene.means + 1))
    setting = load_setting(film(run, gaussians=tmp_path / "edited.ply"), "cpu")
    np.testing.assert_allclose(setting.scene.means, scene.means + 1, atol=1e-5)
    assert setting.clip is not None and any("anti-aliasing" in fact for fact in setting.facts)


def test_over_white_y_is_up_and_a_person_only_run_has_no_scene(tiny_human):
    setting = load_setting(film(None), "cpu")
    assert setting.splats is None and setting.shadow is None
    np.testing.assert_allclose(setting.ground.turn, np.eye(3))
    run = tiny_human["train"].parent
    with pytest.raises(StageError, match="no scene"):
        load_setting(film(run), "cpu")
    assert load_setting(film(run, only="human"), "cpu").clip is not None


def test_a_film_without_people_is_none():
    with pytest.raises(ValidationError):
        Film(people=[])


def test_scene_and_lamp_are_where_they_are_drawn(run):
    setting = load_setting(film(run, light="above"), "meta")
    assert {part.device.type for part in (setting.splats.means, *setting.shadow.state_dict().values())} == {"meta"}
