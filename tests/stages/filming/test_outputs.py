"""What a film is written as: progress that counts every picture once, and USD on its floor."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.commands import compose
from stages.commands.compose import names_of
from stages.contract import Job
from stages.filming import outputs
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast
from stages.filming.page import page
from stages.filming.parts import Parts
from stages.filming.setting import load_setting
from stages.filming.shoot import Shoot
from stages.filming.spec import Film, Person
from stages.formats import viewer
from tests.made import finished
from tests.made.said import holds

FPS = 4.0


@pytest.fixture(scope="module")
def shoot(tiny) -> Shoot:
    run = tiny["train"].parent
    people = [
        Person(avatar=run, motion="squats", at=(x, 0), speed=0.93) for x in (-0.4, 0.5)
    ]  # else a piece is as the last
    film = Film(scene=run, people=people, fps=FPS)
    setting = load_setting(film, "cpu")
    actors = [cast(person, f"p{i}", setting.ground, FPS, "cpu") for i, person in enumerate(film.people)]
    return Shoot(setting, actors, cameras_of("still", 20, FPS, (48, 64), setting, actors), FPS)


@pytest.mark.slow
def test_a_long_film_says_how_far_it_is_and_begins_after_what_was_kept(shoot, tmp_path):
    parts, heard = Parts(tmp_path / "kept", ""), []
    assert outputs.film(shoot, tmp_path / "a.mp4", parts, False, heard.append)
    assert sorted(set(heard)) == list(range(1, 21)) and heard == sorted(heard)
    kept = sorted((tmp_path / "kept").glob("*.mp4"), key=lambda path: path.stat().st_mtime_ns)
    kept[1].unlink()
    (tmp_path / "a.mp4").unlink()
    heard.clear()
    assert outputs.film(shoot, tmp_path / "a.mp4", parts, False, heard.append)
    assert heard == [8, *range(9, 17), 16, 20], "the first and the third piece of 2 s were there"


@pytest.mark.slow
def test_usd_has_a_sample_a_picture_y_up_with_the_floor_at_0(shoot, tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (the extra `usd`)")
    heard: list[int] = []
    assert outputs.usd(shoot, tmp_path / "a.usdc", Parts(tmp_path / "kept", ""), heard.append)
    assert heard[-1] == shoot.count and heard == sorted(heard)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert stage.GetTimeCodesPerSecond() == FPS and stage.GetEndTimeCode() == shoot.count - 1
    for actor in shoot.cast:
        places = stage.GetPrimAtPath(f"/World/{actor.name}").GetAttribute("positionsh")
        assert places.GetTimeSamples() == list(range(shoot.count))
        ground = shoot.setting.ground
        for number in (0, 7):
            expected = (actor.splats(number).means.numpy() - ground.point) @ ground.turn
            found = np.array(places.Get(number)).astype(float)
            np.testing.assert_allclose(found, expected, atol=2e-3)
            assert abs(found[:, 1].min()) < 0.05, "soles at 0"
    scene = stage.GetPrimAtPath("/World/scene").GetAttribute("positions").Get()
    assert len(scene) == len(shoot.setting.scene)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_splats_are_y_down_whichever_way_the_scene_is(shoot, tmp_path, monkeypatch, up):
    got = []
    monkeypatch.setitem(outputs.SPLATS, ".ply", lambda out, scene: (got.append(scene), out.touch(), {})[-1])
    level = replace(shoot.setting.ground, up=np.array([0, up, 0.0]))
    outputs.splats(
        replace(shoot, setting=replace(shoot.setting, ground=level)), tmp_path / "a.ply", 1.0, Parts(tmp_path, "")
    )
    sets = shoot.at(shoot.where(1.0)).sets
    means = np.concatenate([one.means.numpy() for one in sets])
    np.testing.assert_allclose(got[0].means, means * ([1, -1, -1] if up > 0 else 1), atol=1e-6)


def test_the_pelvis_of_a_glb_is_where_the_film_has_it(tmp_path):
    """Of a body whose pelvis is not at the origin at rest, turned, aside, and twice as large."""
    run = finished.make(tmp_path)
    ann = Person(avatar=run, motion="squats", at=(0.4, -0.3), turn=50, scale=2.0)
    setting = load_setting(Film(scene=run, people=[ann]), "cpu")
    actor = cast(ann, "ann", setting.ground, FPS, "cpu")
    assert np.abs(actor.soles.joints[0]).max() > 0.1
    one = Shoot(setting, [actor], cameras_of("still", 6, FPS, (48, 64), setting, [actor]), FPS)
    place, quat, scale = outputs.stand(one, actor)
    there = np.array(place) + scale * Rotation.from_quat(quat).apply(outputs.take(one, actor).pelvis)
    expected = (actor.joints(range(6))[:, 0] - setting.ground.point) @ setting.ground.turn
    np.testing.assert_allclose(there, expected, atol=1e-5)


def test_files_that_name_people_are_made_again_when_these_are_called_otherwise(shoot, tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "mesh_of", lambda actor: None)
    writers = ((outputs, "write_film_glb"), (outputs, "write_usd"), (viewer, "write_viewer"))
    for module, name in writers:
        monkeypatch.setattr(module, name, lambda out, *rest: [out.touch()][1:])
    ann = replace(shoot, cast=[replace(actor, name=f"ann_{actor.name}") for actor in shoot.cast])
    parts = Parts(tmp_path / "kept", "")
    for one, made in ((shoot, True), (shoot, False), (ann, True), (ann, False)):
        assert outputs.glb(one, tmp_path / "a.glb", parts) == made
        assert outputs.usd(one, tmp_path / "a.usdc", parts, lambda done: None) == made
        assert page(one, tmp_path / "a.html", parts) == (made, [])


@pytest.mark.parametrize(("count", "facts"), [(1, ("1 frame", "0.2 s", "4 fps")), (2, ("2 frames", "0.5 s", "4 fps"))])
def test_frames_are_counted_in_words(tmp_path, count, facts):
    heard: list[dict] = []
    film = Film(people=[Person(avatar="ann.npz", motion="wave")], fps=FPS)
    compose._write(Job(tmp_path, emit=heard.append), film, SimpleNamespace(count=count), Parts(tmp_path / "kept", ""))
    assert len(heard) == 1 and holds(heard[0]["text"], *facts)


def test_nobody_is_named_as_the_scene_or_as_another():
    people = [Person(avatar=f"{name}.npz", motion="wave") for name in ("ann", "ann", "scene", "7", "scene")]
    assert names_of(Film(people=people)) == ["ann", "ann_2", "scene_2", "person_7", "scene_3"]
    people = [Person(avatar=f"{name}.npz", motion="wave") for name in ("ann_2", "ann", "ann")]
    assert names_of(Film(people=people)) == ["ann_2", "ann", "ann_3"], "a clip may be named so"
