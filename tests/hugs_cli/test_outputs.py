"""Where drawings go: never over a source or a result, and over what others made only with --force."""

from __future__ import annotations

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hugs_cli.cache.fingerprint import content_digest
from hugs_cli.outputs import check_out, remembering
from hugs_cli.pipelines import UsageError
from stages.contract import Job


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


def draw(out: Path, work: Path, text: str = "drawn") -> None:
    """As commands do."""
    with Job(Path(), emit=remembering(work, pytest.fail)).writes(out) as part:
        part.write_text(text)


@pytest.mark.parametrize("out", ["a.mp4", "masks/x.mp4", "masks", "wave.bvh", "work/a/store/x.mp4", "work/a/store/b/c"])
def test_sources_and_stores_are_refused_even_with_force(work, out):
    for force in (False, True):
        with pytest.raises(UsageError, match=r"source|result"):
            check_out(Path(out), work, (Path("wave.bvh"), None), force)


@pytest.mark.parametrize("out", ["a.mp4", "masks/x.mp4", "work/from-monday/a/store/x.mp4"])
def test_those_of_clips_of_the_same_name_are_refused_too(work, out):
    """`hugs fleet` gives them a work folder of their own."""
    (work / "from-monday").mkdir()
    (work / "a").rename(work / "from-monday/a")
    with pytest.raises(UsageError, match=r"source|result"):
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
        with pytest.raises(UsageError, match=out) as caught:
            check_out(Path(out), work, (), False)
        assert "`--force`" in caught.value.hint
        check_out(Path(out), work, (), True)
    for out in ("new.mp4", "some/where/new.mp4"):
        check_out(Path(out), work, (), False)


def test_what_was_drawn_may_be_drawn_again_while_nobody_changes_it(work):
    out = Path("new.mp4")
    draw(out, work)
    check_out(out.absolute(), work, (), False)
    out.rename("moved.mp4")
    Path("moved.mp4").rename(out)
    check_out(out, work, (), False)
    out.write_text("edited")
    with pytest.raises(UsageError, match=str(out)):
        check_out(out, work, (), False)


def test_a_folder_is_free_if_empty_or_as_it_was_drawn(work):
    out = Path("views")
    out.mkdir()
    check_out(out, work, (), False, is_folder=True)
    draw(out / "1.png", work)
    check_out(out, work, (), False, is_folder=True)
    (out / "note.txt").write_text("mine")
    with pytest.raises(UsageError, match="views"):
        check_out(out, work, (), False, is_folder=True)


class Killed(BaseException):
    """Nothing after it runs."""


@pytest.mark.parametrize("step", ["os.replace", "hugs_cli.outputs.replace"])
@pytest.mark.parametrize("late", [False, True])
def test_what_a_killed_command_drew_may_be_drawn_again(work, monkeypatch, step, late):
    """Killed before or after any of its last steps: what is there then is known."""
    module, name = step.rsplit(".", 1)
    done = getattr(sys.modules[module], name)

    def kill(*args: object) -> None:
        if late:
            done(*args)
        raise Killed

    out = Path("new.mp4")
    for text in ("", "drawn before"):
        if text:
            draw(out, work, text)
        for _ in range(5):
            with monkeypatch.context() as patch, pytest.raises(Killed):
                patch.setattr(step, kill)
                draw(out, work, "drawn")
            check_out(out, work, (), False)
            assert not out.exists() or out.read_text() in (text, "drawn")
    Path("other.mp4").write_text("not ours")
    with pytest.raises(UsageError, match=r"other\.mp4"):
        check_out(Path("other.mp4"), work, (), False)


def test_two_commands_at_once_note_what_both_drew(work):
    outs = [Path(f"{number}.mp4") for number in range(40)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda out: draw(out, work), outs))
    for out in outs:
        check_out(out, work, (), False)


