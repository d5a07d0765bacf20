"""`hugs run --within` on a pipeline that trains nothing: what training is given, what a second run does."""

from __future__ import annotations

import json

import pytest

from hugs_cli import options, times, within
from hugs_cli.console import Console
from hugs_cli.countdown import Progress
from hugs_cli.pipelines import UsageError
from hugs_cli.times import STAGE_START
from tests.made.flow import Flow
from tests.made.said import holds
from tests.made.timed import AFTER, add_tiny

FIT_STEPS = """from stages.contract import Params as Base

class Params(Base):
    fit_steps: int = 30

SHORTER = {"fit_steps": 0}

def cost(params, folders):
    return 2 * params.fit_steps
"""


@pytest.fixture
def clip(flow):
    """A flow that has not run."""
    return add_tiny(flow)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The flow after a run within a minute, and what that said; to be copied."""
    flow = add_tiny(Flow(tmp_path_factory.mktemp("within")))
    return flow, run(flow, "--within", "60s", "--json")


@pytest.fixture
def timed(finished, tmp_path):
    """The flow after a run within a minute."""
    return finished[0].copied(tmp_path)


def run(clip, *args: str, code: int = 0):
    return clip.hugs(*args, "--pipeline", "tiny", code=code)


def told(clip) -> dict:
    return json.loads((clip.work / "clip" / "tiny.60s" / "train" / "out.json").read_text())


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10m", 600), ("1h30m", 5400), ("2h", 7200), (" 5m ", 300)])
def test_times_are_read(text, seconds):
    assert within.seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "0m", "10", "5 m", "-5m", "1.5h", "m", "30s2m", "9" * 5000 + "m", "\u0661m"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(UsageError, match="is not a time"):
        within.seconds_of(text)


REFUSES = """
def check(params):
    from stages.contract import StageError
    raise StageError("a package is missing")
"""


@pytest.mark.slow
def test_stages_after_training_check_before_it_and_before_the_first(clip):
    run(clip, "one")
    clip.write("after", AFTER + REFUSES)
    for what in ("before training", "at once"):
        assert holds(run(clip, "--within", "60s", code=1)[1], "a package is missing"), what
        assert {path.name[:3] for path in clip.store.iterdir()} <= {"one"}
        clip.video.write_text("other pixels")


PAGE = """
'''Writes a letter for each start, and the stages that it saw last.'''
import json, time
from stages.contract import Params

def run(job, params):
    '''Write report.html.'''
    with open(job.out / "starts", "a") as file:
        file.write("x")
    while not (state := json.loads((job.out / ".report.json").read_text()))["over"]:
        time.sleep(0.02)
    (job.out / "report.html").write_text(" ".join(row["name"] for row in state["stages"]))
