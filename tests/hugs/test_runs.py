"""`hugs.run`: results, cache, errors and Ctrl-C of the command, from this process."""

import inspect
import json
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

import hugs
from hugs_cli import app
from hugs_cli.options import RunOptions
from tests.made.flow import ALL, WHOLE, Flow
from tests.made.said import holds
from tests.made.timed import add_tiny

FILE = "pipelines.yaml"


@pytest.fixture
def flow(tmp_path, monkeypatch):
    """A small pipeline in the current folder; what `run` loads is the folder itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(sys.modules, "hugs.avatar", SimpleNamespace(load=lambda folder: folder))
    yield Flow(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "flow"]:
        del sys.modules[name]


def ended(heard: list[hugs.Progress]) -> list[tuple[str, str]]:
    return [(one.stage, one.state) for one in heard if one.state not in ("", "running")]


@pytest.mark.slow
def test_a_run_is_that_of_the_command_and_any_thread_may_call_it(flow):
    heard: list[hugs.Progress] = []
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(hugs.run, "clip.mp4", progress=heard.append, pipelines_file=FILE)
    assert call.result() == Path("work/clip/default") and flow.text("four") == WHOLE
    assert ended(heard) == [(name, "done") for name in ALL]
    assert flow.ran() == {}, "the command finds all of it"
    heard.clear()
    hugs.run("clip.mp4", settings={"four.word": "z"}, progress=heard.append, pipelines_file=FILE)
    assert ended(heard) == [(name, "cached") for name in ALL[:-1]] + [("four", "done")]
    assert flow.text("four").startswith("four:z") and any(
        holds(one, "four", "a -> z") for now in heard for one in now.said
    )


@pytest.mark.slow
def test_ctrl_c_stops_the_stage_and_the_next_call_goes_on(flow):
    before, pressed = signal.getsignal(signal.SIGINT), []

    def press(now: hugs.Progress) -> None:
        if now.stage == "three" and now.done >= 2 and not pressed:
            pressed.append(now)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="three"):
        hugs.run("clip.mp4", settings={"three.delay": 1.0}, progress=press, pipelines_file=FILE)
    assert not (flow.work / "clip/default/three").exists() and signal.getsignal(signal.SIGINT) is before
    heard: list[hugs.Progress] = []
    hugs.run("clip.mp4", progress=heard.append, pipelines_file=FILE)
    said = " ".join(one for now in heard if now.stage == "three" for one in now.said)
    assert "began at step" in said and "began at step 0" not in said and flow.text("four") == WHOLE


@pytest.mark.slow
def test_a_run_within_a_time_is_that_of_the_command(flow):
    add_tiny(flow)
    heard: list[hugs.Progress] = []
    folder = hugs.run("clip.mp4", "tiny", within="60s", progress=heard.append, pipelines_file=FILE)
    assert folder == Path("work/clip/tiny.60s") and ended(heard) == [(n, "done") for n in ("one", "train", "after")]
    assert 0 < json.loads((folder / "train" / "out.json").read_text())["seconds"] < 60
    assert any(holds(one, "promised", "1m 00s", "took") for now in heard for one in now.said)
    assert flow.ran("--pipeline", "tiny", "--within", "60s") == {}, "the command finds all of it"
    hugs.run("clip.mp4", "tiny", within="60s", force=True, progress=heard.append, pipelines_file=FILE)
    assert ended(heard)[3:] == ended(heard)[:3], "no stage is found when all are forced"
    for text, pipeline, fact in (("", "tiny", "is not a time"), ("soon", "tiny", "soon"), ("60s", "default", "train")):
        with pytest.raises(hugs.StageError, match=fact):
            hugs.run("clip.mp4", pipeline, within=text, pipelines_file=FILE)


def test_all_that_a_run_may_be_given_may_be_given_from_python(monkeypatch):
    """The options of the command, but `--set`, which is `settings`, and those of what it prints and of which stages it runs."""
    taken = set(inspect.signature(app.run).parameters) - {"set_", "stages", "dry_run", "as_json"}
    assert taken <= set(inspect.signature(hugs.run).parameters)
    seen: list[RunOptions] = []
    monkeypatch.setattr("hugs.runs._finish", lambda given, *rest: seen.append(given))
    monkeypatch.setitem(sys.modules, "hugs.avatar", SimpleNamespace(load=lambda folder: folder))
    hugs.run("clip.mp4", landmarks="points.json", height=[1.85, "6ft1"], scale="2.31=2.00")
    hugs.run("clip.mp4", height=1.7)
    assert [one.height for one in seen] == [["1.85", "6ft1"], ["1.7"]]
    assert (seen[0].landmarks, seen[0].scale) == (Path("points.json"), "2.31=2.00")


@pytest.mark.slow
def test_errors_carry_facts_and_hint(flow):
    with pytest.raises(hugs.StageError, match="seed"):
        hugs.run("clip.mp4", seed=-1)
    with pytest.raises(hugs.StageError) as refused:
        hugs.run("clip.mp4", settings={"one.wort": 1}, pipelines_file=FILE)
    assert holds(str(refused.value), "wort", "hint: did you mean `word`?")
    flow.edit(
        "helper",
        "# with a comment",
        'from stages.contract import StageError; raise StageError("no luck", "wait", ["2 of 3"])',
    )
    with pytest.raises(hugs.StageError) as failed:
        hugs.run("clip.mp4", progress=lambda now: None, pipelines_file=FILE)
    assert str(failed.value).splitlines() == ["no luck", "  2 of 3", "hint: wait"]
