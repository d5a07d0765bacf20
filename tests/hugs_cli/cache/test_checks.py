"""Wrong at once: what cannot become an avatar is refused before any stage runs, with the facts."""

from __future__ import annotations

import io
import json
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from hugs_cli.app import run_pipeline
from hugs_cli.cache import child
from hugs_cli.cache.checks import check
from hugs_cli.cache.launcher import Launcher
from hugs_cli.options import Device, RunOptions
from stages.contract import StageError
from stages.formats.body_model import FREE_BODY
from stages.formats.datasets.neuman import FIT
from stages.formats.video import write_video
from tests.made import landmark_files
from tests.made.said import holds

WIDTH, HEIGHT, FRAMES = 96, 128, 12
PHOTO = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
MASK = np.zeros((HEIGHT, WIDTH), np.uint8)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film, and much that is none."""
    room = tmp_path_factory.mktemp("room")
    moving = [np.roll(PHOTO, 3 * i, 1) for i in range(FRAMES)]
    write_video(room / "film.mp4", moving, 30)
    write_video(room / "short.mp4", moving[:3], 30)
    whole = (room / "film.mp4").read_bytes()
    (room / "cut.mp4").write_bytes(whole[: whole.index(b"moov") - 4] + b"\0\0\0\x08free")
    cv2.imwrite(str(room / "still.jpg"), PHOTO)
    cv2.imwrite(str(room / "still.png"), PHOTO)
    (room / "song.mp3").write_bytes(b"ID3\4" + bytes(2000))
    (room / "song.wav").write_bytes(b"RIFF\0\1\0\0WAVEfmt " + bytes(2000))
    (room / "list.m3u8").write_text("#EXTM3U\n#EXTINF:9.0,\nfilm.mp4\n#EXT-X-ENDLIST\n")
    (room / "list.txt").write_text("ffconcat version 1.0\nfile film.mp4\n")
    (room / "words.mp4").write_text("some words\n" * 50)
    (room / "page.mp4").write_text("<!doctype html><html><body>a page about a film</body></html>")
    with zipfile.ZipFile(room / "film.zip", "w") as archive:
        archive.write(room / "film.mp4", "film.mp4")
    (room / "nothing.mp4").touch()
    (room / "empty").mkdir()
    every = range(FRAMES)
    masks = {"beyond": range(100, 200), "wide": every, "photos": every, "named": (), "good": every, "some": every[5:7]}
    for folder, numbers in masks.items():
        (room / folder).mkdir()
        shown = {"wide": MASK.T, "photos": PHOTO}.get(folder, MASK)
        for i in numbers:
            cv2.imwrite(str(room / folder / f"{i:05d}.png"), shown)
    cv2.imwrite(str(room / "named" / "anna.png"), MASK)
    for name, count in {"stack": FRAMES + 1, "whole": FRAMES, "less": FRAMES - 1}.items():
        np.save(room / f"{name}.npy", np.zeros((count, HEIGHT, WIDTH), np.uint8))
    zeros = {name: np.zeros((FRAMES, n)) for name, n in {"global_orient": 3, "body_pose": 69, "transl": 3}.items()}
    np.savez(room / "fit.npz", betas=np.zeros(10), **zeros)
    for name, count in {"points": 9, "whole_points": FRAMES}.items():
        np.save(room / f"{name}.npy", landmark_files.triples("COCO-17", landmark_files.somebody(count)))
    np.savez(room / "other.npz", colours=np.zeros((4, 3)))
    (room / "take.csv").write_text("time,jawOpen\n0,0.1\n0.5,0.4\n")
    rows = [{"file_path": f"at_{i}.png", "transform_matrix": np.eye(4).tolist()} for i in every]
    for name, w, h in (("turned", HEIGHT, WIDTH), ("large", 2 * WIDTH, 2 * HEIGHT)):
        (room / f"{name}.json").write_text(json.dumps({"w": w, "h": h, "fl_x": 150.0, "frames": rows}))
    return room


def in_process(self: Launcher, jobs: list[dict]) -> dict | None:
    """`Launcher.check`, here: what goes through the pipe."""
    said = io.StringIO()
    child.check(jobs, said)
    *before, last = map(json.loads, said.getvalue().splitlines())
    return None if last["event"] == "checked" else {**last, "stage": before[-1]["stage"]}


def stage_runs(*_: object) -> None:
    raise AssertionError("a stage runs")


@pytest.fixture
def refused(room, monkeypatch, tmp_path):
    """`refused(video, ...)`: the error of a run that is refused, and began nothing."""
    monkeypatch.chdir(room)
    monkeypatch.setattr(Launcher, "check", in_process)
    monkeypatch.setattr(Launcher, "launch", stage_runs)

    def error_of(*words: str, **given: object) -> StageError:
        paths = {name: Path(str(one)) for name, one in given.items() if name not in ("set_", "pipeline")}
        settings = {"set_": [given["set_"]]} if "set_" in given else {}
        settings |= {"pipeline": given["pipeline"]} if "pipeline" in given else {}
        with pytest.raises(StageError) as caught:
            session = RunOptions(**settings, **paths, work=tmp_path).session(Path(words[0]))
            run_pipeline(session, list(words[1:]) or None, Device.cpu)
        assert not list(tmp_path.glob("*/store/*")), "something was begun"
        return caught.value

    return error_of


WRONG: dict[str, tuple[tuple[str, ...], dict[str, str], tuple[str, ...], str]] = {
    # what is given -> video and stages, options, the facts, what the hint names
    "a picture": (("still.jpg",), {}, ("still.jpg", "picture", "JPEG"), "folder"),
    "a PNG": (("still.png",), {}, ("still.png", "picture", "PNG"), "folder"),
    "sound": (("song.mp3",), {}, ("song.mp3", "sound", "MP3"), "video"),
    "more sound": (("song.wav",), {}, ("song.wav", "sound", "WAV"), "video"),
    "a playlist": (("list.m3u8",), {}, ("list.m3u8", "list", "films"), "ffmpeg"),
    "a list of parts": (("list.txt",), {}, ("list.txt", "list", "films"), "ffmpeg"),
    "a text": (("words.mp4",), {}, ("words.mp4", "text"), "film"),
    "a web page": (("page.mp4",), {}, ("page.mp4", "web page"), "downloaded"),
    "an archive": (("film.zip",), {}, ("film.zip", "archive", "zip"), "unpack"),
    "an empty file": (("nothing.mp4",), {}, ("nothing.mp4", "empty"), "copy"),
    "an empty folder": (("empty",), {}, ("no pictures", "empty"), "video"),
    "a film cut short": (("cut.mp4",), {}, ("cut.mp4", "cut short"), "again"),
    "a film of a moment": (("short.mp4",), {}, ("short.mp4", "3", "8"), "film"),
    "an address": (("https://films.example/a.mp4",), {}, ("https://films.example/a.mp4", "video"), "download"),
    "a path that is not there": (("gone.mp4",), {}, ("no video", "gone.mp4"), "path"),
    "two films": (("film.mp4", "short.mp4"), {}, ("short.mp4", "no stage", "one clip"), "hugs fleet"),
    "a film for a sequence": (("film.mp4",), {"pipeline": "neuman"}, ("film.mp4", "NeuMan", "images"), "folder"),
    "a folder of others": (("good",), {"pipeline": "zju"}, ("good", "ZJU-MoCap", "annots.npy"), "folder"),
    "a picture for masks": (("film.mp4",), {"masks": "still.png"}, ("still.png", "one mask"), "folder"),
    "sound for masks": (("film.mp4",), {"masks": "song.mp3"}, ("song.mp3", "sound", "no masks"), "--masks"),
    "no masks": (("film.mp4",), {"masks": "empty"}, ("no masks", "empty"), "one per frame"),
    "too many masks": (("film.mp4",), {"masks": "stack.npy"}, ("stack.npy", "13", "12"), "order"),
    "masks of a longer film": (("film.mp4",), {"masks": "beyond"}, ("100", "12", "199"), "film.mp4"),
    "masks of other names": (("film.mp4",), {"masks": "named"}, ("12 of 12", "anna"), "number"),
    "masks of another shape": (("film.mp4",), {"masks": "wide"}, ("128x96", "96x128"), "upright"),
    "photos for masks": (("film.mp4",), {"masks": "photos"}, ("picture, not a mask", "colours"), "white"),
    "an address for masks": (("film.mp4",), {"masks": "http://a.example/m"}, ("http://a.example/m", "--masks"), "path"),
    "sound for a fit": (("film.mp4",), {"smpl_fit": "song.mp3"}, ("song.mp3", "sound"), "global_orient"),
    "other arrays for a fit": (("film.mp4",), {"smpl_fit": "other.npz"}, ("other.npz", "transl"), "global_orient"),
    "sound for landmarks": (("film.mp4",), {"landmarks": "song.mp3"}, ("song.mp3", "sound"), "--landmarks"),
    "landmarks of a shorter film": (("film.mp4",), {"landmarks": "points.npy"}, ("points.npy", "9", "12"), "names"),
    "sound for a face": (("film.mp4",), {"face": "song.mp3"}, ("song.mp3", "CSV"), "jawOpen"),
    "no cameras": (("film.mp4",), {"cameras": "empty"}, ("no cameras", "empty"), "COLMAP"),
    "a picture for cameras": (("film.mp4",), {"cameras": "still.jpg"}, ("still.jpg", "cameras", ".jpg"), "COLMAP"),
    "cameras turned": (("film.mp4",), {"cameras": "turned.json"}, ("128x96", "96x128"), "upright"),
    "a picture for a body": (("film.mp4",), {"body_model": "still.jpg"}, ("still.jpg", "picture"), "SMPL_NEUTRAL"),
    "other arrays for a body": (("film.mp4",), {"body_model": "other.npz"}, ("other.npz", "J_regressor"), "SMPL"),
    "no such motion": (("film.mp4",), {"set_": "export.motion=x.txt"}, ("export.motion", "x.txt"), "hugs stages"),
    "no such format": (("film.mp4",), {"set_": "export.formats=[pdf]"}, ("export.formats", "pdf"), "hugs stages"),
    "no steps": (("film.mp4",), {"set_": "train.steps=0"}, ("train.steps", "0"), "hugs stages"),
    "more cells than memory": (("film.mp4",), {"set_": "train.resolution=99999"}, ("train.resolution", "4096"), "hugs"),
    "a film of a blink": (("film.mp4",), {"set_": "render.motion_seconds=0.01"}, ("motion_seconds", "0.01"), "hugs"),
    "a word for a number": (("film.mp4",), {"set_": "frames.count=many"}, ("frames.count", "many"), "hugs stages"),
    "a format without its package": (("film.mp4",), {"set_": "export.formats=[usd]"}, ("usd-core",), "pip install"),
    "another such format": (("film.mp4",), {"set_": "export.formats=[sog]"}, ("gaussforge",), "pip install"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_refused_before_any_stage(refused, monkeypatch, what):
    for package in ("pxr", "pxr.UsdVol", "gaussforge"):  # as if they were not installed
        monkeypatch.setitem(sys.modules, package, None)
    words, given, facts, hint = WRONG[what]
    error = refused(*words, **given)
    assert holds(" ".join([error.problem, *error.facts]), *facts), [error.problem, *error.facts]
    assert hint in error.hint and "\n" not in error.problem and "bug" not in error.problem


RIGHT = {
    "a film alone": {},
    "a mask a frame": {"masks": "good"},
    "a mask of some frames": {"masks": "some"},  # whether they are those that are picked is known when they are
    "a stack": {"masks": "whole.npy"},
    "a stack for a film of which not all may decode": {"masks": "less.npy"},
    "a film of masks": {"masks": "film.mp4"},
    "a fit": {"smpl_fit": "fit.npz"},
    "landmarks": {"landmarks": "whole_points.npy"},
    "a face": {"face": "take.csv"},
    "cameras of other names and size": {"cameras": "large.json"},
    "a body": {"body_model": str(FREE_BODY)},
}


@pytest.mark.parametrize("what", RIGHT)
def test_nothing_is_refused_that_a_stage_may_take(room, tmp_path, monkeypatch, what):
    monkeypatch.chdir(room)
    monkeypatch.setattr(Launcher, "check", in_process)
    given = {name: Path(one) for name, one in RIGHT[what].items()}
    session = RunOptions(**given, work=tmp_path).session(Path("film.mp4"))
    check(session, session.pipeline.stages.values(), Launcher(0))


def test_a_data_set_brings_its_own(tmp_path, monkeypatch):
    """Its folder is no film: what is given beside it is looked at by the stages."""
    for folder in ("images", "sparse", "4d_humans"):
        (tmp_path / "sequence" / folder).mkdir(parents=True)
    (tmp_path / "sequence" / FIT).touch()
    monkeypatch.setattr(Launcher, "check", in_process)
    (tmp_path / "masks").mkdir()
    session = RunOptions(masks=tmp_path / "masks", pipeline="neuman", work=tmp_path).session(tmp_path / "sequence")
    check(session, session.pipeline.stages.values(), Launcher(0))


CHECK = """
def check(params, *, mask_files=None):
    import os, signal
    with open("checked", "a") as file:
        file.write(f"{params.word} {mask_files and mask_files.name}\\n")
    if params.word == "wrong":
        from stages.contract import StageError
        raise StageError("the word is wrong", "take another", ["it has 5 letters"])
    if params.word == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if params.word == "bug":
        raise KeyError("shoulder")
"""


def test_all_stages_to_come_check_before_the_first_runs_and_fresh_ones_do_not(flow):
    for name in ("one", "two"):
        flow.write(name, (flow.package / f"{name}.py").read_text() + CHECK)
    checked = flow.folder / "checked"
    flow.hugs("two")
    assert checked.read_text().split() == ["a", "None", "a", "None"]
    (flow.folder / "m").write_text("white")
    flow.hugs("two")
    assert checked.read_text().split()[4:] == []  # all was fresh
    _, err = flow.hugs("two", "--set", "two.word=wrong", "--masks", "m", code=1)
    assert holds(err, "the word is wrong", "5 letters", "hint", "take another")
    assert checked.read_text().split()[4:] == ["wrong", "m"]


@pytest.mark.parametrize(("word", "facts"), [("killed", ("four", "signal", "9")), ("bug", ("KeyError", "shoulder"))])
def test_a_check_that_dies_is_an_error_that_names_its_stage(flow, word, facts):
    flow.write("four", (flow.package / "four.py").read_text() + CHECK)
    _, err = flow.hugs("--set", f"four.word={word}", code=1)
    assert holds(err, *facts) and "four" in err and not list(flow.store.iterdir())
