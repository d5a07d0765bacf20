"""What the world does to a run: full disks, files that vanish or change, clocks that go back, names that lead elsewhere."""

from __future__ import annotations

import errno
import json
import os
import time
from pathlib import Path

import pytest

from hugs_cli import app
from hugs_cli.cache import child, engine
from hugs_cli.cache.freshness import Recipe
from hugs_cli.cache.workspace import Stamp, clip_name
from hugs_cli.pipelines import UsageError
from tests.made.flow import ALL, LONGEST, WHOLE
from tests.made.said import holds

FULL = "open('/dev/full', 'w').write('x' * 100_000); "


def kept(flow) -> dict[str, str]:
    """Folder of each finished result -> digest of its content, the bytes compared with the stamp."""
    stamps = {folder.name: Stamp.read(folder) for folder in flow.store.iterdir() if folder.suffix != ".part"}
    assert all(stamp and not stamp.damage(flow.store / name) for name, stamp in stamps.items())
    return {name: stamp.content for name, stamp in stamps.items()}


@pytest.mark.slow
def test_a_full_disk_stops_a_stage_and_keeps_what_is_finished(flow):
    flow.edit("two", "from flow import helper", FULL + "from flow import helper")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "disk is full", "hint", "hugs gc") and "Traceback" not in err
    before = kept(flow)
    assert [name[:3] for name in before] == ["one"]
    flow.edit("two", FULL, "")
    ran = flow.ran()
    assert list(ran) == ["two", "three", "four"] and before.items() <= kept(flow).items()
    assert flow.text("four") == WHOLE


@pytest.mark.slow
def test_a_full_disk_stops_the_run_itself_and_the_result_stands(flow):
    (flow.work / "clip").mkdir(parents=True)
    (flow.work / "clip" / "runs.jsonl").symlink_to("/dev/full")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "disk is full") and "Traceback" not in err
    assert [name[:3] for name in kept(flow)] == ["one"]
    (flow.work / "clip" / "runs.jsonl").unlink()
    assert list(flow.ran()) == ["two", "three", "four"]


def test_a_result_made_on_a_disk_that_is_full_now_is_not_believed(importable, monkeypatch):
    """Libraries in C cut files short there and report success."""
    from hugs_cli.options import RunOptions

    monkeypatch.chdir(importable.folder)
    session = RunOptions(pipelines_file=Path("pipelines.yaml")).session(Path("clip.mp4"))
    stage = session.pipeline.stages["two"]
    recipe = Recipe("two", 0, {}, {}, {"one": "its content"})
    assert engine.distrust(session, stage, recipe, importable.folder) is None
    monkeypatch.setattr(engine, "FULL_DISK", 1 << 62)
    assert holds(engine.distrust(session, stage, recipe, importable.folder)["problem"], "disk is full")


def test_a_full_disk_behind_the_error_of_a_library_is_found():
    def wrapped() -> None:
        try:
            raise OSError(errno.EFBIG, "File too large")
        except OSError:
            raise RuntimeError("unexpected pos 704 vs 598")  # noqa: B904  as torch.save does

    with pytest.raises(RuntimeError) as caught:
        wrapped()
    assert holds(child.error_event(caught.value, "x.part")["problem"], "disk", "full", "x.part")


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.EPERM])
def test_a_folder_that_may_only_be_read(flow, number, monkeypatch, capsys):
    def forbidden(*_, **__):
        raise OSError(number, os.strerror(number), "work/clip/store/two.part")

    assert holds(child.error_event(OSError(number, "no", "out/x"), "out")["problem"], "out/x")
    monkeypatch.chdir(flow.folder)
    monkeypatch.syspath_prepend(str(flow.folder))
    monkeypatch.setattr(engine, "make", forbidden)
    monkeypatch.setattr(app.signal, "signal", lambda *_: None)
    monkeypatch.setattr(child, "prepare", lambda: None)
    monkeypatch.setattr("sys.argv", ["hugs", "run", "clip.mp4", "--pipelines-file", "pipelines.yaml"])
    with pytest.raises(SystemExit) as end:
        app.main()
    err = capsys.readouterr().err
    assert end.value.code == 1 and holds(err, "error", "work/clip/store/two.part") and "--work" in err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_store_that_may_only_be_read(flow):
    flow.hugs("one")
    flow.store.chmod(0o555)
    _, err = flow.hugs(code=1)
    flow.store.chmod(0o755)
    assert holds(err, "error", "write") and "Traceback" not in err and kept(flow)


