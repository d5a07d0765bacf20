"""Fingers and faces on the page: as we pose and draw them, moved by sliders, brought by files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.face import face_vector
from stages.avatar.drawing.avatar import bones_of, fingers_of, gloved, load_avatar, mimed
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.drawing.rig import rig_of
from stages.avatar.motion.gestures import fist
from stages.avatar.motion.moves import clip_move, made_move
from stages.avatar.motion.placing import Soles
from stages.avatar.rasterize import Camera
from stages.filming.motions import Manner, from_file
from stages.formats import viewer
from stages.formats.clip import load_clip
from stages.formats.ground import read_ground
from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_fingers import map_fingers
from stages.formats.motions.face_csv import read_face
from stages.formats.splats import read_avatar
from stages.formats.trained import read_trained
from stages.gestures import FACE_NAMES
from stages.records import JOINT_NAMES, JOINTS
from tests.made import exhibits, tiny
from tests.made.devtools import Page
from tests.made.fingers import FAMILIES, renamed, skeleton, write_waving
from tests.made.learned import draw, load_learned
from tests.made.viewed import drop, message, picture, psnr, wait

NAMES = "In the clip|Jumping jacks|Walk in place|Wave|Squats|Count to five|Say a sentence".split("|")
JAW, CLOSER = FACE_NAMES.index("jawOpen"), 4  # times the focal length and size of the clip's pictures
POSED = "hugs.player.people[0].take(hugs.player.bent(hugs.player.motion.at(hugs.player.position)))"
CAPTURES = {
    "a phone": [
        ",".join(["Timecode", "BlendShapeCount", *(name[0].upper() + name[1:] for name in FACE_NAMES), "HeadYaw"]),
        *(f"10:59:59:{i:02d}.250,61,{','.join([str(i / 50)] * 52)},-0.4" for i in range(50)),
    ],
    "some shapes": ["jawOpen, time", "0.1,5", "1.2,5.5", "-0.1,7"],
    "quotes": ['"time_ms","mouthSmileLeft"', '100,"0.25"', "", '140,"0.5"'],
    "no times": ["tongueOut", "0", "1"],
}
BAD = {
    "time,smile\n0,1": "no face capture",
    "time,jawOpen": "no face capture",
    "time,jawOpen\n0,0.5\n1,open": "row 3 has no number for jawopen",
    "time,jawOpen\n0,0.5\n1,": "row 3 has no number for jawopen",
    "time,jawOpen\n0,0.5\n0,0.5": "do not rise in row 3",
    "time,jawOpen\n0,50\n1,0.5": "coefficients of 0 to 1: 50",
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return exhibits.make(tmp_path_factory.mktemp("gestured") / "made", gestured=True)


@pytest.fixture(scope="module")
def record(folders):
    return read_avatar(folders["train"] / "avatar.npz")


@pytest.fixture(scope="module")
def page(folders, tmp_path_factory):
    shown = Page(tmp_path_factory.mktemp("profile"))
    shown.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
    yield shown
    shown.close()


@pytest.fixture
def still(page):
    """The page with nothing on top of a motion that stands still."""
    page.run("void (hugs.player.reset(), hugs.player.set({ motion: hugs.player.motions[0], playing: false }))")
    return page


@pytest.fixture(scope="module")
def moves(folders, record):
    clip = load_clip(folders["sfm"], folders["smpl"], folders["train"])
    ground, soles = read_ground(folders["smpl"] / "ground.json"), Soles.of_rig(rig_of(record))
    made = [made_move(name, ground, soles) for name in ("count_to_five", "say_a_sentence")]
    own = clip_move(clip.body, np.arange(len(clip.body)) / 10)
    return {move.name: move for move in [own, *made]}


def places(page: Page) -> np.ndarray:
    """The Gaussians' centres [N,3] at rest, with the face that the page has now."""
    page.run(f"void {POSED}")
    return np.reshape(
        page.run("(({ count, centers }) => Array.from(centers.subarray(0, 4 * count)))(hugs.player.people[0].body)"),
        (-1, 4),
    )[:, :3]


