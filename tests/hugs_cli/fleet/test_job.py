"""One job of a fleet: it is killed, robbed of its lease, told to stop, and its disk is full."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hugs_cli.fleet import job as jobs
from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.job import ROWS, STOP, Heart, Report, asked_to_stop
from hugs_cli.fleet.plan import WHOLE, Common, Planned
from hugs_cli.fleet.run import Fleet as Call
from hugs_cli.pipelines import UsageError
from tests.made.fleet import Fleet
from tests.made.flow import LONGEST, ROOT

QUICK = "from hugs_cli.fleet import job, lease; lease.TOUCH_EVERY = lease.LOOK_EVERY = job.BEAT_EVERY = 0.05; "


class Room:
    """The folder of one call, with a plan of some clips, and jobs started by hand."""

    def __init__(self, fleet: Fleet, common: Common, **row: Any):
        self.fleet, self.path = fleet, fleet.work / ".fleet" / "fleet" / "ca11ca11ca11"
        self.row = Row(Path("clips/c00000.mp4"), Path("work"), "short", **row)
        call = Call("fleet", common, [], False, 1, None)
        call.folder.mkdir(parents=True)
        call.lay_out(self.path, {}, [Planned(self.row, "todo")])

    def start(self, first: str = "", **how: Any) -> subprocess.Popen[bytes]:
        """Start its job; `first` is run before."""
        code = f"import sys; from pathlib import Path; {QUICK}{first}\nsys.exit(job.main(Path(sys.argv[1]), *sys.argv[2:]))"
        return subprocess.Popen(
            [sys.executable, "-c", code, str(self.path), self.row.id, "clip", "1"],
            env={**os.environ, "PYTHONPATH": f"{self.fleet.folder}:{ROOT}"},
            **how,
        )

    def report(self) -> dict[str, Any]:
        """What the job reports; empty if nothing."""
        file = self.path / ROWS / f"{self.row.id}.json"
        return json.loads(file.read_text()) if file.exists() else {}


@pytest.fixture
def room(fleet, common) -> Room:
    return Room(fleet, common)


@pytest.mark.slow
def test_a_job_that_lost_its_lease_waits_for_who_has_it(fleet, common):
    """It was silent for minutes, so another machine took the clip over."""
    fleet.hold("one")
    room = Room(fleet, common, settings=("one.hold=hold",))
    run = room.start()
    fleet.wait_for(lambda: list(fleet.work.glob("c00000/store/one-*.part/step0")))
    lease = fleet.work / "c00000" / leases.NAME
    leases.remove(lease, leases.holder(lease))
    assert leases.take(lease, leases.identity() | {"host": "elsewhere"})
    fleet.wait_for(lambda: room.report().get("state") == "waiting" and "elsewhere" in room.report()["stage"])
    assert fleet.runs()[-1]["result"] == "stopped" and run.poll() is None
    lease.unlink()
    fleet.go()
    assert run.wait(LONGEST) == 0 and room.report()["state"] == "done"
    assert [run["result"] for run in fleet.runs()] == ["stopped", "done"] and fleet.made()


def test_a_folder_that_another_clip_took_meanwhile_is_left_to_it(room, common):
    """Two fleets met clips of one name, and neither had results yet."""
    other = room.fleet.folder / "tue" / "c00000.mp4"
    other.parent.mkdir()
    other.write_text("other pixels")
    root = room.fleet.work / "c00000"
    root.mkdir()
    (root / "sources.json").write_text(json.dumps({"video": {"path": str(other)}}))
    heart = Heart(room.path, Report(room.path / "row.json"), {})
    with pytest.raises(UsageError, match=r"work/c00000 .*tue/c00000\.mp4"):
        jobs.work(room.row, common, WHOLE, heart.report, heart, leases.identity())
    assert not (root / leases.NAME).exists() and room.fleet.made() == {}


@pytest.mark.slow
def test_a_log_on_a_full_disk_hurts_neither_report_nor_result(room):
    with open("/dev/full", "w") as full:
        assert room.start(stderr=full).wait(LONGEST) == 0
    assert room.report()["state"] == "done" and len(room.fleet.made()) == 1
    room.fleet.add("c00000", "broken error")
    with open("/dev/full", "w") as full:
        assert room.start(stderr=full).wait(LONGEST) == 1
    assert room.report()["state"] == "failed" and room.report()["hint"] == "film somebody"
    assert room.start(stderr=subprocess.DEVNULL).wait(LONGEST) == 1  # again: it would fail again
    assert len([run for run in room.fleet.runs() if run["result"] == "error"]) == 1


@pytest.mark.slow
def test_a_job_of_a_call_that_is_over_does_nothing(room, common):
    """It waited in the queue of a cluster; another call has taken the folder away."""
    call = Call("fleet", common, [], False, 1, None)
    call.lay_out(room.path.with_name("later"), {}, [])
    assert not room.path.exists() and room.path.with_name("later").exists()
    run = room.start(stderr=subprocess.PIPE)
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 1 and b"is over" in err and not (room.fleet.work / "c00000").exists()


@pytest.fixture
def heart(tmp_path, monkeypatch) -> Heart:
    """A heart that beats fast, with a lease that it can lose. `killed` are the signals that it sent."""
    monkeypatch.setattr(jobs, "BEAT_EVERY", 0.001)
    heart = Heart(tmp_path, Report(tmp_path / "row.json"), {})
    killed: list[int] = []
    monkeypatch.setattr(jobs.os, "kill", lambda pid, number: killed.append(number))
    heart.killed = killed  # type: ignore[attr-defined]
    return heart


def beat(heart: Heart, touch: Any) -> None:
    """Beat until the lease was touched, and once more."""
    heart.lease = SimpleNamespace(touch=touch)  # type: ignore[assignment]
    heart.start()
    Fleet.wait_for(lambda: not heart.is_alive() or heart.report.facts["beat"] > 20)
    heart.quiet.set()
    heart.join(10)


def test_a_lease_that_is_given_back_while_it_is_touched_is_not_lost(heart):
    """The run has ended well: stopping it now would tell of a clip that is done as stopped."""

    def touch() -> bool:
        heart.lease = None
        return False

    beat(heart, touch)
    assert not heart.killed and not heart.lost


def test_a_lost_lease_stops_the_run_once(heart):
    beat(heart, lambda: False)
    assert len(heart.killed) == 1 and heart.lost and heart.lease is None


def test_a_fleet_that_asks_to_stop_means_it(heart):
    (heart.folder / STOP).touch()
    beat(heart, lambda: False)
    assert len(heart.killed) == 1 and not heart.lost


def test_a_file_system_that_does_not_answer_asks_nothing(tmp_path, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr(os, "stat", broken)
    assert not asked_to_stop(tmp_path, {})
