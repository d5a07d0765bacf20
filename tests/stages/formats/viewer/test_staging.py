"""What fades of a scene, and what people stand before."""

import base64
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages import export
from stages.contract import Job
from stages.formats.viewer.staging import STAGES, background, seen, underfoot
from stages.records import SH_C0, Cameras, Scene
from tests.made import company, exhibits, tiny
from tests.made.devtools import Page


def gaussians(means, scales=(0.02, 0.01, 0.01), grey=0.5) -> Scene:
    count = len(means)
    sh0 = np.full((count, 3), (grey - 0.5) / SH_C0)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return Scene(
        np.array(means, float), quats, np.tile(scales, (count, 1)), np.full(count, 0.9), sh0, np.zeros((count, 0, 3))
    )


def cameras(count: int) -> Cameras:
    """100x200 px, 90 degrees high, all in one place and looking along z."""
    K = np.array([[100.0, 0, 50], [0, 100, 100], [0, 0, 1]])
    return Cameras(
        tuple(map(str, range(count))), np.tile(np.eye(4), (count, 1, 1)), np.tile(K, (count, 1, 1)), 100, 200
    )


def test_what_no_picture_holds_fades_toward_its_edge():
    share = seen(gaussians([[0, 0, 2], [0, 1.9, 2], [1.5, 0, 2], [0, 2.1, 2], [0, 0, -2], [0, 0, 0]]), cameras(7))
    assert share[0] == 1 and share[1] == pytest.approx(5 / 8, abs=0.01) and share[2:] == pytest.approx(0)


def test_what_sticks_out_of_every_picture_fades():
    long = gaussians([[0, 0, 2], [0, 0, 9]], (0.9, 0.1, 0.1))
    assert seen(long, cameras(1)) == pytest.approx([0, 1])


def test_a_part_of_the_clip_is_enough_and_a_moment_is_not():
    views = np.tile(np.eye(4), (20, 1, 1))
    views[:10, 0, 3], views[10:19, 0, 3] = 5, -5  # it stands still, far to either side, and for one frame between
    scene = gaussians([[-5, 0, 2], [0, 0, 2]])
    assert seen(scene, replace(cameras(20), viewmats=views)) == pytest.approx([1, 0])


def test_floor_lies_flat_around_people():
    turn = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # the clip's y points down
    scene = gaussians([[4, 2, 0], [4, 1.5, 0], [6, 2, 0], [7.1, 2, 0]])
    assert underfoot(scene, turn, np.array([4, 2, 0])) == pytest.approx([1, 0, 0.5, 0])
    upright = gaussians([[4, 2, 0]], (0.01, 0.2, 0.01))
    assert underfoot(upright, turn, np.array([4, 2, 0])) == [0]


@pytest.mark.parametrize(("grey", "stage"), [(0.1, 1), (0.14, 1), (0.4, 0), (0.8, 0)])
def test_dark_clothes_have_a_lighter_stage(grey, stage):
    light, small = gaussians([[0, 0, 0]] * 9, grey=grey), gaussians([[0, 0, 0]] * 9, (1e-3, 1e-3, 1e-3), 0.9 - grey)
    assert background([light, small]) == STAGES[stage]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folders = exhibits.make(tmp_path_factory.mktemp("exhibit") / "made")
    shown = Page(tmp_path_factory.mktemp("profile"))
    shown.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
    yield shown
    shown.close()


def first_view(page: Page, size: tuple[int, int]) -> None:
    page.ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
    page.run("document.getElementById('home').click()")


def picture(page: Page, show: str) -> np.ndarray:
    url = page.run(f"(hugs.player.set({{ show: '{show}', plain: true }}), hugs.player.stage.still())")
    data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def person_in(page: Page) -> np.ndarray:
    """bool [H,W]: where the person alone stands off from the stage."""
    alone = picture(page, "person")
    return np.abs(alone - alone[0, 0]).max(2) > 20


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 360), (195, 422), (400, 400)])
def test_the_person_is_wholly_in_the_window_and_fills_it(page, size):
    first_view(page, size)
    person = person_in(page)
    assert person.shape == size[::-1]
    assert not person[[0, -1]].any() and not person[:, [0, -1]].any()
    rows, columns = person.any(1).mean(), person.any(0).mean()
    assert max(rows, columns) > 0.5


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The page of a clip of two people."""
    folder = tmp_path_factory.mktemp("pair")
    clip = company.make(folder)
    needs = {name: clip[name] for name in ("frames", "sfm", "smpl", "train")}
    export.run(Job(folder), export.Params(formats=["viewer"]), **needs)
    shown = Page(folder / "profile")
    shown.open(folder / "viewer.html", "document.body?.matches('.open, .stuck')")
    yield shown
    shown.close()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 360), (195, 422)])
def test_of_two_people_both_are_wholly_in_the_window(pair, size):
    """Their heads differ in colour."""
    first_view(pair, size)
    people, alone = person_in(pair), picture(pair, "person")
    assert not people[[0, -1]].any() and not people[:, [0, -1]].any() and people.mean() > 0.02
    for head in (tiny.YELLOW, tiny.YELLOW[company.INKS]):
        assert (np.abs(alone - 255 * head).max(2) < 60).sum() > 20


@pytest.mark.slow
def test_a_wall_between_eye_and_person_fades(page):
    first_view(page, (200, 200))
    before = np.abs(picture(page, "both") - picture(page, "person")).max(2)
    assert (before > 20).mean() > 0.3, "the wall behind the person is seen"
    page.run(
        "(() => { const { camera, controls } = hugs.player.stage, { x, z } = controls.target;"
        "camera.position.set(2 * x - camera.position.x, camera.position.y, 2 * z - camera.position.z); controls.update(); })()"
    )
    person = person_in(page)
    behind = np.abs(picture(page, "both") - picture(page, "person")).max(2)
    assert person.mean() > 0.02 and behind[person].max() <= 8
    page.run("(hugs.player.set({ given: hugs.player.clip.lens(0) }), hugs.player.stage.still())")
    assert page.run("hugs.player.fading.eye.w") == 0, "through a camera all is there"