def test_only_drawings_that_are_still_there_are_remembered(work, monkeypatch):
    monkeypatch.setattr("hugs_cli.outputs.MOST", 1)
    for name in ("one.mp4", "two.mp4"):
        draw(Path(name), work)
        Path(name).unlink()
    draw(Path("three.mp4"), work)
    draw(Path("four.mp4"), work)
    known = json.loads((work / ".drawn.json").read_bytes())
    assert [Path(path).name for path in known] == ["three.mp4", "four.mp4"]


def test_what_an_older_version_noted_is_known(work):
    (work / ".drawn.json").write_text(
        json.dumps({str(Path("other.mp4").absolute()): content_digest(Path("other.mp4"))})
    )
    check_out(Path("other.mp4"), work, (), False)
    draw(Path("other.mp4"), work)
    check_out(Path("other.mp4"), work, (), False)


@pytest.fixture
def other(work, tmp_path) -> Path:
    """The folder of links of a finished run in another work folder, of a film that lies elsewhere."""
    store, links = tmp_path / "A/work/kitchen/store/train-01234567", tmp_path / "A/work/kitchen/default"
    for folder in (store, links, tmp_path / "B"):
        folder.mkdir(parents=True)
    for file in (store / "scene.ply", tmp_path / "B/kitchen.mp4"):
        file.write_text("kept")
    (store / "stamp.json").write_text(json.dumps({"inputs": {"video": "digest"}}))
    (links / "train").symlink_to("../store/train-01234567")
    (tmp_path / "A/work/kitchen/sources.json").write_text(
        json.dumps({"video": {"path": str(tmp_path / "B/kitchen.mp4"), "sha256": "digest"}})
    )
    (tmp_path / "copy").symlink_to("A/work/kitchen/default/train")
    return links


@pytest.mark.parametrize(
    "out",
    [
        "A/work/kitchen/default/train/scene.ply",
        "A/work/kitchen/store/train-01234567/new.mp4",
        "A/work/kitchen/store/train-01234567/deeper/new.mp4",
        "A/work/kitchen/store/new.mp4",
        "copy/scene.ply",
        "copy/../scene.ply",
        "B/kitchen.mp4",
    ],
)
def test_results_of_other_work_folders_and_sources_of_runs_are_refused_even_with_force(work, other, out):
    with pytest.raises(UsageError, match=r"source|result"):
        check_out(Path(out), work, (other,), True)


def test_a_link_in_the_place_of_an_output_gives_way_and_what_it_leads_to_stays(work):
    Path("views").mkdir()
    Path("views/1.png").symlink_to("../a.mp4")
    Path("views/2.png").hardlink_to("wave.bvh")
    Path("views/3.png").symlink_to("nowhere")
    for name in ("1", "2", "3"):
        draw(Path(f"views/{name}.png"), work)
        assert Path(f"views/{name}.png").read_text() == "drawn" and not Path(f"views/{name}.png").is_symlink()
    assert Path("a.mp4").read_text() == "a.mp4" and Path("wave.bvh").read_text() == "wave.bvh"
    check_out(Path("views"), work, (), False, is_folder=True)


def test_pictures_are_not_drawn_over_a_file_nor_a_film_over_a_folder(work):
    with pytest.raises(UsageError, match=r"other\.mp4"):
        check_out(Path("other.mp4"), work, (), True, is_folder=True)
    Path("views").mkdir()
    with pytest.raises(UsageError, match=r"views\b"):
        check_out(Path("views"), work, (), True)
    with pytest.raises(UsageError, match=r"other\.mp4\b"):
        check_out(Path("other.mp4/views"), work, (), True, is_folder=True)


def test_sources_that_no_result_is_made_of_are_drawn_to(work):
    """What a dry run or a run that failed was given: here the current folder, as cameras."""
    check_out(Path("new.mp4"), work, (), False)
    Path("work/a/store/train-01234567/stamp.json").unlink()
    check_out(Path("a.mp4"), work, (), True)
