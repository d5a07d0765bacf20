"""film.yaml as it is read: unknown keys, values that cannot be, paths from its folder, runs that are not finished."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from hugs_cli import film as films
from hugs_cli.cache.workspace import Stamp
from hugs_cli.pipelines import UsageError
from tests.made import finished
from tests.made.said import holds

GOOD = """
scene: runs/room
people:
  - {avatar: runs/ann, motion: moves.bvh, at: [0.5, 0]}
  - {avatar: /elsewhere/bob.npz, motion: wave}
camera: orbit
out: {film: films/a.mp4, stills: {folder: shots, at: [1]}}
"""


def read(folder: Path, text: str) -> object:
    (folder / "film.yaml").write_text(text)
    return films.read_film(folder / "film.yaml")


def test_paths_count_from_the_films_folder_and_words_are_no_paths(tmp_path):
    film = read(tmp_path, GOOD)
    assert film.scene == tmp_path / "runs/room" and film.people[0].avatar == tmp_path / "runs/ann"
    assert film.people[0].motion == str(tmp_path / "moves.bvh") and film.people[1].motion == "wave"
    assert film.people[1].avatar == Path("/elsewhere/bob.npz") and film.camera == "orbit"
    assert film.out.film == tmp_path / "films/a.mp4" and film.out.stills.folder == tmp_path / "shots"
    assert films.outputs(film) == [tmp_path / "films/a.mp4", tmp_path / "shots"]


@pytest.mark.parametrize(
    ("old", "new", "problem", "help"),
    [
        ("camera: orbit", "camra: orbit", ("film.yaml", "key", "camra"), ("camera",)),
        ("motion: moves.bvh", "motoin: moves.bvh", ("people 1", "key", "motoin"), ("motion",)),
        ("{film:", "{flim:", ("out", "key", "flim"), ("film",)),
        ("{folder:", "{fodler:", ("out, stills", "key", "fodler"), ("folder",)),
        ("camera: orbit", "code: orbit", ("film.yaml", "key", "code"), ()),
        ("at: [0.5, 0]", "at: [0.5]", ("film.yaml", "film"), ("people 1, at 2",)),
        ("at: [0.5, 0]", "speed: 0", ("film.yaml", "film"), ("people 1, speed", "greater")),
        ("camera: orbit", "fps: fast", ("film.yaml", "film"), ("fps",)),
        ("camera: orbit", "seconds: .inf", ("film.yaml", "film"), ("seconds", "number")),
        ("at: [0.5, 0]", "at: [.nan, 0]", ("film.yaml", "film"), ("people 1, at 1",)),
        ("camera: orbit", "size: [640, 0]", ("film.yaml", "film"), ("size 2",)),
        ("at: [1]", "at: []", ("film.yaml", "film"), ("out, stills, at", 1)),
        ("people:", "folk:", ("film.yaml", "key", "folk"), ()),
        (GOOD, "scene: a", ("film.yaml", "film"), ("people",)),
        (GOOD, "[1, 2]", ("film.yaml",), ("--init",)),
        (GOOD, "{", ("film.yaml", "YAML"), ()),
    ],
)
def test_what_is_no_film_is_refused_by_name(tmp_path, old, new, problem, help):
    assert old in GOOD
    with pytest.raises(UsageError) as refused:
        read(tmp_path, GOOD.replace(old, new))
    assert holds(refused.value.problem, *problem)
    assert holds("\n".join([refused.value.hint, *refused.value.facts]), *help)


@pytest.mark.parametrize("name", ["two: ann", "ann #1", "ann, eve", "- a", "[a]", "null", "10", "a\nb", "*a"])
def test_a_name_that_yaml_takes_for_something_else_is_quoted(name):
    text = films.quoted(name)
    assert text != name and films.plain_yaml.read(f"a: {text} # {text}\nb: [{text}]") == {"a": name, "b": [name]}
    assert films.quoted("../work/tänzerin im Bad/default") == "../work/tänzerin im Bad/default"


def test_a_film_that_is_not_there_is_said(tmp_path):
    with pytest.raises(UsageError, match=r"film\.yaml"):
        films.read_film(tmp_path / "film.yaml")


def test_runs_and_files_that_are_missing_are_named_before_anything_is_drawn(tmp_path):
    film = read(tmp_path, GOOD)
    with pytest.raises(UsageError, match=r"scene.*runs/room"):
        films.check_sources(film)
    (tmp_path / "runs/room/train").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"scene.*runs/room") as refused:
        films.check_sources(film)
    assert holds(refused.value.facts[0], "train, smpl, sfm, frames, survey")
    film = read(tmp_path, GOOD.replace("scene: runs/room", "scene: room.ply"))
    shutil.copyfile(tmp_path / "film.yaml", tmp_path / "room.ply")
    with pytest.raises(UsageError, match=r"person 1.*runs/ann"):
        films.check_sources(film)
    (tmp_path / "runs/ann.npz").touch()
    text = (
        GOOD.replace("scene: runs/room", "scene: room.ply")
        .replace("runs/ann", "runs/ann.npz")
        .replace("/elsewhere/bob", "runs/ann")
    )
    film = read(tmp_path, text)
    with pytest.raises(UsageError, match=r"moves\.bvh"):
        films.check_sources(film)
    (tmp_path / "moves.bvh").touch()
    assert [path.name for path in films.check_sources(film)] == ["room.ply", "ann.npz", "ann.npz", "moves.bvh"]


def test_a_run_of_which_a_part_was_made_again_is_refused(tmp_path):
    links = finished.make(tmp_path, "ann")
    film = films.checked({"people": [{"avatar": links}]}, "film.yaml")
    films.check_sources(film)
    stamp = Stamp.read(links / "train")
    replace(stamp, inputs=stamp.inputs | {"smpl": "of before"}).write(links / "train")
    with pytest.raises(UsageError, match=r"work/ann/default"):
        films.check_sources(film)
