"""`hugs compose`: from two finished runs to films, pictures, files and the page; what is kept, and what is said."""

from __future__ import annotations

import json
import re
import shutil
import threading
from functools import partial
from pathlib import Path

import av
import numpy as np
import pytest

from hugs_cli import app_compose
from hugs_cli.cache.fingerprint import content_digest
from hugs_cli.cache.locks import locked
from hugs_cli.console import Console
from stages.filming import outputs
from stages.filming import page as pages
from stages.filming.shoot import Shoot
from stages.formats.exchange.glb import Glb
from stages.formats.exchange.read import read_any_scene
from stages.formats.images import read_image
from stages.formats.video import decode
from tests.made import finished
from tests.made.command import hugs_here
from tests.made.meshes import coarse
from tests.made.said import holds
from tests.made.tiny import colour_of

pytestmark = pytest.mark.slow

FILM = """
scene: work/ann/default
people:
  - {avatar: work/ann/default, motion: wave, at: [-0.4, 0.0]}
  - {avatar: work/bob/default, motion: squats, at: [0.45, 0.0], start: -0.5}
camera: still
fps: 4
seconds: 1.5
size: [96, 128]
out:
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("compose")
    for clip in ("ann", "bob"):
        finished.make(folder, clip)
    return folder


@pytest.fixture
def hugs(made, monkeypatch, capsys):
    """Runs `hugs compose ...` in this process, with small meshes; its stdout and stderr."""
    monkeypatch.setattr(outputs, "MESH", (500, 64))
    with coarse():
        yield partial(hugs_here, made, monkeypatch, capsys, "compose")


@pytest.fixture
def drawn(monkeypatch):
    """Counts the pictures that are drawn."""
    numbers: list[int] = []
    whole, alone = Shoot.picture, Shoot.people
    monkeypatch.setattr(
        Shoot, "picture", lambda self, number, *kept: numbers.append(number) or whole(self, number, *kept)
    )
    monkeypatch.setattr(
        Shoot, "people", lambda self, number, *kept: numbers.append(number) or alone(self, number, *kept)
    )
    return numbers


def write(made: Path, name: str, out: str, *changes: tuple[str, str]) -> str:
    text = FILM
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (made / name).write_text(text + "".join(f"  {line}\n" for line in out.split("; ")))
    return name


def test_what_init_writes_runs_as_it_is(made, hugs, monkeypatch):
    out, said = hugs("--init", "work/ann/default", "work/bob/default", "--out", "new/first.yaml")
    assert out == "new/first.yaml\n"
    text = (made / "new/first.yaml").read_text()
    assert text.count("#") > 15 and "avatar: ../work/bob/default" in text
    (place,) = re.findall(r"^    at: \[(.*), 0\]", text, re.MULTILINE)  # bob's; ann stands where she was
    assert abs(float(place)) >= 1 and holds(said, "bob", place)
    (made / "new/first.yaml").write_text(text.replace("fps: 30", "fps: 4"))
    out, err = hugs("new/first.yaml")
    assert out == "new/first.mp4\n" and holds(err, "3 frames", "0.8 s", "4 fps")
    assert len(list(decode(made / "new/first.mp4"))) == 3
    others = made / "work/bob/default/train/people/2"
    others.mkdir(parents=True)
    (others / "avatar.npz").touch()
    plan = {"camera": "auto", "at": [[0, 0], [0.25, -1], [0.25, -1]]}
    with monkeypatch.context() as patch:
        patch.setattr(app_compose, "planned", lambda *_: plan)
        hugs("--init", "work/ann/default", "work/bob/default", "--out", "new/both.yaml")
    text = (made / "new/both.yaml").read_text()
    assert [line.split()[1] for line in text.splitlines() if line.startswith("    who:")] == ["1", "2"]
    assert text.count("    at: [0.25, -1]") == 2 and "camera: auto " in text
    shutil.rmtree(others.parent)
    assert holds(hugs("--init", "work/ann/default", "--out", "new/first.yaml", code=2)[1], "error", "new/first.yaml")
    assert "nobody" in hugs("--init", code=2)[1]
    (made / "work/ann: a dance #1").symlink_to("ann")
    hugs("--init", "work/ann: a dance #1/default", "--out", "new/no: 1.yaml")
    text = (made / "new/no: 1.yaml").read_text()
    assert 'avatar: "../work/ann: a dance #1/default"' in text and 'film: "no: 1.mp4"' in text
    (made / "work/ann: a dance #1").unlink()
    (made / "far/films").mkdir(parents=True)
    (made / "way").symlink_to("far/films")
    hugs("--init", "work/ann/default", "--out", "way/first.yaml")
    assert "avatar: ../../work/ann/default" in (made / "far/films/first.yaml").read_text()
    shutil.copyfile(made / "work/ann/default/train/avatar.npz", made / "ann.npz")
    for out in ("work/ann/default/train/avatar.npz", "ann.npz"):
        before = (made / out).read_bytes()
        _, err = hugs("--init", "work/ann/default", "ann.npz", "--out", out, "--force", code=2)
        assert holds(err, "error", out) and (made / out).read_bytes() == before


def test_both_are_in_the_scene_and_the_same_film_makes_the_same_bytes(made, hugs, drawn):
    film, memory = write(made, "a.yaml", "film: a.mp4"), made / "work/.code.json"
    memory.unlink()
    _, err = hugs(film)
    assert memory.is_file(), "the next film need not look into the code again"
    assert holds(err, "6 frames", "1.5 s", "4 fps") and drawn == list(range(6))
    first = (made / "a.mp4").read_bytes()
    seen = colour_of(next(decode(made / "a.mp4"))[2])
    columns = np.argwhere(seen == 3)[:, 1]  # heads
    assert (columns < 48).sum() > 20 and (columns > 48).sum() > 20
    again = hugs(film)[1]
    assert holds(again, "a.mp4", "up to date") and len(drawn) == 6
    other = write(made, "b.yaml", "film: b.mp4")
    hugs(other)
    assert (made / "b.mp4").read_bytes() == first and len(drawn) == 12


def test_a_second_compose_of_a_film_waits_for_the_first(made, hugs, monkeypatch):
    film = write(made, "twice.yaml", "splats: twice.ply")
    hugs(film)
    (kept,) = (made / "work/.films").glob("twice-*")
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with locked(kept / ".lock", pytest.fail):
            held.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    say = Console.say
    monkeypatch.setattr(Console, "say", lambda self, text: done.set() if "waiting" in text else say(self, text))
    _, err = hugs(film)
    assert done.is_set() and holds(err, "twice.ply", "up to date")
    thread.join()


class Killed(BaseException):
    """Nothing after it runs."""


@pytest.mark.parametrize("at", ["page", "glb"])
def test_a_compose_killed_after_some_of_its_files_makes_the_rest(made, hugs, monkeypatch, at):
    out = f"film: {at}k.mp4; page: {at}k.html; stills: {{folder: {at}k, at: [0]}}; splats: {at}k.ply; glb: {at}k.glb"
    film = write(made, f"{at}k.yaml", out, ("seconds: 1.5", "seconds: 0.5"))

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(outputs if at != "page" else pages, at, kill)
        hugs(film)
    _, err = hugs(film)
    assert holds(err, f"{at}k.mp4", "up to date") and (made / f"{at}k.glb").is_file()


@pytest.mark.parametrize("out", ["page: a.html; stills: {folder: a.html, at: [0]}",
                                 "page: a.html; stills: {folder: a.html/b, at: [0]}",
                                 "splats: a.ply; stills: {folder: new/../a.ply, at: [0]}"])  # fmt: skip
def test_two_outputs_in_one_place_are_refused_before_anything_is_drawn(made, hugs, drawn, out):
    _, err = hugs(write(made, "same.yaml", out), code=2)
    assert holds(err, "error", "a.html" if "a.html" in out else "a.ply", "both") and not drawn


def test_results_of_a_run_in_another_work_folder_and_its_film_are_never_written_over(made, hugs, tmp_path):
    finished.make(tmp_path, "eve")
    run = tmp_path / "work/eve/default"
    source = {"path": str(tmp_path / "eve.mp4"), "sha256": content_digest(tmp_path / "eve.mp4")}
    (tmp_path / "work/eve/sources.json").write_text(json.dumps({"video": source}))
    (run / "train/scene.ply").write_text("kept")
    for out in (run / "train/scene.ply", run / "train/film.ply", tmp_path / "work/eve/store/new.ply"):
        film = write(made, "other.yaml", f"splats: {out}", ("work/bob/default", str(run)))
        assert holds(hugs(film, "--force", code=2)[1], "error", out)
    film = write(made, "other.yaml", f"film: {tmp_path}/eve.mp4", ("work/bob/default", str(run)))
    assert holds(hugs(film, "--force", code=2)[1], "error", "eve.mp4", "source")
    assert (run / "train/scene.ply").read_text() == "kept" and (tmp_path / "eve.mp4").read_text() == "pixels of eve"


def test_a_still_takes_the_place_of_a_link_and_what_it_leads_to_stays(made, hugs):
    (made / "linked").mkdir()
    stored = made / "work/ann/default/frames/frames.json"
    before = stored.read_bytes()
    (made / "linked/000.000.png").symlink_to(stored)
    film = write(made, "linked.yaml", "stills: {folder: linked, at: [0]}")
    assert holds(hugs(film, code=2)[1], "error", "linked", "--force")
    hugs(film, "--force")
    assert stored.read_bytes() == before and read_image(made / "linked/000.000.png").shape == (128, 96, 3)
    assert holds(hugs(film)[1], "linked", "up to date")


def test_a_film_that_was_cut_short_goes_on_where_it_was(made, hugs, drawn, monkeypatch):
    film = write(made, "long.yaml", "film: long.mp4", ("seconds: 1.5", "seconds: 3"))
    picture = Shoot.picture

    def stop(self, number, *kept):
        if number == 10:
            raise OSError(28, "No space left on device")
        return picture(self, number, *kept)

    with monkeypatch.context() as patch:
        patch.setattr(Shoot, "picture", stop)
        hugs(film, code=1)
    assert not (made / "long.mp4").exists() and drawn == list(range(10))
    drawn.clear()
    hugs(film)
    assert drawn == list(range(8, 12)), "the first piece of 2 s was kept"
    longer = write(made, "long.yaml", "film: long.mp4", ("seconds: 1.5", "seconds: 4"))
    drawn.clear()
    hugs(longer)
    assert drawn == list(range(8, 16)), "only what is new is drawn"
    assert len(list(decode(made / "long.mp4"))) == 16


def test_a_film_is_no_strangers_where_what_comes_after_it_was_not_made(made, hugs, drawn, monkeypatch):
    film = write(made, "h.yaml", "film: h.mp4; splats: h.ply")

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("stages.filming.outputs.splats", full)
        hugs(film, code=1)
    assert (made / "h.mp4").exists() and drawn
    drawn.clear()
    _, err = hugs(film)
    assert holds(err, "h.mp4", "up to date") and not drawn


def test_a_change_draws_again_what_depends_on_it_and_nothing_else(made, hugs, drawn):
    film = write(made, "c.yaml", "film: c.mp4")
    hugs(film)
    count = len(drawn)
    write(made, "c.yaml", "film: c.mp4; page: c.html")
    hugs(film)
    assert len(drawn) == count and (made / "c.html").stat().st_size > 1e6
    write(made, "c.yaml", "film: c.mp4; page: c.html", ("at: [0.45, 0.0]", "at: [0.5, 0.0]"))
    assert not holds(hugs(film)[1], "c.mp4", "up to date") and len(drawn) == 2 * count
    (made / "c.mp4").write_bytes(b"edited")
    assert holds(hugs(film, code=2)[1], "error", "c.mp4", "--force")


def test_stills_splats_alpha_and_glb(made, hugs):
    outs = "stills: {folder: shots, at: [0.0, 1.3]}; splats: d.ply; alpha: d.mov; glb: d.glb"
    out, _ = hugs(write(made, "d.yaml", outs))
    assert out.split() == ["d.mov", "d.ply", "d.glb", "shots"]
    names = [path.name for path in sorted((made / "shots").iterdir())]
    assert names == ["000.000.png", "001.300.png"] and read_image(made / "shots" / names[0]).shape == (128, 96, 3)
    whole = read_any_scene(made / "d.ply")
    scene = read_any_scene(made / "work/ann/default/train/scene.npz")
    assert len(whole) == len(scene) + 2 * 1723
    np.testing.assert_allclose(whole.means[-len(scene) :], scene.means, atol=1e-6)
    with av.open(str(made / "d.mov")) as film:
        frames = [frame.to_ndarray(format="rgba") for frame in film.decode(video=0)]
    assert len(frames) == 6 and frames[0][:4, :4, 3].max() == 0 and (frames[0][..., 3] > 250).sum() > 300
    glb = Glb(made / "d.glb")
    nodes = {node["name"]: node for node in glb.content["nodes"]}
    assert {"ann", "bob", "scene"} <= set(nodes) and len(glb.content["skins"]) == 2
    np.testing.assert_allclose(nodes["bob"]["translation"], [0.45, 0, 0], atol=1e-9)
    (moves,) = glb.content["animations"]
    assert len(moves["channels"]) == 2 * 25 and max(c["sampler"] for c in moves["channels"]) == 49


def test_the_page_has_all_people_and_the_films_camera(made, hugs):
    hugs(write(made, "e.yaml", "page: e.html"))
    html = (made / "e.html").read_text(encoding="utf-8")
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', html, re.S)[1])
    assert len(facts["people"]) == 2 and facts["motions"][0]["name"] == "The film"
    assert facts["clip"]["pictures"] == [] and len(facts["clip"]["names"]) == 6
    assert facts["arrays"]["motion1.0/steps"]["shape"] == [6, 3]
    spots = np.array([one["stand"]["spot"] for one in facts["people"]])
    assert np.linalg.norm(spots[1] - spots[0]) == pytest.approx(0.85)


def test_people_in_each_other_are_warned_of_and_wrong_wishes_refused(made, hugs, drawn):
    film = write(made, "f.yaml", "stills: {folder: near, at: [0]}", ("at: [0.45, 0.0]", "at: [-0.3, 0.0]"))
    assert re.search(r"warning: .*ann.*bob.* \d+ cm.* \d\.\d s", hugs(film)[1])
    for old, new, problem in (
        ("motion: wave", "motion: wvae", ("motion", "wvae")),
        ("camera: still", "camera: stil", ("camera", "stil")),
        ("scene: work/ann", "scene: work/eve", ("scene", "work/eve")),
    ):
        _, err = hugs(write(made, "g.yaml", "film: g.mp4", (old, new)), code=2 if "eve" in new else 1)
        assert holds(err, "error", *problem)
    assert holds(hugs(write(made, "g.yaml", "film: g.avi"), code=1)[1], "error", "g.avi", ".mp4")
    drawn.clear()
    _, err = hugs(write(made, "g.yaml", "film: g.mp4; splats: g.obj"), code=1)
    assert holds(err, "error", "g.obj", ".ply") and not drawn
    assert holds(hugs(write(made, "g.yaml", "{}"), code=2)[1], "error", "g.yaml", "out")
    inside = write(made, "g.yaml", "film: work/ann/default/train/film.mp4")
    assert holds(hugs(inside, "--force", code=2)[1], "error", "work/ann/default/train/film.mp4")
