"""Files for other programs: what is written, which way up, and what is said about it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages import export
from stages.contract import Job, StageError
from stages.formats.exchange.glb import Glb
from stages.formats.exchange.ply import read_ply
from stages.formats.exchange.read import read_any_scene
from stages.formats.exchange.splats_glb import read_avatar_glb
from stages.formats.exchange.spz import read_spz
from stages.formats.ground import read_ground
from stages.formats.motions.bvh import read_bvh
from stages.formats.splats import read_avatar, read_scene, write_splats
from tests.made import judges
from tests.made.clothes import dress, some_clothes
from tests.made.meshes import coarse
from tests.made.said import any_holds


def made(clip, out, **settings):
    """Run the stage; what it said."""
    said: list[str] = []
    out.mkdir(exist_ok=True)
    settings = {"triangles": 500, "texture": 64} | settings
    needs = {name: clip[name] for name in ("frames", "sfm", "smpl", "train")}
    export.run(Job(out, emit=lambda e: said.append(e.get("text", ""))), export.Params(**settings), **needs)
    return said


@pytest.fixture(scope="module")
def clip(tiny, tmp_path_factory):
    """The tiny clip with colours that depend on the view, as a trained person with clothes has them."""
    train = tmp_path_factory.mktemp("export") / "train"
    train.mkdir()
    for path in tiny["train"].iterdir():
        (train / path.name).write_bytes(path.read_bytes())
    avatar, rng = read_avatar(train / "avatar.npz"), np.random.default_rng(0)
    more = {"shN": rng.normal(0, 0.1, (len(avatar), 3, 3)), "quats": rng.normal(size=(len(avatar), 4))}
    write_splats(train / "avatar.npz", dress(replace(avatar, **more, antialias=True), some_clothes(2)))
    return tiny | {"train": train}


@pytest.fixture(autouse=True, scope="module")
def quick():
    with coarse():
        yield


@pytest.fixture(scope="module")
def out(clip, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    folder.joinpath("said.txt").write_text("\n".join(made(clip, folder / "out")))
    return folder / "out"


def test_what_is_written_by_default(clip, out):
    wanted = (
        "avatar.glb avatar.npz avatar.ply avatar.spz ground.json motion.bvh scene.ply scene.spz viewer.html".split()
    )
    assert sorted(path.name for path in out.iterdir()) == wanted
    assert (out / "avatar.npz").read_bytes() == (clip["train"] / "avatar.npz").read_bytes()


def test_a_format_that_is_off_takes_no_work(clip, tmp_path, monkeypatch):
    def never(*_, **__):
        raise AssertionError("it runs")

    writers = "avatar_glb avatar_vrm splats_glb motion_bvh spz sog usd".split()
    others = [f"stages.formats.exchange.{name}.write_{name}" for name in writers]
    for one in ("stages.avatar.surface.mesh.surface_of", "stages.filming.clip_page.clip_page", *others):
        monkeypatch.setattr(one, never)
    monkeypatch.setattr(export, "_takes", never)
    made(clip, tmp_path / "out", formats=["ply"])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "avatar.npz",
        "avatar.ply",
        "ground.json",
        "scene.ply",
    ]


def test_in_viewers_who_take_y_as_down_person_and_scene_stand_upright(out):
    """The head is yellow: it has the smallest y of the turned person; the scene is the world with y down, as it was."""
    avatar = read_avatar(out / "avatar.npz")
    for path in (out / "avatar.ply", out / "avatar.spz"):
        found = read_any_scene(path)
        soles = avatar.means * [1, -1, -1] - found.means
        np.testing.assert_allclose(soles, np.full((len(avatar), 1), soles[0, 1]) * [0, 1, 0], atol=4e-4)
        assert abs(np.sort(-found.means[:, 1])[5]) < 0.03, "soles at height 0"
        yellow = np.flatnonzero((0.5 + 0.28209479 * found.sh0 > [0.8, 0.8, -1]).all(1))
        assert found.means[yellow, 1].max() < np.median(found.means[:, 1])
        turns = [Rotation.from_quat(one.quats, scalar_first=True) for one in (avatar, found)]
        half = Rotation.from_matrix(np.diag([1.0, -1, -1]))
        assert (turns[1].inv() * half * turns[0]).magnitude().max() < 0.01
        np.testing.assert_allclose(found.shN, avatar.shN * np.array([-1, -1, 1])[:, None], atol=5 / 128)
    assert read_spz(out / "avatar.spz").antialias


def test_a_vrm_with_the_words_of_the_user(clip, tmp_path):
    words = {"name": "../Ann/\\Bo", "authors": ["Ann"], "modification": "allowModification"}
    said = made(clip, tmp_path, formats=["vrm"], vrm=words)
    meta = Glb(tmp_path / "avatar.vrm").content["extensions"]["VRMC_vrm"]["meta"]
    assert {name: meta[name] for name in words} == words
    assert sorted(path.name for path in tmp_path.iterdir()) == ["avatar.npz", "avatar.vrm", "ground.json"]
    assert any("avatar.vrm" in line and "Ann" in line for line in said)
    assert any("2 bones" in line and "stand still" in line and "vrm" in line for line in said)


def test_spz_with_the_axes_of_its_paper_and_of_version_4(clip, out, tmp_path):
    said = made(clip, tmp_path, formats=["ply", "spz"], spz_axes="y_up", spz_version=4)
    assert [line.partition(":")[0] for line in said if "y up" in line or "y down" in line] == ["ply", "spz"]
    for name in ("avatar", "scene"):
        assert (tmp_path / f"{name}.spz").read_bytes()[:5] == b"NGSP\4"
        up, down = read_spz(tmp_path / f"{name}.spz"), read_spz(out / f"{name}.spz")
        np.testing.assert_allclose(up.means, down.means * [1, -1, -1], atol=3e-4)
    np.testing.assert_array_equal(read_ply(tmp_path / "avatar.ply").means, read_ply(out / "avatar.ply").means)


def test_the_scene_stays_as_it_is(clip, out):
    scene = read_scene(clip["train"] / "scene.npz")
    np.testing.assert_array_equal(read_ply(out / "scene.ply").means, scene.means)
    np.testing.assert_allclose(read_spz(out / "scene.spz").means, scene.means, atol=2e-4)


def test_the_mesh_stands_up_and_has_the_clips_motion(out):
    glb = Glb(out / "avatar.glb")
    accessors, content = glb.content["accessors"], glb.content
    (stand,) = (node for node in content["nodes"] if node["name"] == "stand")
    place = accessors[content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    low, high = place["min"][1] + stand["translation"][1], place["max"][1] + stand["translation"][1]
    assert abs(low) < 0.05 and 1.5 < high < 1.9
    names = [move["name"] for move in content["animations"]]
    assert names == ["clip", "jumping_jacks", "walk_in_place", "wave", "squats"]
    times = accessors[content["animations"][0]["samplers"][0]["input"]]
    assert times["count"] == 7 and times["min"] == [0] and times["max"][0] == pytest.approx(18 / 30)


def test_gaussians_on_the_skeleton_are_a_file_of_their_own(clip, tmp_path):
    said = made(clip, tmp_path, formats=["splats_glb"])
    rig = read_avatar_glb(tmp_path / "avatar_splats.glb")
    assert np.ptp(rig.means[:, 1]) > 1.2 and rig.means[:, 1].max() < 1
    assert not (tmp_path / "avatar.glb").exists()
    assert [line for line in said if "eight bones" in line]


@pytest.mark.parametrize(("setting", "value"), [("texture", 0), ("texture", 65536), ("triangles", 0)])
def test_a_mesh_of_impossible_size_is_refused_by_the_settings(setting, value):
    with pytest.raises(ValueError, match=setting):
        export.Params(**{setting: value})


def test_gaussians_that_nobody_sees_make_no_mesh_and_no_file(clip, tmp_path):
    train = shutil.copytree(clip["train"], tmp_path / "train")
    avatar = read_avatar(train / "avatar.npz")
    write_splats(train / "avatar.npz", replace(avatar, opacities=np.full(len(avatar), 0.05)))
    with pytest.raises(StageError, match="no mesh") as refused:
        made(clip | {"train": train}, tmp_path / "out", formats=["glb", "ply"])
    assert "[ply]" in refused.value.hint and not (tmp_path / "out" / "avatar.glb").exists()


def test_what_a_viewer_cannot_show_is_said_once(out):
    said = (out.parent / "said.txt").read_text()
    for words in ("clothes have 2 bones", "y down", "view-dependent", "500 triangles"):
        assert said.count(words) == 1, words


def test_only_formats_that_lack_something_are_said_to_lack_it(clip, tmp_path):
    """Page and glb hang clothes; page, .ply and .spz know of anti-aliasing."""
    for formats, clothes, antialias in (
        (["viewer"], None, None),
        (["spz"], "stand still in spz", None),
        (["ply", "splats_glb", "spz_motion"], "stand still in ply", "splats_glb has no mark"),
    ):
        said = made(clip, tmp_path / "-".join(formats), formats=formats)
        for wanted, about in ((clothes, "clothes have"), (antialias, "learned with anti-aliasing")):
            (line,) = [line for line in said if line.startswith(about)] or [None]
            assert line is None if wanted is None else wanted in line, formats


def test_the_same_result_makes_the_same_bytes(clip, out, tmp_path):
    made(clip, tmp_path)
    for path in out.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_person_only_has_no_scene_file(tiny_human, tmp_path):
    made(tiny_human, tmp_path)
    assert not list(tmp_path.glob("scene.*")) and (tmp_path / "avatar.glb").exists()


def test_a_motion_as_numbered_files(clip, tmp_path):
    said = made(clip, tmp_path, formats=["ply_motion", "spz_motion"], motion="clip")
    assert any_holds(said, "avatar_clip", "7 poses")
    for ending in ("ply", "spz"):
        files = sorted((tmp_path / f"avatar_clip_{ending}").iterdir())
        assert [path.name for path in files] == [f"frame{i:05d}.{ending}" for i in range(7)]
        first, last = (read_any_scene(path).means for path in (files[0], files[-1]))
        assert np.abs(first - last).max() > 0.2 and first[:, 1].min() < -1.4, "it moves, and its head is up"
        assert all(abs(read_any_scene(path).means[:, 1].max()) < 0.03 for path in files), "soles at height 0"
    names = ["avatar.npz", "avatar_clip_ply", "avatar_clip_spz", "ground.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_the_clips_motion_as_bvh_and_others_where_they_are_asked_for(clip, out, tmp_path):
    """The clip's 8 frames show the person in 7, a tenth of a second apart; the floor is at 0."""
    bvh = read_bvh(out / "motion.bvh")
    assert len(bvh) == 7 and bvh.fps == pytest.approx(10) and bvh.names[0] == "pelvis"
    assert 0.7 < bvh.places[0, 0, 1] < 1.2, "m: the pelvis over the floor"
    for motion, more in (("wave", ["wave"]), ("all", ["jumping_jacks", "squats", "walk_in_place", "wave"])):
        made(clip, tmp_path / motion, formats=["bvh"], motion=motion, names="unreal")
        files = sorted(path.name for path in (tmp_path / motion).glob("*.bvh"))
        assert files == ["motion.bvh", *(f"motion_{one}.bvh" for one in more)]
        assert len(read_bvh(tmp_path / motion / "motion_wave.bvh")) == 120
    assert "thigh_l" in read_bvh(tmp_path / "all" / "motion_squats.bvh").names


