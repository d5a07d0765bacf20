"""`hugs animate`, which draws through the stage compose: where people stand, where they look, what is said."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from stages import export
from stages.avatar.motion.formulas import MOTIONS
from stages.commands import compose
from stages.contract import Job, StageError
from stages.filming.setting import load_setting
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.clip import load_clip
from stages.formats.exchange.ply import write_ply
from stages.formats.images import read_pixels
from stages.formats.people import folder_of
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.formats.video import decode
from stages.records import Cameras
from tests.made import bvh as bvh_made
from tests.made import finished
from tests.made.command import hugs_here
from tests.made.said import holds
from tests.made.tiny import HEIGHT, WIDTH, WORLD_FROM_SFM, colour_of

RED_SIDE, BLUE_SIDE, ARM, HEAD = range(4)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A working folder with a clip that looks finished, and motions beside it."""
    folder = tmp_path_factory.mktemp("animate")
    finished.make(folder)
    orient, pose, transl = (t.numpy().astype(float) for t in MOTIONS["wave"](2.0, 25))
    turn = Rotation.from_euler("x", 90, degrees=True)  # AMASS: z up; and turned from where the person looks
    turned = (turn * Rotation.from_euler("y", 70, degrees=True) * Rotation.from_rotvec(orient)).as_rotvec()
    poses = np.concatenate([turned, pose, np.zeros((50, 84))], 1)
    np.savez(folder / "amass.npz", poses=poses, trans=turn.apply(transl) + [4, 5, 6], mocap_framerate=25.0)
    joints = (m := read_body_model()).J_regressor.astype(float) @ m.v_template
    local = bvh_made.matrices(orient, pose)
    bvh_made.write_bvh(folder / "wave.bvh", joints * 1.4, local, transl, bvh_made.a_pose(), fps=25)
    return folder


@pytest.fixture
def hugs(trained, monkeypatch, capsys):
    """Runs `hugs animate clip.mp4 ...`, or another command, in this process; its stdout and stderr."""

    def run(*args, code=0, command="animate", source=("clip.mp4",)):
        return hugs_here(trained, monkeypatch, capsys, command, *source, *args, code=code)

    return run


def test_files_without_a_mark_for_antialiasing_are_named(trained, monkeypatch):
    """A .glb holds Gaussians only where there is a scene."""
    monkeypatch.chdir(trained)
    avatar, said = read_avatar(Path("work/clip/default/train/avatar.npz")), []
    job = Job(trained, emit=lambda event: said.append(event.get("text", "")))
    for antialias, named in ((True, "a.usdc"), (False, None)):
        write_splats(trained / "marked.npz", replace(avatar, antialias=antialias))
        person = {"avatar": trained / "marked.npz", "motion": "wave"}
        given = compose.Params(scene=None, people=[person], out={"glb": "a.glb", "usd": "a.usdc"})
        said.clear()
        compose._cast(job, given, load_setting(given, "cpu"))
        assert [line for line in said if "anti-aliasing" in line and holds(line, named)] == said[: bool(named)]


def film(path):
    return np.stack([image for _, _, image in decode(path)])


def middle(found):
    return np.argwhere(found).mean(0)  # row, column


@pytest.mark.parametrize("motion", ["amass.npz", "wave.bvh"])
def test_the_person_waves_where_it_stood(trained, hugs, motion):
    out, err = hugs(motion, "--fps", "4", "--only", "human", "--out", f"films/{motion}.mp4")
    assert out == f"films/{motion}.mp4\n"
    about, made = err.splitlines()
    assert holds(about, motion, "50 frames", "2.0 s", "25 fps") and holds(
        about, *(("fingers", "z is up") if motion == "amass.npz" else ("22 of 24 joints", "y is up"))
    )
    assert holds(made, "8 frames", "2.0 s", "4 fps")
    frames = film(trained / out.strip())
    assert frames.shape == (8, HEIGHT, WIDTH, 3) and (frames[:, :8, :8] > 245).all()
    clip = load_clip(*(trained / "work/clip/default" / name for name in ("sfm", "smpl")))
    truth = colour_of(clip.images(4))
    seen = [colour_of(frame) for frame in frames]
    assert middle(seen[0] == HEAD) == pytest.approx(middle(truth == HEAD), abs=3)
    assert np.argwhere(seen[0] >= 0)[:, 0].max() == pytest.approx(np.argwhere(truth >= 0)[:, 0].max(), abs=3), "feet"
    assert (seen[0] == RED_SIDE).sum() > 2 * (seen[0] == BLUE_SIDE).sum(), "it looks where it looked"
    hand = [
        np.argwhere((s >= 0) & (s != HEAD) & (np.arange(WIDTH) < middle(s == HEAD)[1] - 6))[:, 0].min() for s in seen
    ]
    assert hand[3] < hand[0] - 10, "the right hand, on our left, goes up"
    assert abs(middle(seen[3] == ARM)[0] - middle(seen[0] == ARM)[0]) < 3, "the left one stays down"


