"""A clip of two people after training: every later stage shows, measures and writes both."""

import json
import re
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from stages import evaluate, export, render
from stages.avatar.body.face import face_vector
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.motion.gestures import fist
from stages.commands import report
from stages.commands.report import clip as of_clip
from stages.commands.report import results
from stages.contract import Job, StageError
from stages.filming.cast import cast
from stages.filming.clip_cast import completed, floor_under, load_cast, posed_as
from stages.filming.spec import Person
from stages.formats.body_model import read_body_model
from stages.formats.clip import load_people
from stages.formats.facts import Metrics, Seconds
from stages.formats.ground import read_ground
from stages.formats.hands_face import read_hands_face
from stages.formats.images import read_image
from stages.formats.people import folder_of
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar
from stages.formats.video import probe
from tests.made import company, tiny
from tests.made.devtools import Page
from tests.made.meshes import coarse
from tests.made.said import holds
from tests.made.tiny import make_avatar


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return company.make(tmp_path_factory.mktemp("company"))


def needs(clip, *names):
    return {name: clip[name] for name in names}


@pytest.fixture(scope="module")
def measured(clip, tmp_path_factory):
    """The folder of `evaluate`."""
    folder = tmp_path_factory.mktemp("evaluate")
    job = Job(folder, upstream=tiny.UPSTREAM)
    evaluate.run(job, evaluate.Params(fit_steps=0), **needs(clip, "sfm", "smpl", "train"))
    return folder


@pytest.fixture(scope="module")
def exported(clip, tmp_path_factory):
    """The folder of `export`."""
    folder = tmp_path_factory.mktemp("export")
    with coarse():
        small = export.Params(triangles=500, texture=64)
        export.run(Job(folder), small, **needs(clip, "frames", "sfm", "smpl", "train"))
    return folder


def test_each_frame_has_those_whom_it_shows(clip):
    clips, cast = load_cast(clip["sfm"], clip["smpl"], clip["train"], "cpu")
    assert [one.person for one in clips] == [1, 2]
    assert [len(cast.at(i).people) for i in (0, tiny.EMPTY)] == [2, 1]
    clips[0].body.confidence[1] = 0
    known = posed_as(clips[0], read_avatar(clip["train"] / "avatar.npz"), "cpu").known
    assert known.tolist() == [i not in (1, tiny.EMPTY) for i in range(len(known))], "where the fit trusts the pose"
    both = clips[0].mask(0) > 127
    assert (both == ((clips[0].own_mask(0) > 127) | (clips[1].own_mask(0) > 127))).mean() > 0.99


def test_fingers_are_in_each_frame_as_the_clip_shows_them(clip):
    """Of an avatar that has some; without, it stands in the same frames."""
    (one, _), avatar = load_people(clip["sfm"], clip["smpl"]), read_avatar(clip["train"] / "avatar.npz")
    turns = np.zeros((len(one.names), 2, 15, 3))
    turns[1] = fist()
    shown, gloved = (
        replace(one, body=replace(one.body, hands=turns)),
        attach(avatar, one.body_model, read_hands_face(one.body_model)),
    )
    rest, closed = (posed_as(shown, gloved, "cpu").splats(i).means for i in (0, 1))
    still = [posed_as(shown, avatar, "cpu").splats(i).means for i in (0, 1)]
    assert (rest - still[0]).norm(dim=1).max() < 1e-5 and (closed - still[1]).norm(dim=1).max() > 0.05


def test_the_face_is_in_each_frame_as_training_learned_it(clip):
    (one, _), avatar = load_people(clip["sfm"], clip["smpl"]), read_avatar(clip["train"] / "avatar.npz")
    faces = np.zeros((len(one.names), 52))
    faces[1] = face_vector({"jawOpen": 1.0})
    talks = replace(one, body=replace(one.body, face=faces))
    moving = attach(avatar, one.body_model, read_hands_face(one.body_model))
    off = [
        (posed_as(talks, moving, "cpu").splats(i).means - posed_as(one, moving, "cpu").splats(i).means).norm(dim=1)
        for i in (0, 1)
    ]
    assert off[0].max() == 0 and off[1].max() > 0.02
    assert (posed_as(talks, avatar, "cpu").splats(1).means == posed_as(one, avatar, "cpu").splats(1).means).all()


