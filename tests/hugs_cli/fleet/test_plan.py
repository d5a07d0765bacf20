"""What is fresh, judged in this process: fast, and as `hugs run --dry-run` judges."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from hugs_cli import times
from hugs_cli.fleet import plan as plans
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.history import History
from hugs_cli.fleet.plan import plan
from hugs_cli.times import Times
from tests.made.said import holds

NONE = History({}), Times([])


def row(name: str, pipeline: str = "short", **more) -> Row:
    return Row(Path(f"clips/{name}.mp4"), Path("work"), pipeline, **more)


@pytest.mark.slow
def test_each_row_has_its_own_verdict(fleet, common):
    fleet.forked("clips/c00000.mp4", "--pipeline", "short", "--jobs", "1")
    rows = [row("c00000"), row("c00001"), row("c00000", "default"), row("gone"), row("c00001", "nowhere")]
    rows.append(row("c00000", settings=("one.word=b",)))
    known = Times([times.Row("one", "flow.one", "short", "cpu", 2, times.Sizes(), 4.0)])
    found = plan(rows, common, History({"short": 2**30}), known, split=False)
    assert [one.state for one in found] == ["fresh", "todo", "todo", "failed", "failed", "todo"]
    assert [len(one.todo) for one in found] == [0, 1, 3, 0, 0, 1]  # the first stage is shared by both pipelines
    assert [one.seconds for one in found[:3]] == [0, 4, 3 * times.STAGE_START] and found[1].megabytes == 200 + 1280
    assert holds(found[3].problem, "video", "clips/gone.mp4") and holds(found[4].problem, "pipeline", "nowhere")
    assert found[0].result["seconds"] >= 0
    fleet.edit("helper", "# with a comment", "print('other code')")
    assert [one.state for one in plan(rows[:2], common, *NONE, split=False)] == ["todo", "todo"]
    (fleet.clips / "c00000.mp4").write_text("other pixels, seen without a run")
    assert plan(rows[:1], common, *NONE, split=False)[0].todo == ["one"]


def test_a_new_clip_is_not_read(fleet, common, monkeypatch):
    """The first stage is missing whatever the clip holds: reading a thousand new ones would take an hour."""
    monkeypatch.setattr(plans.Session, "verdicts", lambda *_: pytest.fail("it was read"))
    assert plan([row("c00000", "default")], common, *NONE, split=False)[0].todo == ["one", "two", "three", "four"]


def test_code_and_pipeline_are_read_once(fleet, common, monkeypatch):
    opened, looked = [], []
    keep_open, keep_look = plans.session_of, plans.Code.read
    monkeypatch.setattr(plans, "session_of", lambda *args: opened.append(args) or keep_open(*args))
    monkeypatch.setattr(plans.Code, "read", lambda self, *which: looked.append(which[0]) or keep_look(self, *which))
    for name in ("c00000", "c00001"):
        (fleet.work / name / "store").mkdir(parents=True)
    found = plan([row("c00000"), row("c00001")], common, *NONE, split=False)
    assert [one.state for one in found] == ["todo", "todo"] and len(opened) == 1 and looked.count("flow.one") == 1


def test_rows_that_differ_in_the_person_alone_are_not_one(fleet, common, monkeypatch):
    opened = []
    monkeypatch.setattr(
        plans, "session_of", lambda one, common: opened.append(one.person) or plans.Session.__new__(plans.Session)
    )
    monkeypatch.setattr(plans, "replace", lambda session, **more: session)
    monkeypatch.setattr(plans.Session, "sources", {}, raising=False)
    open_ = plans.opener(common)
    for person in ("1", "2", None, "1"):
        open_(row("c00000", person=person))
    assert opened == ["1", "2", None]


def test_what_is_shown_of_a_finished_row(tmp_path):
    """The effects that were called for, without the scene, which is none; a frame of the middle of the clip."""
    folders = {name: tmp_path / f"{name}-0123" for name in ("frames", "survey")}
    for folder in folders.values():
        folder.mkdir()
    decisions = {"scene": True, "shadow": True, "sky": False, "lens": True}
    (folders["survey"] / "survey.json").write_text(json.dumps({"decisions": decisions}))
    files = {f"images/{i:06d}.png": "" for i in range(7)} | {"frames.json": ""}
    stamps = {name: SimpleNamespace(files=files, seconds=1.5, peak_memory_bytes=7, warnings=[]) for name in folders}
    (tmp_path / "report.html").touch()
    shown = plans.result_of(stamps, folders, tmp_path)
    assert shown["effects"] == ["shadow", "lens"] and shown["picture"] == "frames-0123/images/000003.png"
    assert shown["seconds"] == 3 and shown["psnr"] is None and shown["pages"] == ["report.html"]


def test_a_pipeline_without_training_cannot_be_split(fleet, common):
    for pipeline in ("short", "default"):
        found = plan([row("c00000", pipeline)], common, *NONE, split=True)
        assert found[0].state == "failed" and "no stage 'train'" in found[0].problem


def test_an_error_of_the_system_is_that_row_s_alone(fleet, common, monkeypatch):
    def broken(*_: object) -> None:
        raise OSError(5, "Input/output error", "clips/c00000.mp4")

    monkeypatch.setattr(plans, "verdict", broken)
    found = plan([row("c00000")], common, *NONE, split=False)
    assert found[0].state == "failed" and "Input/output error" in found[0].problem
