"""`hugs costs --sweep` on a flow that trains nothing: what is run and in which order, the budget, the noise, what fails."""

from __future__ import annotations

import json

import pytest

from hugs_cli.studies import sweep as sweeps
from stages.commands import costs_page
from stages.formats.plot import Dot
from tests.made.said import holds
from tests.made.studies import TRAIN

MADE = (("train", "train.json"), ("evaluate", "metrics.json"))
SURVEY = """
def run(job, params, *, one):
    (job.out / "survey.json").write_text('{"decisions": {"view_dependence": false}}')
"""
LEVELS = ["steps_100", "steps_200", "steps_800", "caps_20_40", "caps_80_160", "sh_0", "sh_2", "sh_3"]


def sweep_(clip, *args: str, code: int = 0) -> tuple[str, str]:
    return clip.hugs("--pipeline", "tiny", "--sweep", *args, command="costs", code=code)


def test_a_dry_run_lists_every_case_and_runs_none(clip):
    out, err = sweep_(clip, "--dry-run", "--seeds", "2")
    first, *rows = out.splitlines()
    assert holds(first, "18 trainings", "0 cached", "18 to do", "about", "between")
    names = ["tiny", "tiny", *(f"tiny.{level}" for level in LEVELS * 2)]
    assert [row.split()[0] for row in rows] == names and not err and not clip.work.exists()
    assert [row.split()[2] for row in rows] == ["0", "1", *"0" * 8, *"1" * 8]


@pytest.mark.slow
def test_levels_are_set_beside_the_noise_of_the_pipeline_and_cached(clip):
    out, err = sweep_(clip, "--axis", "sh", "--seeds", "2", "--plot")
    drawn = (clip.work / "clip" / "sweep-tiny.svg").read_text()
    assert "Pareto front" in drawn and ">sh<" in drawn
    assert holds(err, "8 trainings", "0 cached", "8 to do")
    assert holds(err, "8 trainings", "1 cached", "7 to do"), "said again when it is known"
    assert holds(err, "error", "too many colours") and holds(out, "note", "tiny.sh_3.seed1 failed", "too many colours")
    assert err.endswith("work/clip/sweep-tiny.html\n")
    table = out.partition("whole picture")[2].partition("person")[0].splitlines()[1:-1]
    rows = {line.split()[0]: line.split()[1:4] for line in table}
    assert list(rows) == ["tiny", "tiny.sh_0", "tiny.sh_2"] and rows["tiny"][:2] == ["30.50", "±0.71"]
    assert rows["tiny.sh_2"] == ["30.51", "±0.71", "+0.01~"], "within the noise"
    assert all((clip.work / "clip" / f"sweep-tiny.{kind}").stat().st_size > 1000 for kind in ("svg", "png", "html"))
    counts = {name: len(list(clip.store.glob(f"{name}-*/{file}"))) for name, file in (("one", "out.txt"), *MADE)}
    assert counts == {"one": 1, "train": 6, "evaluate": 6}
    again, err = sweep_(clip, "--axis", "sh", "--seeds", "2", "--budget", "0")
    assert holds(err, "8 trainings", "6 cached", "2 to do") and again.partition("note")[0] == out.partition("note")[0]


@pytest.mark.slow
def test_a_budget_is_spent_in_order_on_what_fits_and_the_next_one_goes_on(clip):
    _, err = sweep_(clip, "--seeds", "1", "--budget", "0", code=2)
    assert holds(err, "error", "nothing", "sweep") and not list(clip.store.glob("*"))
    clip.hugs("--pipeline", "tiny")
    (stamp,) = clip.store.glob("train-*/stamp.json")
    stamp.write_text(json.dumps(json.loads(stamp.read_text()) | {"seconds": 600.0}))
    rows = json.loads(sweep_(clip, "--seeds", "1", "--budget", "11", "--dry-run", "--json")[0])
    found = {row["pipeline"]: (row["state"], row["seconds"]) for row in rows}
    assert found["tiny"] == ("cached", 0) and found["tiny.steps_100"] == ("now", pytest.approx(150, abs=10))
    assert found["tiny.steps_800"] == ("later", pytest.approx(1200, abs=10)), "too long"
    assert [name for name, (state, _) in found.items() if state == "now"] == ["tiny.steps_100", "tiny.steps_200"]
    out, err = sweep_(clip, "--seeds", "1", "--budget", "4", "--axis", "steps")
    assert holds(err, "4 trainings", "1 cached", "3 to do") and holds(err, "budget 4m 00s", "1 of them")
    assert holds(out, "note", "2 trainings left") and "tiny.steps_200" not in out
    result = json.loads(sweep_(clip, "--seeds", "1", "--budget", "6", "--axis", "steps", "--json")[0])
    assert [row["pipeline"] for row in result["rows"]] == ["tiny", "tiny.steps_100", "tiny.steps_200"]
    assert [row["axis"] for row in result["rows"]] == ["", "steps", "steps"] and result["left"] == 1
    quick = result["rows"][1]["scores"]["full"]["psnr"]
    assert quick["difference"] == -4.0 and quick["noise"] is None and "within_noise" not in quick
    assert result["rows"][1]["times"]["train"] == pytest.approx(10 / 600)


