"""Each example for Python runs on a small clip, and its picture shows what it says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hugs
from stages.formats.images import read_image
from stages.records import Effects
from tests.made import tiny
from tests.made.examples import EXAMPLES, example

TESTED = {"pose_and_draw", "camera_path", "fit_pose", "two_people"}
ELSEWHERE = {"own_masks", "train_on_arrays"}  # test_examples_that_run.py


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples") / "run"
    tiny.make(folder)
    return folder


def person_in(path: Path) -> np.ndarray:
    """Where a picture shows the colours of the person: bool [H,W]."""
    return tiny.colour_of(read_image(path)) >= 0


def test_all_examples_are_run_here():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == TESTED | ELSEWHERE


def test_pose_and_draw(run, tmp_path, capsys):
    example("pose_and_draw").main(str(run / "train" / "avatar.npz"), str(tmp_path / "pose.png"))
    columns = np.flatnonzero(person_in(tmp_path / "pose.png").any(0))
    assert 60 < np.ptp(columns) < 200, "the arms hang down"
    assert "1,723 Gaussians" in capsys.readouterr().out


def test_camera_path(run, tmp_path):
    example("camera_path").main(str(run), str(tmp_path / "path"), 3)
    left, middle, right = (person_in(tmp_path / "path" / f"{i:03d}.png") for i in range(3))
    assert min(seen.sum() for seen in (left, middle, right)) > 5000 and (left != right).mean() > 0.01


def test_two_people(run, tmp_path):
    example("two_people").main(str(run), str(run / "train" / "avatar.npz"), str(tmp_path / "two.png"))
    one = person_in(run / "sfm" / "images" / f"{tiny.NAMES[4]}.png")
    both = person_in(tmp_path / "two.png")
    assert both[one].mean() > 0.95 and both.sum() > 1.4 * one.sum()


def test_the_start_and_what_is_found_are_shown_beside_each_other(run, tmp_path, monkeypatch, capsys):
    fitting = example("fit_pose")
    true = hugs.load(run).motions["clip"][4].body_pose
    monkeypatch.setattr(fitting, "fit", lambda *given: true)  # the next test fits
    fitting.main(str(run), str(tmp_path / "found.png"))
    start, found = np.split(read_image(tmp_path / "found.png").astype(int), 2, 1)
    frame = read_image(run / "sfm" / "images" / f"{tiny.NAMES[4]}.png")
    assert np.abs(found - frame).max() <= 1 and np.abs(start - frame).mean() > 1
    assert capsys.readouterr().out.count("20.0 degrees off, then  0.0") == 8


def test_a_pose_is_found_in_a_picture_in_another_light_with_a_shadow_that_is_not_drawn(run):
    fitting = example("fit_pose")
    avatar = replace(hugs.load(run), light=Effects(shading=np.full((8, 3), 0.3)))
    true = avatar.motions["clip"][4]
    camera, start = avatar.cameras[4], fitting.turned(avatar, true, 20)
    picture, behind = fitting.drawn(avatar, true, camera)
    picture[70:80] *= 0.6  # across both thighs
    found = fitting.fit(avatar, picture, behind, camera, start, tries=16)
    before, after = (fitting.apart(pose, true.body_pose) for pose in (start.body_pose, found))
    assert before == pytest.approx(20, abs=1e-3) and after.max() < 2
