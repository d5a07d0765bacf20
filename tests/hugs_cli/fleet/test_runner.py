"""How many clips run side by side, and the plain loop."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hugs_cli.fleet import runner
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.plan import Planned
from hugs_cli.fleet.runner import Loop, Order, Snakemake, profile_folder, side_by_side
from hugs_cli.pipelines import UsageError
from stages.contract import StageError


@pytest.mark.parametrize(
    ("cores", "threads", "free", "asked", "megabytes", "expected"),
    [
        (2, "", 24_000, None, 2000, 2),  # each clip takes two threads, and keeps one busy
        (8, "", 64_000, None, 2000, 2),
        (8, "2", 64_000, None, 2000, 8),
        (8, "1", 64_000, None, 2000, 8),
        (8, "2", 9_000, None, 2000, 4),
        (8, "2", 1_000, None, 2000, 1),
        (8, "2", 64_000, 3, 2000, 3),
        (8, "", 64_000, 5, 2000, 5),
        (2, "", 64_000, 100, 2000, 2),
        (8, "2", 0, None, 2000, 8),  # the system does not say
    ],
)
def test_as_many_as_memory_and_processors_allow_and_never_more(
    monkeypatch, cores, threads, free, asked, megabytes, expected
):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    monkeypatch.setattr(runner.child, "processors", lambda: cores)
    monkeypatch.setattr(runner, "free_megabytes", lambda: free)
    assert side_by_side(asked, [megabytes, 10])[0] == expected


@pytest.mark.parametrize(
    ("cores", "threads", "clips", "expected"),
    [(8, "", 0, 1), (8, "", 1, 1), (8, "", 2, 1.5), (8, "", 4, 3), (8, "2", 4, 1), (8, "2", 8, 1.5)],
)
def test_clips_slow_each_other_down_where_they_have_not_enough_processors(monkeypatch, cores, threads, clips, expected):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    monkeypatch.setattr(runner.child, "processors", lambda: cores)
    assert runner.slower(clips) == pytest.approx(expected)


@pytest.mark.parametrize(("profile", "seconds", "minutes"), [(None, 600, 720), ("slurm", 86_400, 4320)])
def test_what_snakemake_is_told(tmp_path, monkeypatch, profile, seconds, minutes):
    """Memory and processors of this machine, or nothing of a cluster's; and three times as long as a clip should take."""
    called: list[str] = []
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setattr(runner, "free_megabytes", lambda: 9000)
    monkeypatch.setattr(runner.subprocess, "Popen", lambda command, **more: called.extend(command))
    rows = [
        Planned(Row(Path(f"{name}.mp4"), tmp_path, "default"), "todo", expected={"train": seconds}) for name in "ab"
    ]
    Snakemake(Order(tmp_path, rows, False, 2, profile))
    told = json.loads((tmp_path / "jobs.json").read_bytes())
    assert (told["local"], told["most"], told["threads"]) == (profile is None, 9000 if profile is None else 0, 3)
    assert told["minutes"] == minutes
    local, cluster = ["--cores", "6", "--resources", "mem_mb=9000"], ["--jobs", "2"]
    assert called[-4:] == local if profile is None else called[-2:] == cluster


def test_a_snakemake_that_was_killed_is_an_error_with_its_last_words(tmp_path):
    made = object.__new__(Snakemake)
    made.process, made.log = Ended(-9), tmp_path / "log"
    made.log.write_text("\n\n".join(f"line {i}" for i in range(9)))
    with pytest.raises(StageError, match="killed by SIGKILL") as error:
        made.check()
    assert error.value.facts == tuple(f"line {i}" for i in range(3, 9))


class Ended:
    """A process that ended at once."""

    def __init__(self, code: int):
        self.returncode = code

    def poll(self) -> int:
        return self.returncode


@pytest.mark.parametrize(
    ("codes", "kind", "split", "expected"),
    [
        ([0, 0], "", False, ["a.clip", "b.clip"]),
        ([1, 0], "error", False, ["a.clip", "b.clip"]),  # it would fail again
        ([1, 1, 0], "memory", False, ["a.clip", "a.clip", "b.clip"]),
        ([-9, 0, 0], "", False, ["a.clip", "a.clip", "b.clip"]),  # killed from outside
        ([0, 0, 1, 0], "error", True, ["a.before", "a.train", "b.before"]),
        ([1, 0, 0], "error", True, ["a.before", "b.before", "b.train"]),
    ],
)
def test_the_plain_loop_tries_again_only_what_may_go_well(tmp_path, monkeypatch, codes, kind, split, expected):
    todo = [Planned(Row(Path(name), tmp_path, "default"), "todo") for name in "ab"]
    names = {one.row.id: one.row.name for one in todo}
    loop, started = Loop(Order(tmp_path, todo, split, 1, None), lambda row: kind), []

    def start(row: str, step: str) -> Ended:
        started.append(f"{names[row]}.{step}")
        return Ended(codes.pop(0))

    monkeypatch.setattr(loop, "_start", start)
    while loop.going():
        pass
    assert started == expected


def test_the_profile_of_a_cluster_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert Path(profile_folder("slurm"), "config.yaml").is_file()
    assert "machine" in profile_folder(None)
    (tmp_path / "snakemake" / "slurm").mkdir(parents=True)
    assert profile_folder("slurm") == str(tmp_path / "snakemake" / "slurm")  # the user's own comes first
    with pytest.raises(UsageError, match="no Snakemake profile nowhere"):
        profile_folder("nowhere")