@pytest.mark.slow
def test_a_video_that_vanishes_while_it_is_read(flow):
    run = flow.start(*flow.hold("one"))
    flow.wait_for(lambda: list(flow.store.glob("one-*.part/step0")))
    flow.video.rename(flow.folder / "away")
    flow.go()
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 1 and holds(err, "clip.mp4", "cannot be read") and "Traceback" not in err
    assert holds(err, "hint", "run again") and kept(flow) == {}
    (flow.folder / "away").rename(flow.video)
    assert len(reasons := flow.ran()["one"]) == 2 and holds(reasons[1], "last run")


@pytest.mark.slow
def test_a_video_that_changes_while_it_is_read_makes_no_result(flow):
    run = flow.start(*flow.hold("one"))
    flow.wait_for(lambda: list(flow.store.glob("one-*.part/step0")))
    flow.video.write_text("other pixels")
    flow.go()
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 1 and holds(err, "error", "clip.mp4", "changed", "one")
    assert kept(flow) == {}
    flow.hugs()
    assert "other pixels" in flow.text("four")


def test_a_link_to_nothing_in_a_folder_of_pictures(flow):
    flow.video.unlink()
    flow.video.mkdir()
    (flow.video / "a.png").symlink_to("nowhere.png")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "clip.mp4/a.png", "cannot be read") and "Traceback" not in err


@pytest.mark.slow
def test_a_clock_that_goes_back_changes_nothing(made):
    before, ahead = kept(made), time.time() + 4e8
    for path in [*made.work.rglob("*"), made.video]:
        os.utime(path, (ahead, ahead), follow_symlinks=False)
    for file in made.store.glob("*/stamp.json"):
        file.write_text(file.read_text().replace('"made": "2', '"made": "3'))
    out, err = made.hugs()
    assert err.count(" cached ") == 4 and kept(made) == before
    out, _ = made.hugs(command="status")
    assert out.count("fresh") == 4 and out.count("just now") == 4
    assert made.ran("--set", "four.word=b") == {"four": ["params.word: a -> b"]}


@pytest.mark.parametrize("name", ["..", "/", "...mp4", "..mp4"])
def test_a_clip_without_a_name_is_refused_not_written_elsewhere(tmp_path, monkeypatch, name):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    if name == "..":
        assert clip_name(Path(name)) == tmp_path.name
        return
    with pytest.raises(UsageError) as error:
        clip_name(Path(name))
    assert holds(error.value.problem, "named")


@pytest.mark.parametrize("name", ["../../x", "/x", "..", "a/b", ""])
def test_stages_with_names_that_lead_elsewhere_are_refused(flow, name):
    file = flow.folder / "pipelines.yaml"
    file.write_text(file.read_text().replace("    one:", f"    {json.dumps(name)}:"))
    before = set(flow.folder.rglob("*"))
    _, err = flow.hugs(code=2)
    assert "cannot name a stage" in err
    assert {path for path in set(flow.folder.rglob("*")) - before if "__pycache__" not in str(path)} == set()


@pytest.mark.slow
def test_a_broken_memory_of_earlier_runs_costs_time_only(made):
    (made.work / "clip" / "sources.json").write_text("[1")
    (made.work / ".code.json").write_text('{"format": 1, "modules": [2]}')
    assert made.ran() == {}


@pytest.mark.slow
def test_all_names_are_those_of_the_pipeline(made):
    assert sorted(name.rpartition("-")[0] for name in kept(made)) == sorted(ALL)
