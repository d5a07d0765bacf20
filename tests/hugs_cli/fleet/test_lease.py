"""Leases: one holder at a time, the dead are found, and nobody's clock is trusted."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.lease import DEAD_AFTER, Lease, Watch, holder, identity, is_alive, lease, lives, remove, take


def never(name: str) -> None:
    raise AssertionError(f"waits for {name}")


@pytest.fixture
def path(tmp_path):
    return tmp_path / leases.NAME


class Clock:
    """Time that passes only where somebody sleeps, and the file systems' doings at a time."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.later: list[tuple[float, Callable[[], object]]] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        for one in [one for one in self.later if one[0] <= self.now]:
            self.later.remove(one)
            one[1]()


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(leases, "time", clock)
    return clock


def elsewhere() -> dict[str, Any]:
    """Somebody on another machine."""
    return identity() | {"host": "elsewhere"}


def test_it_is_taken_and_given_back(path):
    with lease(path, never) as held:
        assert holder(path) == held.me and held.touch() and is_alive(held.me)
        assert not take(path, identity())
    assert list(path.parent.iterdir()) == []


def test_one_of_many_has_it_at_a_time(path, monkeypatch):
    monkeypatch.setattr(leases, "LOOK_EVERY", 0.001)
    inside, most, turns = [], [], []

    def work() -> None:
        for _ in range(5):
            with lease(path, lambda name: None):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.001)
                inside.pop()
                turns.append(1)

    threads = [threading.Thread(target=work) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(600)
    assert len(turns) == 30 and max(most) == 1


def test_a_lease_that_is_given_back_before_its_name_is_read_is_taken(path, clock, monkeypatch):
    answers = iter([False])  # another has it, and gives it back at once
    monkeypatch.setattr(leases, "take", lambda *who: next(answers, None) is None and take(*who))
    with lease(path, never) as held:
        assert holder(path) == held.me


def test_a_dead_process_of_this_machine_holds_nothing(path):
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    me = identity() | {"pid": child.pid, "began": "1"}
    child.wait()
    path.write_text(json.dumps(me))
    with lease(path, lambda name: None) as held:
        assert holder(path) == held.me


def test_only_processes_that_can_be_seen_are_judged(path):
    assert is_alive(identity() | {"began": "1"}) is False  # a number that another process has now
    assert is_alive(identity() | {"kernel": "another container, or another machine of this name"}) is None
    assert is_alive(elsewhere()) is is_alive({}) is None


def test_a_machine_that_vanished_is_noticed_by_its_silence_not_by_its_clock(path, clock):
    path.write_text(json.dumps(elsewhere()))
    os.utime(path, (4e9, 4e9))  # its clock is far ahead
    watch = Watch(path)
    assert not watch.dead()
    clock.sleep(0.8 * DEAD_AFTER)
    os.utime(path, (1, 1))  # it lives, and its clock went back
    assert not watch.dead()
    clock.sleep(0.8 * DEAD_AFTER)
    assert not watch.dead()
    clock.sleep(0.3 * DEAD_AFTER)
    assert watch.dead()


def test_the_dead_are_waited_for_once(path, clock):
    """While a fleet looks whether another lives, its own watch goes on."""
    path.write_text(json.dumps(elsewhere()))
    began, said = clock.now, []

    def refuse(name: str) -> None:
        said.append(name)
        assert not lives(path)

    with lease(path, refuse):
        assert len(said) == 1 and clock.now - began < 1.1 * DEAD_AFTER


def test_a_network_that_loses_the_answer_does_not_lose_the_lease(path, monkeypatch):
    """NFS sends again what was not answered, and is told that the link is there: it is its own."""
    keep = os.link
    monkeypatch.setattr(os, "link", lambda *names: (keep(*names), fail(errno.EEXIST)))
    with lease(path, never) as held:
        assert holder(path) == held.me and not take(path, identity())


def test_a_file_system_without_links(path, monkeypatch):
    monkeypatch.setattr(os, "link", lambda *_: fail(errno.EPERM))
    with lease(path, never) as held:
        assert holder(path) == held.me and not take(path, identity())
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("links", [True, False])
def test_a_full_disk_leaves_no_half_lease(path, monkeypatch, links):
    """It would hold all others back for minutes."""
    monkeypatch.setattr(os, "link", lambda *_: fail(errno.ENOSPC if links else errno.EPERM))
    monkeypatch.setattr(json, "dump", lambda *_: fail(errno.ENOSPC))
    with pytest.raises(OSError, match="No space left"):
        take(path, identity())
    assert list(path.parent.iterdir()) == []


def fail(number: int) -> None:
    raise OSError(number, os.strerror(number))


def test_a_lease_that_was_taken_over_is_lost_to_its_holder(path):
    me, other = identity(), identity()
    assert take(path, me)
    held = Lease(path, me)
    remove(path, me)
    assert take(path, other) and not held.touch()
    held.give_back()
    assert holder(path) == other


def test_a_lease_that_is_taken_while_it_is_judged_dead_stays(path):
    seen, new = identity() | {"pid": 1}, identity()
    assert take(path, new)
    remove(path, seen)
    assert holder(path) == new and list(path.parent.iterdir()) == [path]


def test_a_fleet_elsewhere_is_believed_alive_only_if_it_touches_its_lease(path, clock):
    assert not lives(path)
    path.write_text(json.dumps(identity()))
    assert lives(path) and clock.now == 1000.0
    path.write_text(json.dumps(elsewhere()))
    assert not lives(path) and clock.now > 1000.0 + DEAD_AFTER
    clock.later.append((clock.now + 10, lambda: os.utime(path, (5, 5))))
    assert lives(path)


def test_who_waits_is_told_once(path, clock):
    other, told = elsewhere(), []
    assert take(path, other)
    clock.later = [(1000.0 + 1 + k, lambda: Lease(path, other).touch()) for k in range(9)]
    clock.later.append((1012.0, lambda: remove(path, other)))
    with lease(path, told.append):
        assert len(told) == 1 and "elsewhere" in told[0]


def test_nobody_lives_of_whom_it_is_not_known_when_they_began():
    """Neither a process that is gone nor one that nothing is known of has begun."""
    for began in ("", "0", None):
        assert is_alive(identity() | {"pid": 2**22 + 1, "began": began}) is False


def test_a_process_of_which_only_the_exit_code_is_left_is_dead():
    if (child := os.fork()) == 0:
        os._exit(0)
    alive = identity() | {"pid": child, "began": leases.began(os.getpid())}
    try:
        while os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT) is None:
            pass
        assert leases.began(child) == "" and is_alive(alive | {"began": ""}) is False
    finally:
        os.waitpid(child, 0)