@pytest.mark.slow
def test_both_are_measured_drawn_together(measured):
    found = json.loads((measured / "metrics.json").read_bytes())
    second = found["people"]["2"]["heldout"]
    assert found["heldout"]["full"]["psnr"] > 45 and found["heldout"]["person_crop"]["psnr"] > 45
    assert second["person_crop"]["psnr"] > 45 and second["person_white"]["psnr"] > 25
    assert list((measured / "people" / "2" / "heldout").glob("*.png"))


@pytest.mark.slow
def test_what_export_says_of_one_of_them_names_them_and_the_rest_is_said_once(clip, tmp_path):
    said = []
    job = Job(tmp_path, emit=lambda event: said.append(event["text"]) if "text" in event else None)
    with coarse():
        small = export.Params(formats=["spz", "glb"], triangles=500, texture=64)
        export.run(job, small, **needs(clip, "frames", "sfm", "smpl", "train"))
    about = [text.partition(": ")[0] for text in said]
    assert about.count("person 1") == about.count("person 2") == 2
    assert [text for text in said if "y down" in text] == [said[-1]] and said[-1].startswith("spz: y down")


@pytest.mark.slow
def test_films_files_and_the_report_show_both(clip, measured, exported, tmp_path):
    folders = (
        clip | {"export": exported, "evaluate": measured} | {name: tmp_path / name for name in ("render", "report")}
    )
    for name in ("render", "report"):
        folders[name].mkdir()
    short = render.Params(turntable_frames=2, motion_seconds=0.1)
    render.run(Job(folders["render"]), short, **needs(clip, "sfm", "smpl", "train"))
    for name in ("turntable.mp4", "motion.mp4", "heldout.mp4", "people/2/turntable.mp4", "people/2/motion.mp4"):
        assert probe(folders["render"] / name).frames >= 1
    for name in (
        "avatar.npz",
        "avatar.glb",
        "scene.ply",
        "people/2/avatar.npz",
        "people/2/avatar.glb",
        "people/2/avatar.ply",
    ):
        assert (exported / name).is_file()
    assert not (exported / "people" / "2" / "scene.ply").exists()
    assert "person1/joints" in (exported / "viewer.html").read_text()
    before = ("frames", "sfm", "smpl", "survey", "train", "export", "render", "evaluate")
    rows = tuple(report.Row(name=name, state="done", folder=str(folders[name])) for name in before)
    state = report.State(clip="two.mp4", pipeline="default", stages=rows, over=True)
    assert report.write(folders["report"], state, {}) == []
    text = (folders["report"] / report.PAGE).read_text()
    assert holds(text, "person 2: frame 000000") and ", person 2<" in text
    assert len(re.findall(r">person 2: [^<]*", text)) > 2 and re.search(r"PSNR, [^<]*, person 1<", text)


def test_the_report_says_whose_bodies_and_numbers_it_shows(clip):
    figures = of_clip.body(clip["sfm"], clip["smpl"])["overlays"]
    whose = [one.caption.partition(": body")[0] for one in figures if "frame 000000" in one.caption]
    assert whose == [f"person {k}: frame 000000" for k in (1, 2)]
    scores = {region: {"psnr": 30.0} for region in ("full", "person_crop", "person_white")}
    known = {"heldout": scores, "seconds": Seconds(total=1), "peak_memory_bytes": 1}
    one, two = (Metrics.model_construct(**known, people=others) for others in ({}, {"2": {"heldout": scores}}))
    plain, named = ([name for name, _ in results._headline(known)[:2]] for known in (one, two))
    assert named == [plain[0], f"{plain[1]}, person 1"] and plain[0].startswith("PSNR") and plain[0] != plain[1]


@pytest.mark.slow
def test_the_page_shows_each_in_the_frames_that_show_them(exported, tmp_path):
    """The first is not in one of them; in every other motion of the page they are there all the time."""
    shown = "hugs.player.people.map(({ mesh }) => mesh.visible)"
    with closing(Page(tmp_path / "profile")) as page:
        page.open(exported / "viewer.html", "document.body?.matches('.open, .stuck')")
        seen = {}
        for motion, frame, only in ((0, 0, "both"), (0, tiny.EMPTY, "both"), (1, tiny.EMPTY, "both"), (0, 0, "scene")):
            wanted = {"motion": motion, "frame": frame, "camera": 0, "only": only}
            page.run(f"hugs.show({json.dumps(wanted)})")
            seen[motion, frame, only] = page.run(shown)
        assert page.said == []
    assert list(seen.values()) == [[True, True], [False, True], [True, True], [False, False]]


