"""The folders of a clip: copies of them, what others put there, and small files that are whole at every moment."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil

import pytest

from hugs_cli.cache.workspace import OPTIONS, Workspace, read_json, write_json
from hugs_cli.pipelines import UsageError
from tests.made.flow import ALL, WHOLE
from tests.made.said import holds


@pytest.fixture
def copied(made):
    """A finished run whose work folder was copied by a program that resolves links."""
    shutil.copytree(made.work, made.folder / "copy")
    shutil.rmtree(made.work)
    (made.folder / "copy").rename(made.work)
    assert not any(path.is_symlink() for path in made.work.rglob("*"))
    return made


@pytest.mark.slow
def test_a_copy_with_its_links_resolved_is_taken(copied):
    out, _ = copied.hugs(command="gc")
    assert out == "0 B freed\n", "what the copy has in a link's place is in use"
    assert copied.ran() == {} and copied.text("four") == WHOLE
    assert all((copied.work / "clip/default" / name).is_symlink() for name in ALL)
    assert len(list(copied.store.iterdir())) == 4
    assert copied.ran("--set", "four.word=b") == {"four": ["params.word: a -> b"]}


@pytest.mark.slow
def test_a_copy_without_its_store_runs_again_and_loses_nothing(copied):
    shutil.rmtree(copied.store)
    assert list(copied.ran("--set", "four.word=b")) == ALL
    assert copied.text("four").startswith("four:b(")
    assert copied.ran() == {}, "the result that the copy had is in the store"


@pytest.mark.slow
def test_accept_in_a_copy_with_its_links_resolved(copied):
    copied.edit("helper", "count = len(", "count = 0 + len(")
    assert copied.hugs(command="accept")[0].count(" accepted: ") == 4
    assert copied.ran() == {} and copied.text("four") == WHOLE


@pytest.mark.slow
def test_a_folder_of_ones_own_in_a_links_place_is_kept_and_named(flow):
    own = flow.work / "clip/default/one"
    own.mkdir(parents=True)
    (own / "note.txt").write_text("mine")
    _, err = flow.hugs("one", code=2)
    assert holds(err, "error", "work/clip/default/one", "not a link to a result") and holds(err, "hint", "move")
    assert (own / "note.txt").read_text() == "mine"
    own.rename(flow.folder / "away")
    assert flow.ran("one") == {}, "what was made before is not lost"


@pytest.mark.slow
def test_gc_leaves_alone_what_no_run_made_and_frees_the_rest(made):
    made.hugs("--set", "four.word=b")
    (made.store / ".DS_Store").write_text("x")
    (made.store / "four-00000000").symlink_to(made.folder / "flow")
    (made.store / "my notes").mkdir()
    for name in ("one-00000000.part", "two-00000000.old", "three-11111111"):
        (made.store / name).mkdir()
    out, err = made.hugs(command="gc")
    assert out.count("removed ") == 4 and out.splitlines()[-1].endswith(" freed")
    strays = [line.split("/")[-1].partition(" is left alone")[0] for line in err.splitlines()]
    assert strays == [".DS_Store", "four-00000000", "my notes"]
    assert len(list(made.store.iterdir())) == 7 and (made.folder / "flow/one.py").exists()
    assert made.ran("--set", "four.word=b") == {}


def test_a_small_file_is_replaced_in_one_step(tmp_path):
    path = tmp_path / "stamp.json"
    write_json(path, {"a": 1})
    with open(path) as reader:
        write_json(path, {"a": 2})
        assert reader.read().split() == ["{", '"a":', "1", "}"], "who reads the old file reads it whole"
    assert read_json(path) == {"a": 2} and os.listdir(tmp_path) == ["stamp.json"]


def test_options_are_kept_in_a_folder_that_no_run_has_made_yet(tmp_path):
    """As of the variants of `hugs ablate` and of sweeps."""
    Workspace(tmp_path / "clip.mp4", tmp_path / "work", "default").create()
    variant = Workspace(tmp_path / "clip.mp4", tmp_path / "work", "default.no_lbs")
    variant.keep_options({})
    assert not variant.links.exists()
    variant.keep_options({"seed": 3})
    assert read_json(variant.links / OPTIONS) == {"seed": 3}


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "stamp.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": 2, "b": object()})
    assert read_json(path) == {"a": 1}


def test_a_file_system_without_locks_is_named_unless_a_lease_holds_the_clip(tmp_path, monkeypatch):
    """Lustre and NFS, as some clusters set them up."""
    workspace = Workspace(tmp_path / "clip.mp4", tmp_path / "work", "default")
    workspace.create()

    def none(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.raises(UsageError, match="locked"), workspace.lock(pytest.fail):
        pass
    workspace.leased = True
    with workspace.lock(pytest.fail) as handle:
        assert os.fstat(handle)