def test_cameras_of_ones_own_and_the_scene(trained, hugs):
    clip = load_clip(*(trained / "work/clip/default" / name for name in ("sfm", "smpl")))
    K = clip.Ks[:1] * [[[0.5], [0.5], [1]]]
    names = ("a", "b")
    write_cameras(trained / "one.npz", Cameras(names[:1], clip.viewmats[:1], K, WIDTH // 2, HEIGHT // 2))
    write_cameras(trained / "two.npz", Cameras(names, clip.viewmats[:2], np.tile(K, (2, 1, 1)), 48, 64))
    hugs("amass.npz", "--fps", "1", "--camera", "one.npz", "--out", "one.mp4")
    frames = film(trained / "one.mp4")
    assert frames.shape == (3, HEIGHT // 2, WIDTH // 2, 3) and frames[:, :4, :4].max() < 140, "a wall, not white"
    _, err = hugs("amass.npz", "--fps", "1", "--camera", "two.npz", code=1)
    assert holds(err, "error", "2 cameras", "two.npz", "3 pictures")


@pytest.mark.parametrize(
    "motion,args,code,problem,hint",
    [
        ("none.bvh", (), 2, ("none.bvh",), "path"),
        ("clip.mp4", (), 1, ("clip.mp4", "motion"), ".bvh"),
        ("amass.npz", ("--only", "scene"), 2, ("scene",), "--only human"),
        ("amass.npz", ("--out", "m.avi"), 2, ("m.avi", ".mp4"), "--out motion.mp4"),
        ("amass.npz", ("--pipeline", "draft"), 2, ("train", "clip.mp4", "draft"), "hugs run clip.mp4"),
        ("lying.npz", (), 1, ("up", "lying.npz"), "--up"),
        ("flat.bvh", (), 1, ("flat.bvh", "bones"), "BVH"),
    ],
)
def test_what_cannot_be_done_is_refused_in_our_words(trained, hugs, motion, args, code, problem, hint):
    np.savez(trained / "lying.npz", poses=np.tile([0, 0, np.pi / 2] + [0] * 69, (2, 1)), trans=np.zeros((2, 3)))
    text = (trained / "wave.bvh").read_text().splitlines()
    knee = next(i for i, line in enumerate(text) if "JOINT LeftLeg" in line)
    (trained / "flat.bvh").write_text("\n".join([*text[: knee + 2], "OFFSET 0 0 0", *text[knee + 3 :]]))
    _, err = hugs(motion, *args, code=code)
    first, *rest = err.splitlines()
    assert holds(first, "error", *problem) and "Traceback" not in err
    assert rest[-2] == "" and holds(rest[-1], "hint", hint)


def test_a_motion_that_does_not_say_how_fast_or_which_way(trained, hugs):
    poses = np.tile([0, 0, np.pi / 2] + [0] * 69, (11, 1))
    np.savez(trained / "plain.npz", poses=poses, trans=np.zeros((11, 3)))
    args = ("--fps", "5", "--only", "human", "--out", "p.mp4", "--up", "y")
    assert holds(hugs("plain.npz", *args)[1], "11 frames", "0.3 s", "30 fps", "--motion-fps")
    assert holds(hugs("plain.npz", *args, "--motion-fps", "10")[1].splitlines()[-1], "6 frames", "1.2 s", "5 fps")
    assert Path(trained / "p.mp4").stat().st_size > 500


FAST = ("--fps", "1", "--only", "human")


@pytest.mark.slow
def test_an_animation_is_named_after_clip_and_motion_and_may_be_made_again(trained, hugs):
    assert hugs("amass.npz", *FAST)[0] == "clip-amass.mp4\n"
    first = (trained / "clip-amass.mp4").read_bytes()
    assert hugs("amass.npz", *FAST, "--fps", "2")[0] == "clip-amass.mp4\n"
    edited = (trained / "clip-amass.mp4").read_bytes() + b"cut and coloured"
    assert edited[: len(first)] != first, "drawn again"
    (trained / "clip-amass.mp4").write_bytes(edited)
    _, err = hugs("amass.npz", *FAST, code=2)
    assert holds(err, "error", "clip-amass.mp4", "already there") and "`--force`" in err
    assert (trained / "clip-amass.mp4").read_bytes() == edited
    hugs("amass.npz", *FAST, "--force")
    assert (trained / "clip-amass.mp4").read_bytes() == first
    assert not list(trained.glob(".*.part"))


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_no_source_and_no_result_is_drawn_over(trained, hugs, force):
    (trained / "work/clip/store/train-01234567/film.mp4").write_text("a result")
    (trained / "link.mp4").unlink(missing_ok=True)
    (trained / "link.mp4").symlink_to("clip.mp4")
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    for out in ("clip.mp4", "link.mp4", "work/../clip.mp4", "work/clip/default/train/film.mp4", "clip.mp4/x.mp4"):
        _, err = hugs("amass.npz", "--out", out, *force, code=2)
        assert holds(err, "error", out, "hint", "--out")
    assert before.items() <= {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}.items()


def test_pictures_go_to_a_folder_of_their_own(trained, hugs):
    clip = load_clip(*(trained / "work/clip/default" / name for name in ("sfm", "smpl")))
    write_cameras(trained / "view.npz", Cameras(("a",), clip.viewmats[:1], clip.Ks[:1], WIDTH, HEIGHT))
    args = ("--cameras", "view.npz", "--only", "human", "--out")
    (trained / "mine").mkdir()
    (trained / "mine/a.png").write_text("my picture")
    (trained / "notes.txt").write_text("my notes")
    assert holds(hugs(*args, "mine", command="render", code=2)[1], "error", "mine", "--force")
    for out, facts in (("notes.txt", ("file",)), ("clip.mp4", ("source",)), ("notes.txt/x", ("notes.txt", "folder"))):
        assert holds(hugs(*args, out, "--force", command="render", code=2)[1], "error", out, *facts)
    for _ in range(2):
        assert hugs(*args, "views", command="render")[0] == "views\n"
    assert (trained / "mine/a.png").read_text() == "my picture"
    (trained / "mine/a.png").unlink()
    (trained / "mine/a.png").symlink_to("../notes.txt")
    hugs(*args, "mine", "--force", command="render")
    assert (trained / "notes.txt").read_text() == "my notes"
    assert (trained / "mine/a.png").read_bytes() == (trained / "views/a.png").read_bytes()


def test_a_video_needs_a_name_that_is_no_folder(trained, hugs):
    (trained / "folder.mp4").mkdir()
    assert holds(hugs("amass.npz", "--out", "folder.mp4", "--force", code=2)[1], "error", "folder.mp4", "folder")


@pytest.fixture(scope="module")
def exported(trained):
    """A folder with what `export` writes of the trained clip, and nothing of the work folder."""
    out = trained / "exported"
    out.mkdir()
    made = {name: trained / "made_clip" / name for name in ("frames", "sfm", "smpl", "train")}
    export.run(Job(out), export.Params(formats=["ply", "spz", "splats_glb"]), **made)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("file", ["avatar.npz", "avatar_splats.glb"])
def test_an_exported_avatar_performs_without_its_clip(trained, exported, hugs, file):
    args = ("amass.npz", "--fps", "2", "--out", f"{file}.mp4")
    out, _ = hugs("--avatar", f"exported/{file}", *args, source=())
    frames = film(trained / out.strip())
    seen = [colour_of(frame) for frame in frames]
    assert frames.shape == (4, 640, 640, 3) and (frames[:, :8, :8] > 245).all()
    assert (seen[0] == RED_SIDE).sum() > 2 * (seen[0] == BLUE_SIDE).sum(), "it looks at the camera"
    person = np.argwhere(np.stack(seen) >= 0)
    assert person[:, 1:].min() > 10 and person[:, 1:].max() < 630 and np.ptp(person[:, 1]) > 250
    head, feet = middle(seen[0] == HEAD)[0], np.argwhere(seen[0] >= 0)[:, 0].max()
    assert head < feet - 200, "upright"
    hand = [np.argwhere((s >= 0) & (np.arange(640) < middle(s == HEAD)[1] - 30))[:, 0].min() for s in seen]
    assert hand[2] < hand[0] - 40, "the right hand, on our left, goes up"


@pytest.mark.slow
def test_an_exported_avatar_in_an_exported_scene(trained, exported, hugs):
    """The wall is 4.5 m ahead, y down: the person stands on y = 1, 3 m ahead, and is seen from the clip's camera."""
    clip = load_clip(*(trained / "work/clip/default" / name for name in ("sfm", "smpl")))
    write_cameras(trained / "there.npz", Cameras(("a",), clip.viewmats[4:5], clip.Ks[:1], WIDTH, HEIGHT))
    args = ("amass.npz", "--fps", "1", "--camera", "there.npz", "--at", "0", "1", "3", "--out", "there.mp4")
    hugs("--avatar", "exported/avatar.npz", "--scene", "exported/scene.spz", *args, source=())
    picture = film(trained / "there.mp4")[0]
    seen = colour_of(picture)
    feet = np.argwhere(seen >= 0)[:, 0].max()
    expected = clip.viewmats[4] @ [0, 1, 3, 1]
    assert feet == pytest.approx((clip.Ks[0] @ expected[:3])[1] / expected[2], abs=5), "soles at the point"
    assert middle(seen == HEAD)[0] < feet - 30 and picture[:4, :4].max() < 140, "upright, before the wall"


@pytest.mark.slow
def test_the_clips_person_in_a_scene_that_was_edited(trained, exported, hugs):
    for scene, name in (((), "own.mp4"), (("--scene", "exported/scene.ply"), "file.mp4")):
        hugs("amass.npz", "--fps", "1", *scene, "--out", name)
    own, other = film(trained / "own.mp4"), film(trained / "file.mp4")
    assert np.abs(own.astype(int) - other).mean() < 1


@pytest.mark.slow
def test_an_exported_avatar_is_drawn_from_all_sides(trained, exported, hugs):
    args = ("--avatar", "exported/avatar_splats.glb", "--out", "around")
    assert hugs(*args, command="render", source=())[0] == "around\n"
    pictures = [read_pixels(path) for path in sorted((trained / "around").iterdir())]
    assert len(pictures) == 24 and pictures[0].shape == (640, 640, 4) and (pictures[0][0, 0] == 0).all()
    front, back = (colour_of(picture[..., :3]) for picture in (pictures[0], pictures[12]))
    assert (front == RED_SIDE).sum() > 5 * (front == BLUE_SIDE).sum()
    assert (back == BLUE_SIDE).sum() > 5 * (back == RED_SIDE).sum()


@pytest.mark.parametrize(
    ("command", "args", "facts"),
    [
        ("animate", ("clip.mp4", "amass.npz", "--avatar", "made/train/avatar.npz"), ("two people",)),
        ("animate", (), ("nobody",)),
        ("animate", ("--avatar", "made/train/avatar.npz"), ("no motion",)),
        ("animate", ("clip.mp4",), ("no motion",)),
        ("animate", ("--avatar", "none.glb", "amass.npz"), ("none.glb",)),
        ("render", ("clip.mp4", "--out", "x"), ("no cameras",)),
        ("render", ("--out", "x"), ("nobody",)),
        ("animate", ("--avatar", "made/train/avatar.npz", "amass.npz", "--who", "2"), ("avatar.npz", "no person 2")),
        ("render", ("--avatar", "made/train/avatar.npz", "--only", "scene", "--out", "x"), ("no scene",)),
    ],
)
def test_a_person_is_a_clips_or_a_files(hugs, command, args, facts):
    assert holds(hugs(*args, command=command, code=2, source=())[1], "error", *facts)


@pytest.mark.slow
def test_one_of_several_people_is_drawn(tmp_path, monkeypatch, capsys):
    links = finished.make(tmp_path)
    first, poses = read_avatar(links / "train/avatar.npz"), read_poses(links / "train/body.npz")
    theirs = folder_of(links / "train", 2)
    theirs.mkdir(parents=True)
    write_splats(theirs / "avatar.npz", replace(first, sh0=first.sh0[:, [1, 0, 2]]))  # red in front becomes green
    write_poses(theirs / "body.npz", replace(poses, transl=poses.transl + [0.3, 0, 0]))
    cameras = read_cameras(links / "sfm/cameras.npz")
    viewmats = cameras.viewmats[:1].copy()
    viewmats[:, :3, 3] *= WORLD_FROM_SFM
    write_cameras(tmp_path / "c.npz", replace(cameras, names=("a",), viewmats=viewmats, Ks=cameras.Ks[:1]))
    hugs = partial(hugs_here, tmp_path, monkeypatch, capsys)
    seen = []
    for who in ("1", "2"):
        hugs("render", "clip.mp4", "--cameras", "c.npz", "--only", "human", "--who", who, "--out", who)
        picture = read_pixels(tmp_path / who / "a.png")
        seen.append(picture[picture[..., 3] > 200][:, :3].mean(0))
        hugs("animate", "clip.mp4", "--who", who, str(write_motion(tmp_path)), "--fps", "2", "--only", "human")
    assert seen[0][0] > seen[0][1] + 50 and seen[1][1] > seen[1][0] + 50
    names = sorted(path.name for path in tmp_path.glob("*.mp4"))
    assert names == ["clip-2-moves.mp4", "clip-moves.mp4", "clip.mp4"]
    shown = [film(tmp_path / name)[0].reshape(-1, 3).astype(float).mean(0) for name in names[:2]]
    assert shown[0][1] > shown[0][0] and shown[1][0] > shown[1][1]
    for command, *args in (("animate", "moves.npz"), ("render", "--cameras", "c.npz", "--out", "x")):
        assert holds(hugs(command, "clip.mp4", *args, "--who", "3", code=1)[1], "error", "no person 3")


def write_motion(folder):
    orient, pose, transl = (t.numpy().astype(float) for t in MOTIONS["wave"](1.0, 10))
    np.savez(folder / "moves.npz", poses=np.concatenate([orient, pose], 1), trans=transl, fps=10.0)
    return folder / "moves.npz"


@pytest.mark.parametrize(
    ("film", "person"),
    [
        ({"seconds": 1e18}, {}),
        ({"seconds": 1e308}, {}),
        ({"moment": 1e300}, {}),
        ({"out": {"stills": {"folder": "a", "at": [0, 1e300]}}}, {}),
        ({}, {"start": 1e15}),
        ({}, {"start": -1e15}),
        ({}, {"speed": 1e-12}),
        ({"fps": 240}, {"start": 899}),
    ],
)
def test_a_film_of_any_length_is_refused_before_memory_is_taken(trained, monkeypatch, film, person):
    monkeypatch.chdir(trained)
    people = [{"avatar": "work/clip/default", "motion": "wave"} | person]
    with pytest.raises((StageError, ValidationError), match=r"too many|less than|greater than"):
        compose.run(Job(trained), compose.Params(people=people, **film))


def test_what_of_a_scene_is_left_out_is_a_warning_wherever_it_is_drawn(trained, hugs):
    scene = read_scene(trained / "work/clip/default/train/scene.npz")
    means = np.array(scene.means)
    write_ply(trained / "few.ply", replace(scene, means=np.where(np.arange(len(means))[:, None] == 5, np.nan, means)))
    said = ("warning", "few.ply", f"1 of {len(scene)} Gaussians", "rows 5")
    view = ("--cameras", "work/clip/default/sfm/cameras.npz")
    assert holds(hugs("wave.bvh", "--fps", "1", "--out", "few.mp4", "--scene", "few.ply")[1], *said)
    assert holds(hugs("--out", "few", "--scene", "few.ply", *view, command="render")[1], *said)