def slide(page: Page, shapes: str, percent: int) -> None:
    page.run(
        f"(() => {{ const slider = document.querySelector('[data-shapes^={shapes}]'); slider.value = {percent};"
        "slider.dispatchEvent(new Event('input')); })()"
    )


def test_a_page_with_hands_and_a_face_lists_their_motions_and_one_without_has_nothing_of_them(folders, tmp_path):
    shown, found = exhibits.run(folders), []
    (figure,) = shown.figures
    plain = replace(figure, rig=replace(figure.rig, fingers=None), weights=figure.weights[:, :-30], face=None)
    for one in (figure, plain):
        viewer.write_viewer(tmp_path / "a.html", replace(shown, figures=[one]))
        found.append((tmp_path / "a.html").read_text(encoding="utf-8"))
    parts = ("data-shapes", ".csv", '"person0/shares"', '"person0/moves"', '/hands"', '/face"')
    facts = [html[html.index('id="facts">') :] for html in found]
    outside = [html[: html.index('id="modules">')] for html in found]
    assert all(part in outside[0] and part not in outside[1] for part in parts)
    assert all(json.dumps(name) in facts[0] for name in NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["In the clip", "Count to five", "Say a sentence"])
def test_a_frame_with_bent_fingers_and_an_open_jaw_is_as_we_draw_it(still, folders, moves, name):
    move, camera = moves[name], CLOSER * tiny.FOCAL
    frame = 2 if move.face is None else int(move.face[:, JAW].argmax())
    clip = load_clip(folders["sfm"], folders["smpl"], folders["train"])
    learned, size = load_learned(*read_trained(folders["train"])), (CLOSER * clip.width, CLOSER * clip.height)
    K = np.diag([CLOSER, CLOSER, 1]) @ clip.Ks[3]
    pose = move.rotvecs[frame, :3], move.rotvecs[frame, 3:], move.steps[frame]
    gestures = {"hands": move.hands[frame], "face": None if move.face is None else move.face[frame]}
    view = Camera.of(clip.viewmats[3], K, *size)
    ours, stiff = (draw(learned.person(pose, **told), None, view, 1.0) for told in (gestures, {}))
    lens = {"view": clip.viewmats[3].ravel().tolist(), "fx": camera, "fy": camera, "cx": K[0, 2], "cy": K[1, 2]}
    wanted = {"motion": name, "frame": frame, "only": "person", "background": 0xFFFFFF}
    lens |= {"width": size[0], "height": size[1]}
    theirs = picture(still.run(f"hugs.show({json.dumps(wanted | {'camera': lens})})"))
    rows, columns = np.nonzero(ours[1] > 0.1)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    near, far = (psnr(theirs[box], to_uint8(one[0])[box]) for one in (ours, stiff))
    assert near >= 50 and far < near - 20


@pytest.mark.slow
@pytest.mark.parametrize(("name", "frame"), [("In the clip", 5), ("Count to five", 60), ("Wave", 9)])
def test_bones_of_fingers_stand_where_ours_do(still, record, moves, name, frame):
    """Those of a motion without fingers lie as in the avatar."""
    baked = gloved(load_avatar(record))
    hands = moves[name].hands[frame] if name in moves else record.fingers.shape
    found = still.run(
        f"(() => {{ const {{ people: [person], motions }} = hugs.player, pose = motions[{NAMES.index(name)}].at({frame});"
        "person.take(pose); return { rows: Array.from(person.skin.rows), quats: pose.quats.slice(0, 24) }; })()"
    )
    turns = Rotation.from_quat(found["quats"]).as_rotvec().ravel()
    told = (torch.as_tensor(part).float() for part in (turns[:3], turns[3:], hands))
    np.testing.assert_allclose(np.reshape(found["rows"], (-1, 3, 4)), bones_of(baked, *told)[:, :3], atol=3e-4)


