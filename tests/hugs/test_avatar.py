"""A finished run from Python: its people, scene, cameras, motions, floor and light."""

import shutil

import numpy as np
import pytest

import hugs
from stages.formats.images import read_image
from tests.made import tiny


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hugs") / "run"
    tiny.make(folder)
    return folder


@pytest.fixture(scope="module")
def avatar(run):
    return hugs.load(run)


def test_a_frame_of_the_clip_is_drawn_from_what_the_run_holds(avatar, run):
    motion = avatar.motions["clip"]
    assert avatar.frames == tiny.NAMES and len(avatar.cameras) == len(motion) == tiny.FRAMES
    picture = hugs.draw(avatar.pose(*motion[2]), avatar.cameras[2], avatar.scene)
    truth = read_image(run / "sfm" / "images" / f"{avatar.frames[2]}.png")
    assert np.abs(picture.image * 255 - truth).max() < 2
    assert motion.fps == pytest.approx(10) and motion.seen.tolist() == [i != tiny.EMPTY for i in range(tiny.FRAMES)]


def test_made_motions_stand_on_the_floor_of_the_clip(avatar, run):
    assert set(avatar.motions) > {"clip", "walk_in_place", "squats"} and "nothing" not in avatar.motions
    person = avatar.pose(*avatar.motions["squats"][::20])
    heights = (person.means - avatar.floor.point) @ avatar.floor.up
    assert -0.1 < heights.min() < 0.03 and heights.max() > 1.4
    alone = hugs.load(run / "train" / "avatar.npz")
    assert alone.floor is None and "clip" not in alone.motions and alone.cameras == ()
    assert -0.1 < alone.pose(*alone.motions["squats"][0]).means[:, 1].min() < 0.03


def test_who_is_chosen_among_people(run, tmp_path):
    shutil.copytree(run, tmp_path / "two")
    second = tmp_path / "two" / "train" / "people" / "2"
    shutil.copytree(run / "train", second)
    ann, ben = (hugs.load(tmp_path / "two", who=who) for who in (1, 2))
    assert "person 2" in repr(ben) and ann.scene is not None and ben.scene is not None
    with pytest.raises(hugs.StageError, match="no person 3"):
        hugs.load(tmp_path / "two", who=3)
    with pytest.raises(hugs.StageError, match="no person 2"):
        hugs.load(run / "train" / "avatar.npz", who=2)


@pytest.mark.parametrize("path, named", [("train/scene.npz", r"scene\.npz"), ("sfm", "no finished run")])
def test_what_is_no_avatar_is_refused_by_name(run, path, named):
    with pytest.raises(hugs.StageError, match=named):
        hugs.load(run / path)
