"""The page of a pipeline while its stages run. The module that makes it here writes down each state that it sees."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest

from hugs_cli.cache.report import STATE, Report
from tests.made.flow import LONGEST

PAGE = '''
"""Writes the states that it has seen."""
import json, os, time
from stages.contract import Params as Base, whole

class Params(Base):
    pass

def run(job, params):
    """Write report.html."""
    if os.path.exists(job.out / "break"):
        raise ValueError("no page today")
    seen = []
    while True:
        state = json.loads((job.out / ".report.json").read_text())
        if not seen or state != seen[-1]:
            seen.append(state)
            with whole(job.out / "report.html") as part:
                part.write_text(json.dumps(seen))
        if state["over"]:
            return
        time.sleep(0.02)
'''


@pytest.fixture
def shown(flow):
    """The flow, with a report."""
    flow.write("page", PAGE)
    file = flow.folder / "pipelines.yaml"
    file.write_text(file.read_text().replace("  doc: Four.\n", "  doc: Four.\n  report: flow.page\n"))
    return flow


def states(flow, page="work/clip/default/report.html"):
    """The states that the page has seen, each as stage -> state."""
    seen = json.loads((flow.folder / page).read_text())
    return [{row["name"]: row["state"] for row in state["stages"]} for state in seen], seen[-1]


@pytest.mark.slow
def test_the_page_is_named_first_grows_and_ends_with_all_results(shown):
    out, err = shown.hugs("--set", "two.delay=1")
    assert err.splitlines()[0] == "report: work/clip/default/report.html" and out == "work/clip/default/report.html\n"
    seen, last = states(shown)
    assert {"one": "done", "two": "running", "three": "waits", "four": "waits"} in seen
    assert set(seen[-1].values()) == {"done"} and last["over"] and last["clip"] == "clip.mp4"
    assert all(os.path.isdir(row["folder"]) and row["seconds"] >= 0 for row in last["stages"])
    page = shown.folder / "work/clip/default/report.html"
    before = page.stat().st_mtime_ns
    shown.hugs("--set", "two.delay=1")
    assert page.stat().st_mtime_ns == before, "nothing new: the page stays"
    page.unlink()
    shown.hugs()
    assert set(states(shown)[0][-1].values()) == {"done"}, "a page that is gone is made again"
    shown.edit("page", "Writes the states", "Writes down the states")
    shown.edit("page", "0.02", "0.03")
    before = page.stat().st_mtime_ns
    shown.hugs()
    assert page.stat().st_mtime_ns != before, "another way to make it"


def test_a_run_that_is_refused_names_a_page_only_where_one_is_left_of_an_earlier_run(shown):
    refuses = """
def check(params, *, video):
    from stages.contract import StageError
    if params.word == "x":
        raise StageError("no such word")
"""
    shown.write("two", (shown.package / "two.py").read_text() + refuses)
    _, err = shown.hugs("--set", "two.word=x", code=1)
    assert err.splitlines()[0].startswith("error: no such word") and "report.html" not in err
    shown.hugs()
    _, err = shown.hugs("--set", "two.word=x", code=1)
    assert err.splitlines()[0] == "report: work/clip/default/report.html" and "no such word" in err
    (shown.folder / "work/clip/default/report.html").unlink()
    _, err = shown.hugs("--set", "two.word=x", code=1)
    assert " cached " in err and "report.html" not in err


@pytest.mark.slow
def test_a_run_of_some_stages_keeps_what_the_others_have(shown):
    shown.hugs()
    shown.hugs("two", "--set", "two.word=b")
    assert states(shown)[0][-1] == {"one": "done", "two": "done", "three": "done"}, "four is of another two"
    shown.hugs("two")
    assert set(states(shown)[0][-1]) == {"one", "two", "three", "four"}


@pytest.mark.slow
def test_a_stage_that_fails_ends_the_page_with_its_error(shown):
    fault = "from stages.contract import StageError\n    raise StageError('no luck', 'try', ['1 of 2'])"
    shown.edit("three", "from flow import helper", f"{fault}\n    from flow import helper")
    shown.hugs(code=1)
    seen, last = states(shown)
    assert seen[-1]["three"] == "failed" and seen[-1]["one"] == "done" and last["over"]
    assert last["error"] == {"problem": "no luck", "facts": ["1 of 2"], "hint": "try"}


@pytest.mark.slow
def test_a_page_that_cannot_be_made_loses_no_result_and_is_said(shown):
    (shown.folder / "work/clip/default").mkdir(parents=True)
    (shown.folder / "work/clip/default/break").touch()
    _, err = shown.hugs(code=1)
    assert "no page today" in err and shown.text("four")
    (shown.folder / "work/clip/default/break").unlink()
    _, err = shown.hugs()
    assert err.count(" cached ") == 4 and set(states(shown)[0][-1].values()) == {"done"}


@pytest.mark.slow
def test_a_run_that_is_stopped_leaves_a_page_that_is_over(shown):
    process = shown.start(*shown.hold("three"))
    shown.wait_for(lambda: (shown.folder / "work/clip/default/report.html").exists()
                   and states(shown)[0][-1].get("three") == "running")  # fmt: skip
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=LONGEST)
    assert process.returncode == 130 and states(shown)[1]["over"] and states(shown)[0][-1]["three"] == "stopped"


def test_a_clip_whose_name_is_no_text_is_shown(tmp_path):
    """Its page is a text."""
    session = SimpleNamespace(
        video=Path(os.fsdecode(b"Bj\xf6rn.mp4")),
        pipeline=SimpleNamespace(name="default"),
        workspace=SimpleNamespace(links=tmp_path),
    )
    Report(session, "flow.page", ["one"], 0).write(over=True)
    assert json.loads((tmp_path / STATE).read_text())["clip"] == "Bj\ufffdrn.mp4"


def test_a_report_that_no_module_makes_is_refused(shown):
    file = shown.folder / "pipelines.yaml"
    file.write_text(file.read_text().replace("flow.page", "flow.pgae"))
    assert "no module flow.pgae" in shown.hugs(code=2)[1]
