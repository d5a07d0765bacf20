"""Whole fleets of stand-ins, and what the world does to them."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import re
import signal
from collections import Counter
from pathlib import Path

import pytest

from hugs_cli.cache.workspace import read_json
from hugs_cli.fleet import lease
from hugs_cli.fleet.job import SNAKEMAKE_LOG
from tests.made.fleet import WAYS, Fleet, states
from tests.made.flow import LONGEST
from tests.made.said import holds
from tests.tools.fleet_kills import below, what

pytestmark = pytest.mark.slow
HAS_SNAKEMAKE = importlib.util.find_spec("snakemake") is not None
needs_snakemake = pytest.mark.skipif(not HAS_SNAKEMAKE, reason="Snakemake is not installed: pip install -e '.[fleet]'")
WEAK = "import fcntl\nfcntl.flock = lambda *_: None\n"  # sitecustomize: a file system whose locks hold nobody back
PAIR = ("--pipeline", "pair", "--jobs", "1")
FULL = """import builtins
keep = builtins.open
def full(file, mode="r", *more, **how):
    if ("/rows/" in str(file) or "work/.hugs-" in str(file)) and "r" not in mode:
        raise OSError(28, "No space left on device")
    return keep(file, mode, *more, **how)
builtins.open = full
"""


def test_ten_broken_clips_hurt_nobody_and_a_second_call_does_what_is_left(fleet):
    table = fleet.table(sorted(fleet.clips.iterdir()), len(WAYS))
    said, _ = fleet.forked(table.name, "--pipeline", "short", "--jobs", "1", code=1)
    assert {clip for clip, state in states(said).items() if state == "done"} == {"c00000", "c00001"}
    assert said["totals"]["states"] == {"failed": 10, "done": 2} and len(said["totals"]["failures"]) == 10
    problems = {row["clip"]: row for row in said["rows"] if row["state"] == "failed"}
    assert holds(problems["b00000"]["problem"], "no person") and problems["b00000"]["hint"] == "film somebody"
    assert any(holds(kind, "one", "no person", "N", "frames") for kind in said["totals"]["failures"])
    assert all(row["problem"] and row["hint"] for row in problems.values())
    tries = [run for run in fleet.runs() if run["result"] != "done"]
    assert len(tries) == 7 + 2  # killed, and out of memory, are tried twice
    with open(fleet.work / "fleet.csv", newline="") as file:
        rows = {row["clip"]: row for row in csv.DictReader(file)}
    assert len(rows) == 12 and holds(rows["b00001"]["kind"], "one", "bug", "KeyError")
    page = (fleet.work / "fleet.html").read_text()
    assert page.count("<tr>") > 12 and "film somebody" in page and "location.reload" not in page

    before = fleet.made()
    for name in ("b00000", "b00002"):
        fleet.add(name, "mended")
    left = [f"clips/{name}.mp4" for name in ("b00000", "b00001", "b00002", "c00000")]
    said, _ = fleet.forked(*left, "--pipeline", "short", "--jobs", "1", "--name", "again", code=1)
    assert said["totals"]["states"] == {"failed": 1, "done": 2, "fresh": 1}
    assert before.items() <= fleet.made().items()
    assert len([run for run in fleet.runs() if run["result"] == "done"]) == 4


def test_only_what_is_kept_stays_and_only_what_failed_is_run_again(fleet):
    (fleet.clips / "c00001.mp4").unlink()
    fleet.add("bad", "broken error")
    said, err = fleet.forked(*PAIR, "--keep", "two", code=1)
    assert states(said) == {"bad": "failed", "c00000": "done"}
    assert [one["clips"] for one in said["failures"]] == [["bad/pair"]] and said["failures"][0]["stage"] == "one"
    assert said["totals"]["freed_bytes"] == sum(row["freed"] for row in said["rows"]) > 0
    assert holds(err, "freed", "two")
    assert [path.name[:3] for path in fleet.work.glob("c0*/store/*-*")] == ["two"]
    fleet.add("bad", "mended")
    fleet.add("new", "pixels")
    said, _ = fleet.forked(*PAIR, "--keep", "two", "--only-failed")
    assert states(said) == {"bad": "done", "c00000": "fresh"}
    said, _ = fleet.forked(*PAIR, "--dry-run")
    assert {row["clip"]: row["state"] for row in said} == {"bad": "fresh", "c00000": "fresh", "new": "todo"}
    assert not fleet.twice()


def test_a_dry_run_does_nothing_and_says_how_long(fleet):
    said, _ = fleet.forked("--dry-run")
    assert [row["state"] for row in said] == ["todo"] * 2 and said[0]["todo"] == ["one", "two", "three", "four"]
    assert said[0]["seconds"] > 0 and not fleet.work.exists()
    fleet.forked("clips/c00000.mp4", "--pipeline", "short", "--jobs", "1")
    out, _ = fleet.fleet("--dry-run", "--pipeline", "short").communicate(timeout=LONGEST)
    assert "work/c00000" in out and "fresh" in out and re.search(r"\b1 stage.* \d", out)
    assert holds(out, "2 clips", "1 fresh", "1 to do")


def test_ctrl_c_keeps_what_is_finished_and_goes_on_later(fleet):
    run = fleet.fleet(*PAIR, *fleet.hold("two"))
    fleet.wait_for(lambda: list(fleet.work.glob("c00000/store/two-*.part/step0")))
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 130 and "stopping: " in err and "Traceback" not in err
    assert [path.parts[-3] for path in fleet.work.glob("*/store/one-*")] == ["c00000"]  # no other was begun
    with open(fleet.work / "fleet.csv", newline="") as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["stopped"] * 2
    before = fleet.made()
    said, _ = fleet.forked(*PAIR)
    assert set(states(said).values()) == {"done"} and before.items() <= fleet.made().items()
    assert [run["stage"] for run in fleet.runs() if run["result"] == "stopped"] == ["two"]


def test_a_fleet_that_is_killed_takes_its_job_along_and_loses_nothing(fleet):
    run = fleet.fleet(*PAIR, *fleet.hold("two"))
    fleet.wait_for(lambda: list(fleet.work.glob("c00000/store/two-*.part/step0")))
    run.kill()
    run.communicate(timeout=LONGEST)
    holder = fleet.work / "c00000" / lease.NAME
    fleet.wait_for(lambda: not holder.exists())  # the job saw that its fleet is gone, and ended in good order
    said, _ = fleet.forked(*PAIR)
    assert set(states(said).values()) == {"done"}
    assert sorted(run["stage"] for run in fleet.runs() if run["result"] == "done") == ["one", "one", "two", "two"]


def test_a_job_that_is_killed_is_tried_again(fleet):
    run = fleet.fleet("clips/c00000.mp4", "--pipeline", "short", "--jobs", "1", *fleet.hold("one"), "--json")
    room = fleet.work / ".fleet" / "fleet"
    fleet.wait_for(lambda: list(room.glob("*/rows/*.json")) and list(fleet.work.glob("c00000/store/one-*.part/step0")))
    os.kill(json.loads(next(room.glob("*/rows/*.json")).read_text())["pid"], signal.SIGKILL)
    fleet.go()
    out, _ = run.communicate(timeout=LONGEST)
    assert run.returncode == 0 and states(json.loads(out)) == {"c00000": "done"} and fleet.made()


def test_two_fleets_on_one_folder_share_the_work_even_where_locks_are_weak(fleet):
    """The file system's locks hold nobody back: leases do."""
    first = fleet.folder / "weak"
    first.mkdir()
    (first / "sitecustomize.py").write_text(WEAK)
    args = ("--jobs", "1", "--pipeline", "short", "--set", "one.delay=0.8")
    runs = [fleet.fleet(*args, "--json", "--name", name, first=str(first)) for name in ("left", "right")]
    said = [json.loads(run.communicate(timeout=LONGEST)[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    assert all(set(states(one).values()) <= {"done", "fresh"} for one in said)
    assert len(fleet.runs()) == 2, "a stage ran twice"


def test_a_second_fleet_of_the_same_name_is_refused(fleet):
    run = fleet.fleet("--jobs", "1", *fleet.hold("one"))
    fleet.wait_for(lambda: list(fleet.work.glob("c00000/store/one-*.part/step0")))
    _, err = fleet.fleet("--jobs", "1").communicate(timeout=LONGEST)
    assert holds(err, "fleet", "at work", "process") and "--name" in err
    run.send_signal(signal.SIGINT)
    run.communicate(timeout=LONGEST)


def test_a_clip_that_changes_while_it_waits_is_made_as_it_is_then(fleet):
    gone = fleet.add("c00002", "soon gone")
    run = fleet.fleet("--jobs", "1", "--pipeline", "short", *fleet.hold("one"), "--json")
    fleet.wait_for(lambda: list(fleet.work.glob("c00000/store/one-*.part/step0")))
    fleet.add("c00001", "other pixels")
    gone.unlink()
    fleet.go()
    out, _ = run.communicate(timeout=LONGEST)
    said = json.loads(out)
    assert states(said) == {"c00000": "done", "c00001": "done", "c00002": "failed"} and run.returncode == 1
    assert "other pixels" in (fleet.work / "c00001/short/one/out.txt").read_text()
    assert holds(said["rows"][2]["problem"], "no video", "clips/c00002.mp4")


def test_a_full_disk_hurts_reports_and_not_results(fleet):
    """The page, the table, and every report of a job go to a disk that is full."""
    (fleet.folder / "sitecustomize.py").write_text(FULL)
    run = fleet.fleet("clips/c00000.mp4", "--jobs", "1", "--pipeline", "short")
    _, err = run.communicate(timeout=LONGEST)
    assert 1 <= err.count("No space left on device") <= 2, "it is said once, and at the end"
    assert "Traceback" not in err
    assert run.returncode == 1 and len(fleet.made()) == 1  # nobody could be told that the clip is done
    (fleet.folder / "sitecustomize.py").unlink()
    said, _ = fleet.forked("clips/c00000.mp4", "--jobs", "1", "--pipeline", "short")
    assert states(said) == {"c00000": "fresh"}


def test_without_the_extra_it_says_what_to_install_and_runs_one_after_another(fleet):
    (fleet.folder / "sitecustomize.py").write_text(
        "import importlib.util as one\nkeep = one.find_spec\n"
        "one.find_spec = lambda name, *more: None if name == 'snakemake' else keep(name, *more)\n"
    )
    for more in (("--jobs", "2"), ("--profile", "slurm")):
        run = fleet.fleet(*more)
        _, err = run.communicate(timeout=LONGEST)
        assert run.returncode == 2 and "pip install 'hugs-avatar[fleet]'" in err
    said, err = fleet.done("--pipeline", "short")
    assert states(said) == {"c00000": "done", "c00001": "done"}
    assert holds(err, "1 clip") and "pip install 'hugs-avatar[fleet]'" in err


@needs_snakemake
def test_side_by_side_through_snakemake(tmp_path):
    """In a folder whose name means much to shells and to Snakemake."""
    room = tmp_path / "it's {here} $HOME; 1 %"
    room.mkdir()
    fleet = Fleet(room, 2)
    broken, hungry = fleet.add("c00002", "broken error"), fleet.add("c00003", "broken memory")
    said, err = fleet.forked("--jobs", "2", "--pipeline", "short", code=1)
    assert list(states(said).values()) == ["done", "done", "failed", "failed"] and "Traceback" not in err
    assert said["rows"][2]["problem"].startswith("no person") and said["rows"][2]["log"]
    tries = Counter(run["clip"] for run in fleet.runs() if run["result"] == "error")
    assert tries == {"c00002": 1, "c00003": 2}, "an error would come again, memory may suffice the next time"
    (log,) = fleet.work.glob(f".fleet/fleet/*/{SNAKEMAKE_LOG}")
    most, *jobs = (int(number) for number in re.findall(r"resources: .*?mem_mb=(\d+)", log.read_text()))
    assert set(jobs) == {min(4000, most), min(8000, most)}, "the second try has twice the memory"
    for one in (broken, hungry):
        one.write_text(f"mended {one.stem}")
    said, _ = fleet.forked("--jobs", "2", "--pipeline", "short")
    assert said["totals"]["states"] == {"fresh": 2, "done": 2}
    assert not log.exists(), "the folder of the call before is taken away"


@needs_snakemake
def test_ctrl_c_and_kills_with_snakemake(fleet):
    """Of the fleet, and of Snakemake alone: the jobs that it leaves behind are ended."""

    def at_work() -> bool:
        reports = [read_json(file) for file in fleet.work.glob(".fleet/fleet/*/rows/*.json")]
        return bool(leases()) and any((one["state"], one.get("stage")) == ("running", "two") for one in reports)

    def leases() -> list[Path]:
        return list(fleet.work.glob(f"*/{lease.NAME}"))

    pair = ("--pipeline", "pair", "--jobs", "2")
    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9), (None, 1)):
        run = fleet.fleet(*pair, *fleet.hold("two"))
        fleet.wait_for(at_work)
        if number:
            run.send_signal(number)
        else:
            os.kill(next(one for one in below(run.pid) if what(one) == "Snakemake"), signal.SIGKILL)
        _, err = run.communicate(timeout=LONGEST)
        assert run.returncode == code
        if number:
            fleet.wait_for(lambda: not leases())
    assert holds(err, "error", "Snakemake", "SIGKILL")
    before = fleet.made()
    said, _ = fleet.forked(*pair)
    assert set(states(said).values()) <= {"done", "fresh"} and before.items() <= fleet.made().items()


@needs_snakemake
def test_a_profile_that_places_no_job_ends_the_page_too(fleet):
    (fleet.folder / "profile").mkdir()
    (fleet.folder / "profile" / "config.yaml").write_text("executor: nowhere\n")
    run = fleet.fleet("--profile", "./profile")
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 1 and holds(err, "error", "Snakemake", "no job") and "nowhere" in err
    page = (fleet.work / "fleet.html").read_text()
    assert "location.reload" not in page and page.count("its job never began") == 2 + 1
    assert page.count(f'{SNAKEMAKE_LOG}">log<') == 2


def test_a_fleet_of_two_pipelines_and_settings(tmp_path: Path):
    fleet = Fleet(tmp_path, 1)
    table = fleet.folder / "clips.yaml"
    table.write_text(
        "- {clip: clips/c00000.mp4, pipeline: short}\n- {clip: clips/c00000.mp4, pipeline: pair, settings: [two.word=z]}\n"
    )
    said, _ = fleet.forked("clips.yaml", "--jobs", "1")
    assert [row["pipeline"] for row in said["rows"]] == ["short", "pair"]
    assert "two:z" in (fleet.work / "c00000/pair/two/out.txt").read_text()
    assert len(fleet.runs()) == 2  # the first stage is shared