"""


@pytest.mark.slow
def test_one_page_grows_through_all_of_the_time(clip):
    clip.write("page", PAGE)
    file = clip.folder / "pipelines.yaml"
    file.write_text(file.read_text().replace("  doc: Tiny.\n", "  doc: Tiny.\n  report: flow.page\n"))
    _, err = run(clip, "--within", "60s")
    assert err.splitlines()[0] == "report: work/clip/tiny.60s/report.html"
    folder = clip.work / "clip" / "tiny.60s"
    assert (folder / "starts").read_text() == "x"
    assert (folder / "report.html").read_text() == "one train after"


@pytest.mark.slow
def test_training_gets_what_is_left_of_the_time_and_the_outcome_is_said(finished):
    clip, (out, err) = finished
    result = json.loads(out)
    assert result["pipeline"] == "tiny.60s" and [row["state"] for row in result["stages"]] == ["done", "done", "done"]
    kept, given = result["within"], told(clip)
    assert kept["promised"] == 60 and kept["took"] > 0
    least = 60 - kept["took"] - 2 * STAGE_START
    assert least <= given["seconds"] < 60 - 2 * STAGE_START
    assert kept["settings"] == {"train": {name: given[name] for name in ("seconds", "reserve", "reserve_least")}}
    assert given["reserve"] == given["reserve_least"] == 40 and given["size"] == 1
    assert holds(err, "left", "training") and holds(err, "promised", "1m 00s", "took")


@pytest.mark.slow
def test_a_second_run_trains_no_more_unless_forced(timed):
    before = told(timed)
    out, err = run(timed, "--within", "60s", "--json")
    assert {row["state"] for row in json.loads(out)["stages"]} == {"cached"} and told(timed) == before
    assert holds(err, "continuing", "training")
    out, err = run(timed, "--within", "60s", "--dry-run", "--json")
    assert "stale" not in out and "waiting" not in out, out
    out, err = run(timed, "--within", "60s", "--force", "--json")
    assert {row["state"] for row in json.loads(out)["stages"]} == {"done"} and "are left for training" in err


@pytest.mark.slow
def test_results_of_the_pipeline_itself_are_left_alone(clip):
    run(clip)
    mine = (clip.work / "clip" / "tiny" / "train" / "out.json").read_text()
    run(clip, "--within", "60s")
    assert (clip.work / "clip" / "tiny" / "train" / "out.json").read_text() == mine
    assert json.loads(mine)["seconds"] == 0


@pytest.mark.slow
def test_a_training_cut_short_goes_on_with_what_it_was_given(clip):
    (clip.folder / "stop").write_text("")
    run(clip, "--within", "60s", code=1)
    given = json.loads((clip.work / "clip" / "tiny.60s" / within.CHOSEN).read_text())
    (clip.folder / "stop").unlink()
    _, err = run(clip, "--within", "60s")
    assert told(clip) == given["train"] | {"size": 1} and "continuing the training" in err


@pytest.mark.slow
def test_changed_settings_are_timed_anew(timed):
    _, err = run(timed, "--within", "60s", "--set", "train.size=2")
    assert told(timed)["size"] == 2 and "are left for training" in err


def test_a_run_that_does_not_train_is_refused(clip):
    _, err = run(clip, "one", "--within", "60s", code=2)
    assert "--within" in err and "train" in err
    _, err = clip.hugs("--within", "60s", code=2)
    assert "--within" in err and "train" in err


@pytest.mark.slow
def test_its_results_have_a_name_for_other_commands(timed):
    states = json.loads(timed.hugs("--pipeline", "tiny.60s", "--json", command="status")[0])
    assert [row["state"] for row in states] == ["fresh"] * 3
    _, err = timed.hugs("--pipeline", "tiny.5m", command="status", code=2)
    assert holds(err, "no run", "tiny", "5m") and "--within 5m" in err


@pytest.mark.slow
def test_a_variant_within_a_time_has_a_name_too(clip):
    clip.edit("train", "    size: int = 1", "    size: int = 1\n    lbs_learning: bool = True")
    clip.hugs("--pipeline", "tiny.no_lbs", "--within", "60s")
    states = json.loads(clip.hugs("--pipeline", "tiny.no_lbs.60s", "--json", command="status")[0])
    assert [row["state"] for row in states] == ["fresh"] * 3
    _, err = clip.hugs("--pipeline", "tiny.no_lbs.5m", command="status", code=2)
    assert holds(err, "no run", "tiny.no_lbs", "5m")


def test_a_training_in_two_parts_is_refused_before_anything_runs(clip):
    clip.edit("train", "    size: int = 1", "    size: int = 1\n    joint: bool = True")
    _, err = run(clip, "--within", "60s", "--set", "train.joint=false", code=2)
    assert holds(err, "within", "person and scene") and "train.joint" in err


def with_measuring(clip) -> None:
    """A stage evaluate after train, that can do less."""
    clip.write("evaluate", AFTER.replace("from stages.contract import Params", FIT_STEPS))
    file = clip.folder / "pipelines.yaml"
    file.write_text(f"{file.read_text()}    evaluate: {{needs: [train], module: flow.evaluate}}\n")


@pytest.mark.slow
@pytest.mark.parametrize(("step", "fitted"), [(0.1, 30), (100.0, 0)])
def test_what_follows_a_training_takes_the_time_that_is_left_then(clip, step, fitted):
    """Sixty steps of a tenth of a second fit into what is left of a minute, sixty of a hundred seconds do not."""
    with_measuring(clip)
    clip.edit("train", '"last_step_seconds": 0.1', f'"last_step_seconds": {step}')
    out, err = run(clip, "--within", "60s", "--json")
    assert told(clip)["reserve"] == 100 and told(clip)["reserve_least"] == 40
    assert json.loads(out)["within"]["settings"]["evaluate"] == ({} if fitted else {"fit_steps": 0})
    assert holds(err, "held-out poses", "not fitted") is (fitted == 0)
    chosen = json.loads((clip.work / "clip" / "tiny.60s" / within.CHOSEN).read_text())
    assert chosen["evaluate"] == ({} if fitted else {"fit_steps": 0}) and "before" in chosen["guess"]
    out, _ = run(clip, "--within", "60s", "--json")
    assert {row["state"] for row in json.loads(out)["stages"]} == {"cached"}


@pytest.mark.slow
def test_what_cannot_fit_is_said_before_the_first_stage_and_ends_in_a_result(clip):
    _, err = run(clip, "--within", "1s")
    before, _, rest = err.partition("too short")
    assert rest and " one " not in before and holds(rest, "goes on", "took")
    assert (clip.work / "clip" / "tiny.1s" / "after" / "out.txt").exists()
    assert "too short" not in run(clip, "--within", "99h")[1]


@pytest.mark.slow
def test_results_within_a_time_are_kept_when_only_code_changes(timed):
    before = told(timed)
    timed.edit("train", "    if Path(", "    more = 1\n    if Path(")
    out, _ = timed.hugs("--pipeline", "tiny.60s", command="accept")
    assert out.count("train accepted: ") == 1
    out, _ = run(timed, "--within", "60s", "--json")
    assert {row["state"] for row in json.loads(out)["stages"]} == {"cached"} and told(timed) == before
    timed.edit("train", "more = 1", "more = 2")
    assert "`hugs accept clip.mp4 --pipeline tiny.60s`" in run(timed, "--within", "60s")[1]


@pytest.mark.parametrize("given", [1.0, 0.5, 0.2])
def test_a_busy_machine_is_part_of_the_first_guess(clip, monkeypatch, given):
    monkeypatch.setattr(times, "free", lambda: (given, given))
    monkeypatch.setattr(times, "kept", list)
    monkeypatch.syspath_prepend(clip.folder)
    run = options.RunOptions(pipeline="tiny", work=clip.work, pipelines_file=clip.folder / "pipelines.yaml")
    session = run.session(clip.folder / "clip.mp4")
    promise = within.Promise(session, list(session.pipeline.stages), 60)
    console = Console()
    guess = promise._guess(frozenset(), False, "cpu", console)
    assert guess["share"] == given and guess["before"] == pytest.approx(STAGE_START / given, abs=0.06)
    least = times.usual("tiny", "train", times.Sizes(steps=within.LEAST)) + 2 * STAGE_START
    assert guess["from"] == pytest.approx(least / given, abs=0.06)
    assert [name for name, _ in console.countdown.stages] == ["one", "train", "after"]
    assert console.countdown.left("one", Progress(0.0), 0.0) >= 60, "training is expected to take what is left"