def test_a_line_goes_through_the_levels_of_an_axis_in_their_order_whatever_the_clock_said():
    steps = [("tiny", "", 1.0, 3.0), ("tiny.steps_800", "steps", 2.0, 2.5), ("tiny.steps_10000", "steps", 0.5, 2.7)]
    rows = [{"pipeline": name, "axis": axis, "expected_times": times} for name, axis, times, _ in steps]
    dots = {name: Dot(minutes, 20.0, 0.1, name) for name, _, _, minutes in steps}
    line, middle = costs_page.swept({"rows": rows}, dots)
    assert (line.name, [dot.label for dot in line.dots]) == ("steps", ["10k", "", "800"])
    assert [dot.x for dot in line.dots] == [2.7, 3.0, 2.5] and middle.name == "tiny" and middle.dots[0].spread == 0.1


@pytest.mark.slow
def test_what_survey_finds_that_a_clip_does_not_call_for_is_not_varied(clip):
    clip.write("survey", "'''Looks for gloss.'''\nfrom stages.contract import Params\n" + SURVEY)
    clip.write("train", TRAIN.replace("*, one", "*, one, survey"))
    needs = {"one": "video", "survey": "one", "train": "one, survey", "evaluate": "train"}
    lines = "".join(f"    {name}: {{needs: [{need}], module: flow.{name}}}\n" for name, need in needs.items())
    file = clip.folder / "pipelines.yaml"
    file.write_text(f"{file.read_text()}dull:\n  doc: Dull.\n  stages:\n{lines}")
    dull = ("--pipeline", "dull", "--sweep", "--seeds", "1", "--axis", "sh", "--axis", "steps")
    out, err = clip.hugs(*dull, command="costs")
    assert err.startswith("7 trainings") and holds(err, "4 trainings", "1 cached", "3 to do"), "known after the first"
    assert holds(out, "note", "sh", "view_dependence is off") and not holds(out, "trainings left")
    assert "dull.sh" not in out and "dull.steps_800" in out
    _, err = clip.hugs(*dull[:5], "--axis", "sh", command="costs", code=2)
    assert holds(err, "none", "settings") and "`--set survey.view_dependence=always`" in err


@pytest.mark.parametrize(
    ("seeds", "means", "spread", "within"),
    [
        ((3, 3), (30.0, 30.2), (0.1, 0.1), False),
        ((3, 1), (30.0, 30.2), (0.1, None), True),
        ((1, 1), (30, 31), (None, None), None),
    ],
)
def test_a_difference_counts_from_two_standard_errors_on(seeds, means, spread, within):
    base, level = ({"mean": m, "spread": s, "values": [m] * n} for n, m, s in zip(seeds, means, spread, strict=True))
    sweeps.add_difference(level, base)
    assert level.get("within_noise") == within and level["difference"] == pytest.approx(means[1] - means[0])


@pytest.mark.parametrize(
    ("args", "problem", "hint"),
    [
        (("--axis", "stpes"), ("axis", "stpes"), "steps"),
        (("--axis", "overlap"), ("tiny", "settings"), "hugs stages"),
        (("--pipeline", "tiny.sh_2"), ("tiny.sh_2", "variant"), "--pipeline tiny"),
        (("--pipeline", "default"), ("default", "settings"), "hugs stages"),
    ],
)
def test_what_cannot_be_swept_is_refused(clip, args, problem, hint):
    _, err = sweep_(clip, *args, code=2)
    assert holds(err, "error", *problem, "hint", hint)
