"""The page: what is in it, and what a real browser makes of it."""

from __future__ import annotations

import contextlib
import json
import re
from dataclasses import replace
from importlib import resources
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.drawing.avatar import bones_of
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.drawing.rig import rig_of
from stages.avatar.motion.formulas import MOTIONS
from stages.avatar.motion.moves import made_moves
from stages.avatar.motion.placing import Soles
from stages.avatar.rasterize import Camera
from stages.filming.motions import Manner, from_file
from stages.formats import viewer
from stages.formats.body_model import read_body_model
from stages.formats.clip import load_clip
from stages.formats.ground import read_ground
from stages.formats.motions import bvh_names
from stages.formats.splats import read_avatar
from stages.formats.trained import read_trained
from stages.gestures import FACE_NAMES, Face
from tests.made import bvh as bvh_made
from tests.made import exhibits, headset, tiny
from tests.made.devtools import Page
from tests.made.learned import draw, load_learned
from tests.made.marionette import Firefox
from tests.made.said import holds
from tests.made.viewed import drop, message, picture, psnr, wait

CLIP, JACKS = 0, 1  # motions of the page
WALL = 4.5  # m ahead, in the tiny clip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return exhibits.make(tmp_path_factory.mktemp("exhibit") / "made")


@pytest.fixture(scope="module")
def html(folders):
    return (folders["export"] / "viewer.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(folders, tmp_path_factory):
    """The page, under a hostile name, open in a browser."""
    shown, hostile = Page(tmp_path_factory.mktemp("profile")), folders["export"] / "hostile.html"
    viewer.write_viewer(hostile, replace(exhibits.rename(exhibits.run(folders)), times_fit=1.25))
    shown.open(hostile, "document.body?.matches('.open, .stuck')")
    yield shown
    shown.close()


def part(html: str, name: str) -> dict:
    return json.loads(re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', html)[1])


def test_the_same_result_gives_the_same_bytes(folders, html):
    exhibits.run(folders)
    assert (folders["export"] / "viewer.html").read_text(encoding="utf-8") == html


def test_the_page_holds_all_that_it_shows(html):
    fetched = (
        r"""<[a-z][^>]*?\s(?:src|href)=["']?(?!data:)[^"'> ]+|url\(["']?(?!data:)[^)"']+|import\(["'](?!hugs/)[^)]*"""
    )
    assert re.findall(fetched, html) == []
    assert set(part(html, "modules")) == {f"hugs/{name.removesuffix('.js')}" for name in viewer.MODULES}
    assert {path.name for path in viewer.ROOM.iterdir()} == {
        *viewer.MODULES,
        "viewer.html",
        "viewer.css",
        "boot.js",
        "icons.json",
    }
    facts = part(html, "facts")
    assert [move["name"] for move in facts["motions"]] == [
        "In the clip",
        "Jumping jacks",
        "Walk in place",
        "Wave",
        "Squats",
    ]
    assert facts["motions"][0]["fps"] == pytest.approx(10) and facts["people"][0]["absent"] == [tiny.EMPTY]
    assert len(facts["clip"]["pictures"]) == tiny.FRAMES


def test_many_pictures_and_large_scenes_are_bounded(monkeypatch, folders):
    monkeypatch.setattr(viewer, "BYTES", 4000)
    monkeypatch.setattr(viewer, "LARGEST_SCENE", 100)
    exhibits.run(folders | {"export": folders["export"].parent})
    html = (folders["export"].parent / "viewer.html").read_text(encoding="utf-8")
    facts = part(html, "facts")
    assert 1 <= len(facts["clip"]["pictures"]) < tiny.FRAMES
    assert facts["arrays"]["scene/opacities"]["shape"] == [100, 1]
    assert holds(html, "3,869 of 3,969")


@pytest.mark.slow
def test_it_opens_and_asks_the_network_for_nothing(page):
    assert page.run("document.body.className") == "open"
    assert [one[:40] for one in page.requests if not one.startswith(("file:", "data:", "blob:"))] == []
    assert sum(one.startswith("file:") for one in page.requests) == 1
    assert page.said == []


@pytest.mark.slow
def test_no_control_sticks_out_of_the_bar(folders, tmp_path):
    with contextlib.closing(Page(tmp_path / "profile")) as page:
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        for width in (1200, 700, 360):
            page.ask("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=False)
            lines = page.run("[...document.querySelectorAll('.line')].map((one) => [one.scrollWidth, one.clientWidth])")
            assert len(lines) == 2 and all(needed <= given for needed, given in lines), width


@pytest.mark.slow
def test_no_name_runs_as_code(page):
    assert page.run("window.broken") is None
    places = "['title', 'h1', 'header p', 'dt', 'dd', '#motion option']"
    shown = page.run(f"{places}.map((place) => document.querySelector(place).textContent)")
    assert [" ".join(text.split()) for text in shown] == [" ".join(exhibits.NAME.split())] * 6
    assert page.run("document.scripts.length") == 6, "five as written, and the import map"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "frame", "only"), [(CLIP, 2, "both"), (JACKS, 40, "both"), (JACKS, 70, "person"), (CLIP, 0, "scene")]
)
def test_a_frame_is_as_we_draw_it(page, folders, motion, frame, only):
    """With clothes and shadow, all bones however little they weigh, and many faint layers."""
    whole, person = likeness(page, folders, motion, frame, only)
    assert whole >= 52 and person >= 50


def likeness(page: Page | Firefox, folders, motion: int, frame: int, only: str) -> tuple[float, float]:
    """PSNR dB of a frame of the page against our own drawing: the whole picture, and the box of the person."""
    clip, learned = (
        load_clip(folders["sfm"], folders["smpl"], folders["train"]),
        load_learned(*read_trained(folders["train"])),
    )
    soles = Soles.of_rig(rig_of(read_avatar(folders["train"] / "avatar.npz")))
    jacks = made_moves(read_ground(folders["smpl"] / "ground.json"), soles, False)[0]
    poses = {
        CLIP: (clip.body.global_orient, clip.body.body_pose, clip.body.transl),
        JACKS: (jacks.rotvecs[:, :3], jacks.rotvecs[:, 3:], jacks.steps),
    }
    pose = tuple(rows[frame] for rows in poses[motion])
    camera = Camera.of(clip.viewmats[3], clip.Ks[3], clip.width, clip.height)
    human = None if only == "scene" else learned.person(pose)
    scene = None if only == "person" else learned.shade(learned.scene, pose if human else None)
    ours = to_uint8(draw(human, scene, camera, 1.0)[0])
    wanted = {"motion": motion, "frame": frame, "camera": 3, "only": only, "background": 0xFFFFFF}
    theirs = picture(page.run(f"hugs.show({json.dumps(wanted)})"))
    assert theirs.shape == ours.shape
    if human is None:
        return psnr(theirs, ours), np.inf
    rows, columns = np.nonzero(draw(human, None, camera)[1] > 0.1)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    return psnr(theirs, ours), psnr(theirs[box], ours[box])


@pytest.mark.slow
def test_firefox_draws_it_too(folders, tmp_path):
    """Where Debian's firefox-esr and xvfb are."""
    page = Firefox(tmp_path / "profile")
    try:
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        assert page.run("document.body.className") == "open"
        whole, person = likeness(page, folders, JACKS, 40, "both")
        assert whole >= 45 and person >= 45
    finally:
        page.close()


@pytest.mark.slow
def test_clothes_swing_on_the_page_as_they_do_here(page, folders):
    clip, learned = (
        load_clip(folders["sfm"], folders["smpl"], folders["train"]),
        load_learned(*read_trained(folders["train"])),
    )
    soles = Soles.of_model(clip.body_model, clip.body.betas)
    jacks = made_moves(read_ground(folders["smpl"] / "ground.json"), soles, False)[0]
    ours = [bones_of(learned.avatar, pose[:3], pose[3:]) for pose in torch.as_tensor(jacks.rotvecs[:30]).float()]
    theirs = page.run(
        f"(() => {{ const {{ people: [person], motions }} = hugs.player, motion = motions[{JACKS}];"
        "const { clothes } = person, hang = clothes.hang.bind(clothes), found = [];"
        "clothes.hang = (...told) => { const hung = hang(...told); found.push([hung.turns, hung.shifts]); return hung; };"
        f"for (let i = 0; i < {len(ours)}; i++) person.take(motion.at(i, 0));"
        "delete clothes.hang; return found; })()"
    )
    for bones, (turns, shifts) in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(np.reshape(turns, (-1, 3, 3)), bones[24:, :3, :3], atol=2e-4)
        np.testing.assert_allclose(shifts, bones[24:, :3, 3], atol=2e-4)
    stiff = learned.avatar.clothing.carried(ours[5][:24])
    assert (ours[5][24:] - stiff).abs().max() > 0.005, "else the swing says nothing"


@pytest.mark.slow
@pytest.mark.parametrize("rest", ["a pose", "bones along x", "z up"])
def test_a_bvh_is_performed_as_animate_performs_it(page, folders, tmp_path, rest):
    model = read_body_model()
    joints = model.J_regressor.astype(float) @ model.v_template
    orient, pose, transl = (part.numpy().astype(float) for part in MOTIONS["walk_in_place"](1.5, 20))
    stance = bvh_made.bones_along_x(joints) if rest == "bones along x" else bvh_made.a_pose()
    to_file = Rotation.from_euler("x", 90, degrees=True).as_matrix() if rest == "z up" else None
    local = bvh_made.matrices(orient, pose)
    path = bvh_made.write_bvh(
        tmp_path / "walk.bvh", joints * 1.3, local, transl + [0, 0.9, 0.4], stance, fps=20, to_file=to_file
    )
    soles = Soles.of_rig(rig_of(read_avatar(folders["train"] / "avatar.npz")))
    ours, _ = from_file(path, Manner(20.0), soles, model.parents.tolist())
    found = page.run(
        f"(() => {{ const {{ rotvecs, steps, fps }} = hugs.perform({json.dumps(path.read_text())});"
        "return { rotvecs: Array.from(rotvecs), steps: Array.from(steps), fps }; })()"
    )
    assert found["fps"] == pytest.approx(20)
    theirs = Rotation.from_rotvec(np.reshape(found["rotvecs"], (-1, 3)))
    own = Rotation.from_rotvec(np.concatenate([ours.global_orient, ours.body_pose], 1).reshape(-1, 3))
    assert np.degrees((own.inv() * theirs).magnitude()).max() < 0.01
    np.testing.assert_allclose(np.reshape(found["steps"], (-1, 3)), ours.transl, atol=1e-4)


@pytest.mark.slow
def test_a_dropped_motion_is_played_and_a_bad_one_is_refused_in_words(page, folders, tmp_path):
    model = read_body_model()
    joints = model.J_regressor.astype(float) @ model.v_template
    orient, pose, transl = (part.numpy().astype(float) for part in MOTIONS["squats"](1.0, 10))
    stance = np.tile(np.eye(3), (24, 1, 1))
    text = bvh_made.write_bvh(tmp_path / "s.bvh", joints, bvh_made.matrices(orient, pose), transl, stance).read_text()
    drop(page, "down <b>up</b>.bvh", text)
    wait(page, "hugs.player.motions.length === 6")
    assert page.run("document.getElementById('motion').selectedOptions[0].textContent") == "down <b>up</b>"
    assert page.run("hugs.player.playing") is True
    page.run("hugs.player.set({ playing: false })")
    for name, content, said in (
        ("a.npz", "", "is no BVH"),
        ("a.csv", "time,jawOpen\n0,1", "nobody here has a face that moves"),
        ("b.bvh", text[:400], "ends too soon"),
        ("c.bvh", text.replace("LeftLeg", "Tail"), "missing left knee"),
        ("d.bvh", text.replace("Frames: 10", "Frames: 99999999"), "10 frames of 99999999"),
        ("e.bvh", text.rstrip("\n").rpartition("\n")[0].rpartition("\n")[0], "8 frames of 10"),
    ):
        drop(page, name, content)
        message(page, said)
    assert page.run("hugs.player.motions.length") == 6
    drop(
        page, "cut.bvh", text.replace("LeftForeArm", "LeftLowArm").replace("Frames: 10", "Frames: 11")
    )  # as `read_bvh` takes it
    wait(page, "hugs.player.motions.length === 7")
    assert page.run("document.getElementById('motion').selectedOptions[0].textContent") == "cut (10 frames of 11)"


def test_only_sliders_that_move_a_face_are_shown():
    moves = np.zeros((62, 1, 3))
    moves[FACE_NAMES.index("mouthSmileRight")] = 0.01
    bare = SimpleNamespace(fingers=None)
    faces = [None, Face(np.zeros(1, int), 0 * moves), Face(np.zeros(1, int), moves)]
    shown = [viewer._sliders(SimpleNamespace(figures=[SimpleNamespace(face=one, rig=bare)])) for one in faces]
    assert shown == [{}, {}, {"Smile": "mouthSmileLeft mouthSmileRight"}]


def test_the_page_knows_the_names_of_joints_that_animate_knows():
    page = resources.files("stages.formats.viewer") / "page" / "names.js"
    assert dict(re.findall(r"^  (\w+): \"(.+)\",$", page.read_text(), re.MULTILINE)) == bvh_names.SYNONYMS


@pytest.mark.slow
def test_compare_shows_frame_and_camera_of_one_moment_until_the_camera_is_dragged(page):
    page.run("void hugs.player.set({ motion: hugs.player.motions[0], position: 5, playing: false, speed: 1 })")
    page.run("document.getElementById('clip').click()")
    wait(page, "!hugs.player.stage.busy && document.getElementById('picture').complete")
    assert page.run("document.getElementById('caption').textContent") == "the clip, frame 000015"
    sides = "['picture', 'canvas'].map((id) => document.getElementById(id).getBoundingClientRect())"
    sizes = page.run(f"{sides}.map(({{ width, height }}) => [width, height])")
    assert sizes[0] == sizes[1] and sizes[0][0] / sizes[0][1] == pytest.approx(tiny.WIDTH / tiny.HEIGHT, rel=0.01)
    place = page.run(f"(({{ x, y }}) => ({{ x: x + 20, y: y + 20 }}))({sides}[1])")
    for kind, moved in (("mousePressed", 0), ("mouseMoved", 15), ("mouseReleased", 15)):
        there = {"x": place["x"] + moved, "y": place["y"]}
        page.ask("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **there)
    assert page.run("[hugs.player.view, document.body.classList.contains('paired')]") == ["orbit", False]


@pytest.mark.slow
def test_a_slider_bends_its_joint_and_what_hangs_on_it(page):
    page.run(
        "(() => { const slider = document.getElementById('turn-y'); slider.value = 90;"
        "slider.dispatchEvent(new Event('input')); })()"
    )
    wait(page, "!hugs.player.stage.busy")
    moved = page.run(
        "(() => { const p = hugs.player, at = () => p.people[0].take(p.bent(p.motion.at(5))).places;"
        "const bent = at(); p.bends.clear(); const straight = at();"
        "return bent.map((place, i) => Math.hypot(...place.map((x, k) => x - straight[i][k])) > 1e-6); })()"
    )
    assert [i for i, far in enumerate(moved) if far] == [20, 22], "the left elbow's wrist and hand"


@pytest.mark.slow
def test_keys_press_the_buttons(page):
    def press(key: str) -> None:
        page.ask("Input.dispatchKeyEvent", type="keyDown", key=key, text=key if len(key) == 1 else "")
        page.ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    page.run("void (document.activeElement.blur(), hugs.player.set({ position: 3, playing: false, show: 'both' }))")
    for key in ("ArrowRight", "1", "j", "s"):
        press(key)
    found = page.run(
        "[hugs.player.position, hugs.player.show, document.getElementById('joints').hidden, hugs.player.shaded]"
    )
    assert found == [4, "person", False, True], "no shadow is switched where none falls"
    press("2")
    press("s")
    press("i")
    assert page.run("[hugs.player.show, hugs.player.shaded, hugs.player.dimmed]") == ["both", False, True]
    press("i")


@pytest.mark.slow
def test_what_is_invented_is_darkened_when_asked(page, folders):
    def drawn(dimmed: str) -> np.ndarray:
        page.run(f"void hugs.player.set({{ dimmed: {dimmed} }})")
        return picture(page.run("hugs.show({ camera: 0, only: 'scene' })"))

    seen, dimmed = drawn("false"), drawn("true")
    page.run("void hugs.player.set({ dimmed: false })")
    lost = 1 - dimmed[..., :3].sum((0, 2)) / seen[..., :3].sum((0, 2))
    third = len(lost) // 3
    assert lost[:third].mean() < 0.2 and lost[-third:].mean() > 0.5, "the wall's right half is invented"


@pytest.mark.slow
def test_a_ruler_measures_between_two_clicks_and_names_the_option_that_corrects_it(page):
    mark = "hugs.player.stage.world.children.some((one) => one.draw && one.visible)"
    page.run("void (hugs.player.set({ playing: false, show: 'both' }), hugs.facts.clip, hugs.player.home(3))")
    assert not page.run(mark), "nothing has been measured"
    page.run("document.getElementById('ruler').click()")
    wait(page, "!hugs.player.stage.busy")
    left, top, width, height = page.run(
        "(({ x, y, width, height }) => [x, y, width, height])(document.getElementById('canvas').getBoundingClientRect())"
    )
    places = [(left + share * width, top + 0.3 * height) for share in (0.4, 0.62)]
    for x, y in places:
        for kind in ("mousePressed", "mouseReleased"):
            page.ask("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, x=x, y=y)
    wait(page, "document.querySelector('#distance b').textContent.endsWith(' m')")
    assert page.run(mark)
    shown, option = page.run("[...document.getElementById('distance').children].map((part) => part.textContent)")
    eye, matrix = page.run(
        "(({ stage }) => [stage.eye.toArray(), stage.world.matrix.clone().invert().multiply(stage.camera.matrixWorld)"
        ".multiply(stage.camera.projectionMatrixInverse).toArray()])(hugs.player)"
    )
    clip_from_screen, ends = np.reshape(matrix, (4, 4)).T, []
    for x, y in places:
        there = clip_from_screen @ [2 * (x - left) / width - 1, 1 - 2 * (y - top) / height, 0, 1]
        way = there[:3] / there[3] - eye
        ends.append(np.array(eye) + way * (WALL - eye[2]) / way[2])
    assert float(shown.removesuffix(" m")) == pytest.approx(np.linalg.norm(ends[0] - ends[1]), rel=0.04)
    assert option == f"--scale {float(option.split()[1].split('=')[0]):.3f}=METRES"
    assert float(option.split()[1].split("=")[0]) == pytest.approx(float(shown.split()[0]) / 1.25, rel=0.01)
    page.run("document.getElementById('ruler').click()")
    assert page.run("document.getElementById('distance').hidden")


@pytest.mark.slow
def test_a_browser_without_webgl_says_so(folders, tmp_path):
    page = Page(tmp_path / "profile", (390, 844), ["--disable-gpu", "--disable-3d-apis"])
    try:
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        assert "lacks WebGL2" in page.run("document.getElementById('message').innerText")
    finally:
        page.close()


@pytest.mark.slow
def test_a_person_without_a_scene_is_shown(tmp_path):
    folders = exhibits.make(tmp_path / "made", scene=False)
    page = Page(tmp_path / "profile", (390, 844))
    try:
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        assert page.run("[document.body.className, hugs.player.show, document.getElementById('both').disabled]") == [
            "open",
            "person",
            True,
        ]
        assert page.said == []
    finally:
        page.close()


@pytest.mark.slow
def test_a_headset_is_put_on_and_taken_off(folders, tmp_path):
    page, stage = Page(tmp_path / "profile"), "hugs.player.stage"
    try:
        page.ask("Page.addScriptToEvaluateOnNewDocument", source=headset.DEVICE)
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        page.run("document.getElementById('headset').click()")
        wait(page, "window.session?.asked")
        state = f"[{stage}.renderer.xr.isPresenting, {stage}.spark.autoUpdate, {stage}.rig.position.z]"
        at = page.run(f"{stage}.controls.target.z") + 2
        assert page.run(state) == [True, True, pytest.approx(at)], "2 m before the person, who looks along z"
        page.run(f"{stage}.light.paint = () => {{ window.painted = true; }}")
        page.run("session.end()")
        wait(page, "window.painted")
        assert page.run(state) == [False, False, 0] and page.said == []
    finally:
        page.close()