@pytest.mark.slow
def test_a_shape_moves_the_gaussians_that_it_moves_here(still, record, moves):
    baked, said = load_avatar(record), moves["Say a sentence"]
    rest = places(still)
    for frame in (25, 33, 110):
        still.run(f"void hugs.player.set({{ motion: hugs.player.motions[6], position: {frame} }})")
        own = (mimed(baked, torch.as_tensor(said.face[frame]).float()).means - baked.resting.means).numpy()
        np.testing.assert_allclose(places(still) - rest, own, atol=4e-4)
        assert np.abs(own).max() > 4e-3
    still.run("void hugs.player.set({ motion: hugs.player.motions[1] })")
    np.testing.assert_array_equal(places(still), rest)


@pytest.mark.slow
def test_sliders_open_the_jaw_and_close_the_fist_on_top_of_the_motion(still, record):
    baked, rest = load_avatar(record), places(still)
    bones = np.reshape(still.run(f"({POSED}, Array.from(hugs.player.people[0].skin.rows))"), (-1, 3, 4))
    slide(still, "jawOpen", 60)
    own = (mimed(baked, torch.as_tensor(face_vector({"jawOpen": 0.6})).float()).means - baked.resting.means).numpy()
    np.testing.assert_allclose(places(still) - rest, own, atol=2e-4)
    slide(still, "fist", 100)
    closed = np.reshape(still.run(f"({POSED}, Array.from(hugs.player.people[0].skin.rows))"), (-1, 3, 4))
    limbs = torch.eye(4).repeat(JOINTS, 1, 1)
    limbs[:, :3] = torch.as_tensor(bones[:JOINTS])
    told = fingers_of(baked, torch.as_tensor(fist()).float(), limbs.float())
    np.testing.assert_allclose(closed[-30:], told[:, :3], atol=3e-4)
    np.testing.assert_array_equal(closed[:-30], bones[:-30])
    assert still.run("document.getElementById('bend').getAttribute('aria-pressed')") == "true"
    still.run("document.getElementById('unbend').click()")
    np.testing.assert_array_equal(places(still), rest)
    values = "[...document.querySelectorAll('[data-shapes]')].map(({ value }) => Number(value))"
    assert still.run(values) == [0] * (len(viewer.SLIDERS) + 1)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["mixamo", "vrm", "unreal", "smpl", "Rokoko", "Rigify"])
def test_a_bvh_moves_fingers_as_animate_does(page, record, tmp_path, family):
    known = family if family.islower() else "mixamo"
    path = write_waving(tmp_path / "waving.bvh", record, known)
    if known != family:
        path.write_text(renamed(path.read_text(), family))
    rig = rig_of(record)
    ours, facts = from_file(path, Manner(25.0), Soles.of_rig(rig), rig.parents.tolist(), fingers=record.fingers)
    assert any("30 finger bones" in fact for fact in facts)
    found = page.run(
        f"(() => {{ const {{ hands, rotvecs }} = hugs.perform({json.dumps(path.read_text())});"
        "return { hands: Array.from(hands), rotvecs: Array.from(rotvecs) }; })()"
    )
    own = Rotation.from_rotvec(ours.hands.reshape(-1, 3))
    theirs = Rotation.from_rotvec(np.reshape(found["hands"], (-1, 3)))
    assert np.degrees((own.inv() * theirs).magnitude()).max() < 0.02 and np.degrees(own.magnitude()).max() > 40
    body = Rotation.from_rotvec(np.concatenate([ours.global_orient, ours.body_pose], 1).reshape(-1, 3))
    assert (
        np.degrees((body.inv() * Rotation.from_rotvec(np.reshape(found["rotvecs"], (-1, 3)))).magnitude()).max() < 0.02
    )


