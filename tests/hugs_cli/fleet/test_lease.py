"""Leases: one holder at a time, the dead are found, and nobody's clock is trusted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.lease import Lease, Watch, holder, identity, is_alive, lease, remove, take


def never(name: str) -> None:
    raise AssertionError(f"waits for {name}")


@pytest.fixture
def path(tmp_path):
    return tmp_path / leases.NAME


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
        thread.join(30)
    assert len(turns) == 30 and max(most) == 1


def test_a_lease_that_is_given_back_before_its_name_is_read_is_taken(path, monkeypatch):
    monkeypatch.setattr(leases, "LOOK_EVERY", 0.001)
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


def test_a_number_that_another_process_has_now_is_not_the_holder(path):
    assert is_alive(identity() | {"began": "1"}) is False
    assert is_alive(identity() | {"boot": "another"}) is False
    assert is_alive(identity() | {"host": "elsewhere"}) is None


def test_a_machine_that_vanished_is_noticed_by_its_silence_not_by_its_clock(path, monkeypatch):
    monkeypatch.setattr(leases, "DEAD_AFTER", 0.2)
    path.write_text(json.dumps(identity() | {"host": "elsewhere"}))
    os.utime(path, (4e9, 4e9))  # its clock is far ahead
    watch = Watch(path)
    assert not watch.dead()
    time.sleep(0.15)
    os.utime(path, (1, 1))  # it lives, and its clock went back
    assert not watch.dead()
    time.sleep(0.15)
    assert not watch.dead()
    time.sleep(0.25)
    assert watch.dead()


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


def test_a_fleet_elsewhere_is_believed_alive_only_if_it_touches_its_lease(path, monkeypatch):
    monkeypatch.setattr(leases, "DEAD_AFTER", 0.3)
    monkeypatch.setattr(leases, "LOOK_EVERY", 0.02)
    assert not leases.lives(path)
    path.write_text(json.dumps(identity()))
    assert leases.lives(path)
    path.write_text(json.dumps(identity() | {"host": "elsewhere"}))
    assert not leases.lives(path)
    later = threading.Timer(0.1, os.utime, (path, (5, 5)))
    later.start()
    assert leases.lives(path)
    later.join()
