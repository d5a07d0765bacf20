"""Cameras of a film: people stay in view, and paths are those that were asked for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import project
from stages.contract import StageError
from stages.filming.cameras import CROWN, cameras_of, crowd
from stages.filming.cast import cast
from stages.filming.setting import load_setting
from stages.filming.spec import Film, Person
from stages.formats.cameras import write_cameras
from stages.records import Cameras

FPS = 20.0


@pytest.fixture(scope="module")
def stage(tiny):
    run = tiny["train"].parent
    film = Film(scene=run, people=[Person(avatar=run, motion="jumping_jacks", at=(x, 0)) for x in (-0.4, 0.5)])
    setting = load_setting(film, "cpu")
    return setting, [cast(person, "a", setting.ground, FPS, "cpu") for person in film.people]


def test_the_clips_path_is_gone_to_and_fro_at_its_own_pace(stage):
    setting, people = stage
    times, views = setting.times, setting.clip.viewmats
    cameras = cameras_of("clip", 100, FPS, None, setting, people)
    assert (cameras[0].width, cameras[0].height) == (setting.clip.width, setting.clip.height)
    passed = times[-1] - times[0]
    at = np.arange(100) / FPS
    for i in (0, 3, 7):
        nearest = np.abs(at - (times[i] - times[0])).argmin()
        np.testing.assert_allclose(cameras[nearest].viewmat, views[i], atol=0.06)
    period = round(2 * passed * FPS)
    np.testing.assert_allclose(cameras[period].viewmat, cameras[0].viewmat, atol=0.03)
    steps = [np.abs((b.viewmat - a.viewmat).numpy()).max() for a, b in zip(cameras, cameras[1:])]
    assert max(steps) < 0.1, "no jump where it turns back"


@pytest.mark.parametrize("kind", ["orbit", "before"])
def test_all_that_people_do_is_in_view_and_upright(stage, kind):
    setting, people = stage
    cameras = cameras_of(kind, 40, FPS, (320, 180), setting, people)
    joints = np.concatenate([actor.joints(range(40)) for actor in people], 1)
    for camera, here in zip(cameras, joints, strict=True):
        pixels, depth = project(here, camera.viewmat.numpy(), camera.K.numpy())
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < [320, 180]).all()
        down = camera.viewmat.numpy()[:3, :3] @ -setting.ground.up
        assert down[1] > 0.9
    ways = {tuple(np.round(camera.viewmat.numpy()[2, :3], 3)) for camera in cameras}
    assert len(ways) == (40 if kind == "orbit" else 1)


def test_following_keeps_the_eye_and_turns_after_people(stage):
    setting, people = stage
    still = cameras_of("still", 40, FPS, None, setting, people)
    cameras = cameras_of("follow", 40, FPS, None, setting, people)
    for camera in cameras:
        a, b = (-(c.viewmat[:3, :3].T @ c.viewmat[:3, 3]) for c in (camera, still[0]))
        np.testing.assert_allclose(a, b, atol=1e-9)
        here = np.concatenate([actor.joints([20])[0] for actor in people]).mean(0, keepdims=True)
        pixels, _ = project(here, camera.viewmat.numpy(), camera.K.numpy())
        assert np.abs(pixels[0] - [camera.width / 2, camera.height / 2]).max() < 12


def test_another_size_shows_as_much_about_the_same_middle(stage):
    setting, people = stage
    (own,), (wide,) = (cameras_of("still", 1, FPS, size, setting, people) for size in (None, (256, 128)))
    ray = np.linalg.inv(own.K.numpy()) @ [own.width / 2, own.height / 2, 1]
    np.testing.assert_allclose(wide.K.numpy() @ ray, [128, 64, 1], atol=1e-9)
    assert wide.K[0, 0] / own.K[0, 0] == pytest.approx(256 / own.width), "the wider side decides"


def test_given_cameras_take_another_size_as_the_clips_do(stage, tmp_path):
    clip = stage[0].clip
    write_cameras(tmp_path / "one.npz", Cameras(("a",), clip.viewmats[:1], clip.Ks[:1], clip.width, clip.height))
    camera = cameras_of(str(tmp_path / "one.npz"), 3, FPS, (2 * clip.width, 2 * clip.height), *stage)[0]
    assert (camera.width, camera.height) == (2 * clip.width, 2 * clip.height)
    np.testing.assert_allclose(camera.K[:2], 2 * clip.Ks[0, :2], rtol=1e-6)


def test_given_cameras_are_one_or_one_a_picture_and_others_are_refused(stage, tmp_path):
    setting, people = stage
    clip = setting.clip
    write_cameras(tmp_path / "three.npz", Cameras(("a", "b", "c"), clip.viewmats[:3], clip.Ks[:3], 32, 24))
    assert len(cameras_of(str(tmp_path / "three.npz"), 3, FPS, None, setting, people)) == 3
    with pytest.raises(StageError, match="do not belong together"):
        cameras_of(str(tmp_path / "three.npz"), 4, FPS, None, setting, people)


@pytest.mark.parametrize("kind", ["clip", "still", "follow"])
def test_without_a_clip_its_camera_cannot_be_had(stage, kind):
    setting, people = stage
    with pytest.raises(StageError, match="no clip whose camera") as refused:
        cameras_of(kind, 4, FPS, None, replace(setting, clip=None), people)
    assert "orbit" in refused.value.hint


def test_a_crown_is_as_much_higher_as_somebody_is_larger(stage):
    setting, (actor, _) = stage
    up = setting.ground.up
    for scale in (0.5, 1.0, 3.0):
        large = replace(actor, scale=scale)
        found = crowd(range(2), [large, actor], up)
        assert found.shape == (2, 50, 3)
        heads = found[:, 48:] - np.concatenate([one.joints(range(2))[:, 15:16] for one in (large, actor)], 1)
        np.testing.assert_allclose(heads @ up, np.tile(CROWN * np.array([scale, 1.0]), (2, 1)))


@pytest.mark.parametrize("fps", [5.0, 20.0, 60.0])
def test_following_is_as_calm_at_any_number_of_pictures_a_second(stage, fps):
    setting, ground, count = stage[0], stage[0].ground, round(4 * fps)

    def leaps(pictures):
        """2 m to the side, in the middle of 4 s."""
        way = np.where(np.arange(count) < count // 2, -1.0, 1.0)[list(pictures), None, None]
        return ground.point + ground.turn @ np.array([0, 1.0, 0]) + way * ground.turn[:, 0] + np.zeros((1, 24, 1))

    cameras = cameras_of("follow", count, fps, None, setting, [SimpleNamespace(joints=leaps, scale=1.0)])
    ahead = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras])
    share = ((ahead - ahead[0]) @ (ahead[-1] - ahead[0])) / ((ahead[-1] - ahead[0]) ** 2).sum()
    assert np.diff(share).min() >= -1e-6
    at = lambda seconds: share[round((2 + seconds) * fps)]  # noqa: E731
    assert 0.05 < at(-0.6) < 0.3 and 0.7 < at(0.6) < 0.95, "a standard deviation of 0.6 s"
    assert at(-1.8) < 0.02 and at(1.8) > 0.98
