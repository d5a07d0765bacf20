"""Where drawings go: never over a source or a result, and over what others made only with --force."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hugs_cli.outputs import check_out, remember_out, remembering
from hugs_cli.pipelines import UsageError


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A work folder with a store, beside a film, masks and a motion; the current folder holds them."""
    monkeypatch.chdir(tmp_path)
    for name in ("work/a/store/train-01234567", "masks"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("a.mp4", "masks/1.png", "other.mp4", "wave.bvh"):
        (tmp_path / name).write_text(name)
    video, masks = ({"path": str(tmp_path / name), "sha256": name} for name in ("a.mp4", "masks"))
    sources = {"video": video, "mask_files": masks, "x": 1, "cameras": {"path": str(tmp_path), "sha256": "dry"}}
    stamp = {"inputs": {"video": "a.mp4", "mask_files": "masks", "cameras": None}}
    (tmp_path / "work/a/store/train-01234567/stamp.json").write_text(json.dumps(stamp))
    (tmp_path / "work/a/sources.json").write_text(json.dumps({**sources, "y": {"path": ""}, "z": {}}))
    return Path("work")


@pytest.mark.parametrize("out", ["a.mp4", "masks/x.mp4", "masks", "wave.bvh", "work/a/store/x.mp4", "work/a/store/b/c"])
def test_sources_and_stores_are_refused_even_with_force(work, out):
    for force in (False, True):
        with pytest.raises(UsageError, match="is never written over"):
            check_out(Path(out), work, (Path("wave.bvh"), None), force)


@pytest.mark.parametrize("out", ["a.mp4", "masks/x.mp4", "work/from-monday/a/store/x.mp4"])
def test_those_of_clips_of_the_same_name_are_refused_too(work, out):
    """`hugs fleet` gives them a work folder of their own."""
    (work / "from-monday").mkdir()
    (work / "a").rename(work / "from-monday/a")
    with pytest.raises(UsageError, match="is never written over"):
        check_out(Path(out), work, (), True)


def test_sources_are_known_by_any_name(work):
    Path("again.mp4").hardlink_to("a.mp4")
    Path("way").symlink_to("masks")
    for out in ("again.mp4", "way/1.png", "work/../a.mp4"):
        with pytest.raises(UsageError, match="is a source"):
            check_out(Path(out), work, (), True)


def test_what_others_made_needs_force(work):
    Path("dangling.mp4").symlink_to("nowhere.mp4")
    for out in ("other.mp4", "dangling.mp4"):
        with pytest.raises(UsageError, match="is already there") as caught:
            check_out(Path(out), work, (), False)
        assert "`--force`" in caught.value.hint
        check_out(Path(out), work, (), True)
    for out in ("new.mp4", "some/where/new.mp4"):
        check_out(Path(out), work, (), False)


def test_what_was_drawn_may_be_drawn_again_while_nobody_changes_it(work):
    out = Path("new.mp4")
    out.write_text("drawn")
    remember_out(out, work)
    check_out(out.absolute(), work, (), False)
    out.rename("moved.mp4")
    Path("moved.mp4").rename(out)
    check_out(out, work, (), False)
    out.write_text("edited")
    with pytest.raises(UsageError, match="is already there"):
        check_out(out, work, (), False)


def test_a_folder_is_free_if_empty_or_as_it_was_drawn(work):
    out = Path("views")
    out.mkdir()
    check_out(out, work, (), False, is_folder=True)
    (out / "1.png").write_text("drawn")
    remember_out(out, work)
    check_out(out, work, (), False, is_folder=True)
    (out / "note.txt").write_text("mine")
    with pytest.raises(UsageError, match="is already there"):
        check_out(out, work, (), False, is_folder=True)


def test_what_was_drawn_before_a_drawing_was_cut_short_may_be_drawn_again(work):
    outs = [Path("new.mp4"), Path("views"), Path("other.mp4"), Path("never.mp4")]
    with pytest.raises(KeyboardInterrupt), remembering(outs, work):
        Path("new.mp4").write_text("drawn")
        Path("views").mkdir()
        Path("views/1.png").write_text("drawn")
        raise KeyboardInterrupt
    check_out(outs[0], work, (), False)
    check_out(outs[1], work, (), False, is_folder=True)
    with pytest.raises(UsageError, match="is already there"):
        check_out(outs[2], work, (), False)


def test_only_drawings_that_are_still_there_are_remembered(work):
    for name in ("one.mp4", "two.mp4"):
        Path(name).write_text(name)
        remember_out(Path(name), work)
        Path(name).unlink()
    Path("two.mp4").write_text("two.mp4")
    Path("three.mp4").write_text("3")
    remember_out(Path("three.mp4"), work)
    known = json.loads((work / ".drawn.json").read_bytes())
    assert [Path(path).name for path in known] == ["two.mp4", "three.mp4"]


def test_pictures_are_not_drawn_over_a_file_nor_a_film_over_a_folder(work):
    with pytest.raises(UsageError, match="a file, and pictures need a folder"):
        check_out(Path("other.mp4"), work, (), True, is_folder=True)
    Path("views").mkdir()
    with pytest.raises(UsageError, match="a folder, and a video is a file"):
        check_out(Path("views"), work, (), True)
    with pytest.raises(UsageError, match=r"other\.mp4 is no folder"):
        check_out(Path("other.mp4/views"), work, (), True, is_folder=True)


def test_sources_that_no_result_is_made_of_are_drawn_to(work):
    """What a dry run or a run that failed was given: here the current folder, as cameras."""
    check_out(Path("new.mp4"), work, (), False)
    Path("work/a/store/train-01234567/stamp.json").unlink()
    check_out(Path("a.mp4"), work, (), True)