def test_in_a_film_of_their_own_scene_each_is_where_they_were(clip):
    run, ground = clip["train"].parent, read_ground(clip["smpl"] / "ground.json")
    first, second = (cast(Person(avatar=run, who=who), "a", ground, 10.0, "cpu") for who in (1, 2))
    apart = second.joints([0])[0, 0] - first.joints([0])[0, 0]
    bodies = [read_poses(clip["train"] / place / "body.npz") for place in (".", "people/2")]
    away = bodies[1].transl[0] - bodies[0].transl[0]
    np.testing.assert_allclose(apart[[0, 2]], away[[0, 2]], atol=0.02)
    with pytest.raises(StageError, match=r"\bno person 3\b"):
        cast(Person(avatar=run, who=3), "a", ground, 10.0, "cpu")
    alone = clip["train"] / "avatar.npz"
    with pytest.raises(StageError, match=r"avatar\.npz.*\b2\b"):
        cast(Person(avatar=alone, who=2, motion="wave"), "a", ground, 10.0, "cpu")


def test_in_a_made_motion_each_stands_where_they_were(clip):
    clips, _ = load_cast(clip["sfm"], clip["smpl"], clip["train"], "cpu")
    rigs = [rig_of(read_avatar(folder_of(clip["train"], one.person) / "avatar.npz")) for one in clips]
    ground = read_ground(clip["smpl"] / "ground.json")
    first, second = (floor_under(one, rig, ground) for one, rig in zip(clips, rigs, strict=True))
    assert first is ground
    hips = clips[1].body.transl[len(tiny.NAMES) // 2] + rigs[1].joints[0]
    np.testing.assert_allclose(np.cross(hips - second.point, ground.up), 0, atol=1e-6)
    assert abs((second.point - ground.point) @ ground.up) < 1e-6


def test_the_picture_of_both_is_the_frame(clip):
    clips, cast = load_cast(clip["sfm"], clip["smpl"], clip["train"], "cpu")
    strip = next(render._beside_truth(clips[0], cast, [tiny.EMPTY], {}))
    assert np.abs(strip[:, : tiny.WIDTH].astype(int) - strip[:, tiny.WIDTH :]).mean() < 1.5
    assert (strip[:, : tiny.WIDTH] == read_image(clip["sfm"] / "images" / f"{tiny.NAMES[tiny.EMPTY]}.png")).all()


def test_the_shadow_of_each_is_that_of_their_own_body(clip):
    first, _ = load_people(clip["sfm"], clip["smpl"], clip["train"])
    avatar = read_avatar(clip["train"] / "avatar.npz")
    slim, stout = (completed(replace(avatar, betas=betas), first.body_model).casters[0] for betas in
                   (avatar.betas, np.array([2.0, -3.0] + [0.0] * 8)))  # fmt: skip
    assert np.abs(slim - stout).max() > 0.01
    held = replace(avatar, casters=(np.ones((24, 3)), np.zeros((24, 3, 3))), normals=np.ones((len(avatar), 3)))
    assert completed(held, first.body_model) is held, "as the file has it"
    _, cast = load_cast(clip["sfm"], clip["smpl"], clip["train"], "cpu")
    for who in cast.people:
        np.testing.assert_allclose(who.avatar.casters.middles, slim, atol=1e-6)


def test_where_a_file_does_not_say_it_gaussians_face_as_the_skin_does_however_they_are_turned():
    model = read_body_model()
    avatar = make_avatar(model, every=40)
    turned = replace(avatar, quats=np.random.default_rng(0).normal(size=avatar.quats.shape))
    skin = load_avatar(replace(avatar, normals=completed(turned, model).normals)).resting.normals
    vertices, _ = Body(model).rest(torch.zeros(10))
    wanted = vertex_normals(vertices, torch.as_tensor(model.faces).long())[::40]
    assert (normalize(skin, dim=1) * wanted).sum(1).median() > 0.97
    unknown = completed(turned, None).normals
    assert np.median((unknown * completed(turned, model).normals).sum(1)) > 0.99, "the free body stands in"