def test_all_motions_as_numbered_files(clip, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.avatar.motion.takes.SECONDS", 0.1)
    made(clip, tmp_path, formats=["spz_motion"], motion="all")
    counts = {path.name: len(list(path.iterdir())) for path in tmp_path.glob("*_spz")}
    made_ones = ("jumping_jacks", "walk_in_place", "wave", "squats")
    assert counts == {"avatar_clip_spz": 7} | {f"avatar_{name}_spz": 3 for name in made_ones}


def test_what_numbered_spz_files_clamp_is_said(clip, tmp_path):
    train = shutil.copytree(clip["train"], tmp_path / "train")
    avatar = read_avatar(train / "avatar.npz")
    avatar.sh0[:3] = 9
    write_splats(train / "avatar.npz", avatar)
    said = made(clip | {"train": train}, tmp_path / "out", formats=["spz_motion"])
    assert any_holds(said, "avatar_clip_spz", "3 Gaussians", "colours")


def test_in_usd_the_floor_of_the_scene_is_at_height_0(clip, tmp_path, monkeypatch):
    """The clip's floor is level, y down; the origin is below where the person stood, and z where they looked."""
    written = {}
    monkeypatch.setattr("stages.formats.exchange.usd.check_usd", lambda: None)
    monkeypatch.setattr("stages.formats.exchange.usd.write_usd", lambda path, *what: written.update({path.name: what}))
    made(clip, tmp_path, formats=["usd"])
    ground, scene = read_ground(clip["smpl"] / "ground.json"), read_scene(clip["train"] / "scene.npz")
    found = written["scene.usdc"][0]["scene"]
    np.testing.assert_allclose(found.means[:, 1], ground.point[1] - scene.means[:, 1], atol=1e-6)
    np.testing.assert_allclose(found.means[:, 2], (scene.means - ground.point) @ ground.ahead, atol=1e-6)
    avatar = written["avatar.usdc"][0]["avatar"]
    assert abs(np.sort(avatar.means[:, 1])[5]) < 0.03
    np.testing.assert_array_equal(avatar.quats, read_avatar(clip["train"] / "avatar.npz").quats)


def test_a_format_whose_package_is_missing_is_refused_before_anything_is_written(clip, tmp_path, monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr("stages.formats.exchange.usd.importlib.import_module", missing)
    for name, package in (("usd", "usd-core"), ("sog", "gaussforge")):
        with pytest.raises(StageError, match=package):
            made(clip, tmp_path / name, formats=["ply", name])
        assert not list((tmp_path / name).iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["avatar.ply", "avatar.spz", "scene.ply"])
def test_supersplats_converter_stands_them_upright(out, tmp_path, name):
    """Its .glb is y up."""
    program = judges.modules() / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    judges.node(program, "-q", out / name, tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    places = glb.array(glb.content["meshes"][0]["primitives"][0]["attributes"]["POSITION"], "<f4", 3)
    ours = read_any_scene(out / name).means
    assert len(places) == len(ours)
    np.testing.assert_allclose(np.sort(places[:, 1]), np.sort(-ours[:, 1]), atol=1e-5, err_msg="what we say is up, is")