@pytest.mark.slow
def test_a_dropped_bvh_is_played_with_its_fingers(still, record, tmp_path):
    text = write_waving(tmp_path / "waving.bvh", record, "mixamo").read_text()
    drop(still, "waving.bvh", text)
    wait(still, "hugs.player.motion.name === 'waving'")
    found = still.run(
        f"[hugs.player.motion.frame(7, 0).quats.slice(24), Array.from(hugs.perform({json.dumps(text)}).hands)]"
    )
    told = np.reshape(found[1], (-1, 30, 3))[7]
    np.testing.assert_allclose(Rotation.from_quat(found[0]).as_rotvec(), told, atol=1e-5)


@pytest.mark.slow
def test_a_body_without_fingers_leaves_those_of_a_file_out_and_says_so(page, record, tmp_path):
    text = json.dumps(write_waving(tmp_path / "waving.bvh", record, "mixamo").read_text())
    bare = "const { joints, parents, soles } = hugs.player.people[0]"
    found = page.run(
        f"import('hugs/dropped').then((it) => {{ {bare}; return it.performed({text}, {{ joints, parents, soles }}).said; }})"
    )
    assert found == "fingers left out: this avatar has none"


@pytest.mark.slow
def test_a_finger_that_turns_too_far_follows_the_bone_above_as_animate_has_it(page, record, tmp_path):
    path, rig = write_waving(tmp_path / "waving.bvh", record, "mixamo"), rig_of(record)
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    names = [line.split()[-1] for line in lines if "JOINT" in line]
    column = 6 + 3 * names.index("mixamorig:LeftHandIndex2")
    for i in range(first + 1, len(lines)):
        row = lines[i].split()
        row[column] = "170"
        lines[i] = " ".join(row)
    path.write_text("\n".join(lines) + "\n")
    ours, facts = from_file(path, Manner(25.0), Soles.of_rig(rig), rig.parents.tolist(), fingers=record.fingers)
    found = page.run(
        f"(() => {{ const {{ hands, said }} = hugs.perform({json.dumps(path.read_text())});"
        "return { hands: Array.from(hands), said }; })()"
    )
    assert found["said"] == "2 finger bones left out" and any(fact.startswith("2 of them turn") for fact in facts)
    np.testing.assert_allclose(np.reshape(found["hands"], (-1, 2, 15, 3)), ours.hands, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_fingers_of_every_family_are_found_by_name(page, family):
    names, parents = skeleton(family)
    limbs = {JOINT_NAMES.index("left_wrist"): 1, JOINT_NAMES.index("right_wrist"): 2}
    count = len(names)
    bvh = Bvh(tuple(names), np.array(parents), np.zeros((1, count, 3)), np.zeros((1, count, 3, 3)), 30.0)
    told = json.dumps({"names": names, "parents": parents})
    found = page.run(f"import('hugs/fingers').then((it) => [...it.mapFingers({told}, {json.dumps(limbs)})])")
    assert {bone: tuple(ends) for bone, ends in found} == map_fingers(bvh, limbs) != {}


@pytest.mark.slow
def test_the_page_has_the_shapes_in_our_order(page):
    assert page.run("import('hugs/face').then((it) => it.FACE_NAMES)") == list(FACE_NAMES)
    assert {shape for shapes in viewer.SLIDERS.values() for shape in shapes.split()} <= set(FACE_NAMES)


@pytest.mark.slow
def test_a_face_of_more_shapes_moves_and_takes_fewer_and_more_coefficients(page):
    """One Gaussian at 0, which shape 53 lifts and the first moves aside; the avatar has 54 shapes."""
    moves = np.zeros((3, 54))
    moves[1, 52], moves[0, 0] = 0.01, 0.02
    code = f"""import('hugs/face').then(({{ Face }}) => {{
      const told = [], body = {{ means: [0, 0, 0], place: (row, ...at) => told.push(at), send: () => 0 }};
      const face = new Face(body, {{ mien: [0], moves: {moves.ravel().tolist()} }});
      for (const one of [[1], Array(54).fill(0).fill(-2, 52), Array(60).fill(1)]) face.take(one);
      return told;
    }})"""
    np.testing.assert_allclose(page.run(code), [[0.02, 0, 0], [0, -0.02, 0], [0.02, 0.01, 0]], atol=1e-7)
    code = f"""import('hugs/motion').then(({{ Motion }}) => new Motion('a', 30, [{{ rotvecs: new Float32Array(144),
      steps: new Float32Array(6), face: new Float32Array({[0.0] * 53 + [1.0] + [0.0] * 53 + [3.0]}) }}]).at(0.5).face)"""
    assert page.run(code) == [*[0] * 53, 2]
    bent = "hugs.player.bent({ quats: [], face: [...Array(52).fill(0.5), -2] }).face"
    assert page.run(bent) == [*[0.5] * 52, -2]


@pytest.mark.slow
@pytest.mark.parametrize("kind", CAPTURES)
def test_a_face_capture_is_read_as_animate_reads_it(page, tmp_path, kind):
    text = "\n".join(CAPTURES[kind])
    (tmp_path / "take.csv").write_text(text)
    own = read_face(tmp_path / "take.csv")
    found = page.run(f"(({{ times, face, said }}) => [times, face, said])(hugs.capture({json.dumps(text)}))")
    np.testing.assert_allclose(found[0], own.times, atol=1e-9)
    np.testing.assert_allclose(found[1], own.face)
    assert found[2] == list(own.notes)


@pytest.mark.slow
def test_a_bad_capture_is_refused_in_words(still):
    for text, said in BAD.items():
        drop(still, "take.csv", text)
        message(still, said)
    assert still.run("hugs.player.capture") is None


@pytest.mark.slow
def test_a_dropped_face_plays_at_its_own_rate_over_the_motion_and_goes_on_where_that_begins_again(still):
    rows = [f"{i / 20},{0.5 + 0.5 * np.sin(i / 9):.4f}" for i in range(201)]  # 10 s; the motion takes 4 s
    still.run("void hugs.player.set({ motion: hugs.player.motions[6], playing: false })")
    drop(still, "take.csv", "\n".join(["time,jawOpen", *rows]))
    wait(still, "hugs.player.capture !== null")
    message(still, "1 of 52 shapes")
    assert still.run("hugs.player.playing") is True
    shown = "hugs.player.bent(hugs.player.motion.at(hugs.player.position)).face"
    for position, laps in ((60, 0), (91.5, 1)):
        still.run(f"void (hugs.player.set({{ playing: false, position: {position} }}), hugs.player.laps = {laps})")
        seconds = (laps * 120 + position) / 30
        wanted = np.interp(seconds, np.arange(201) / 20, [float(row.split(",")[1]) for row in rows])
        face = still.run(shown)
        assert face.pop(JAW) == pytest.approx(wanted, abs=1e-6) and not any(face), "the motion's face is gone"
    still.run("void hugs.player.set({ position: 119.9, speed: 2, playing: true })")
    wait(still, "hugs.player.laps === 1 && hugs.player.position < 119")
    still.run("document.getElementById('unbend').click()")
    assert still.run("hugs.player.capture") is None


@pytest.mark.slow
def test_three_hundred_rows_of_a_face_are_posed_in_far_less_than_ten_seconds(still):
    rows = np.random.default_rng(0).uniform(size=(300, 52)).round(3)
    text = "\n".join(
        [",".join(["time", *FACE_NAMES]), *(",".join(map(str, [i / 30, *row])) for i, row in enumerate(rows))]
    )
    seconds = still.run(
        f"(() => {{ const {{ player }} = hugs, [person] = player.people; player.capture = hugs.capture({json.dumps(text)});"
        "const begun = performance.now(); for (let i = 0; i < 300; i++) { player.position = i;"
        "person.take(player.bent(player.motion.frame(0, 0))); }"
        "return (performance.now() - begun) / 1000; })()"
    )
    assert seconds < 5
