"""Whom a film's cameras cut off, whose backs they see, and the still camera that shows people best."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.rasterize import Camera
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast
from stages.filming.framing import faults, framed, framings
from stages.filming.setting import load_setting
from stages.filming.spec import Film, Person
from tests.made.said import holds

FPS = 4.0


@pytest.fixture(scope="module")
def stage(tiny):
    run = tiny["train"].parent
    setting = load_setting(Film(scene=run, people=[Person(avatar=run)]), "cpu")
    return setting, [cast(Person(avatar=run, motion="wave"), "ann", setting.ground, FPS, "cpu")]


def seen_from(stage, ahead: float, height: float = 0.9, focal: float = 100.0):
    """A camera that stands so far ahead of people and looks level at them, from a height in m."""
    setting, _ = stage
    eye, target = (setting.ground.point + setting.ground.turn @ np.array([0, height, z]) for z in (ahead, 0.0))
    return Camera.of(look_at(eye, target, setting.ground.up), pinhole(focal, 100, 200), 100, 200)


@pytest.mark.parametrize(("height", "parts"), [(0.9, ()), (1.9, ("feet",)), (0.0, ("head",)), (9.0, ("all",))])
def test_it_is_said_what_is_cut_off_and_in_which_share_of_the_pictures(stage, height, parts):
    camera = seen_from(stage, 2.5 if len(parts) else 4.0, height, 160.0 if len(parts) else 100.0)
    far = seen_from(stage, 6.0)
    (one,) = framings([camera] * 5 + [far] * 5, FPS, *stage)
    assert (one.head, one.feet, one.gone, one.back) == tuple(
        0.5 * (part in parts) for part in ("head", "feet", "all", "-")
    )
    told = faults([one], stage[1])
    assert len(told) == bool(parts) and all(holds(line, "ann", *parts, "50 %") for line in told)


def test_backs_are_seen_from_behind(stage):
    seen = [framings([seen_from(stage, ahead)] * 3, FPS, *stage) for ahead in (4.0, -4.0)]
    assert [one.back for (one,) in seen] == [0, 1]
    assert faults(seen[0], stage[1]) == [] and holds(*faults(seen[1], stage[1]), "backs", "100 %")


def with_views(stage, *cameras: Camera):
    """The stage, its clip seen by such cameras."""
    setting, people = stage
    views, Ks = (np.stack([part.numpy() for part in parts]) for parts in list(zip(*cameras))[:2])
    names = tuple(str(i) for i in range(len(cameras)))
    clip = SimpleNamespace(names=names, viewmats=views, Ks=Ks, width=100, height=200)
    return replace(setting, clip=clip), people


def test_the_camera_is_the_middle_ones_unless_another_frame_shows_people_better(stage):
    good, close, back = seen_from(stage, 4.0), seen_from(stage, 2.0, focal=300.0), seen_from(stage, -4.0)

    def chosen(*cameras):
        there = with_views(stage, *cameras)
        found, said = framed("auto", 3, FPS, None, *there)
        return [np.allclose(found[0].viewmat, one.viewmat) for one in cameras].index(True), said

    assert chosen(back, good, close) == (1, "")
    row, said = chosen(close, close, good)
    assert row == 2 and holds(said, "frame 2")
    assert chosen(good, back, back)[0] == 0, "a front is better than a back"
    wide, said = framed("auto", 3, FPS, None, *with_views(stage, seen_from(stage, 0.9), close, back))
    eyes = [-(one.viewmat[:3, :3].T @ one.viewmat[:3, 3]) for one in (wide[0], close)]
    assert np.allclose(*eyes) and wide[0].K[0, 0] < 280 and holds(said, "frame 1", "wide"), (
        "who stands there is seen whole"
    )
    assert faults(framings(wide, FPS, *stage), stage[1]) == []


def test_where_the_clip_sees_backs_the_camera_stands_before_people(stage):
    there = with_views(stage, *[seen_from(stage, -4.0)] * 3)
    found, said = framed("auto", 3, FPS, None, *there)
    before = cameras_of("before", 3, FPS, None, *there)
    assert np.array_equal(found[0].viewmat, before[0].viewmat) and holds(said, "backs", "100 %")
    assert framed("auto", 3, FPS, None, replace(there[0], clip=None), there[1])[1] == ""
