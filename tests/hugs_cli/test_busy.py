"""How busy the machine is, measured beside processes that compute."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from hugs_cli import busy
from hugs_cli.cache.child import processors


@pytest.mark.slow
def test_shares_fall_when_others_compute():
    """Three times as many others as processors leave a quarter, of whatever is left here now."""
    alone = busy.shares()
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3 * processors())]
    try:
        beside = [min(share) for share in zip(*(busy.shares() for _ in range(3)))]
    finally:
        for other in others:
            other.kill()
            other.wait()
    assert all(0 < less < more <= 1 for less, more in zip(beside, alone, strict=True))


def test_who_gets_nothing_has_a_share_to_divide_by(monkeypatch):
    idle = type("Usage", (), {"ru_utime": 0.0})
    wait = os.waitpid
    monkeypatch.setattr(busy.os, "wait4", lambda task, flags: (*wait(task, flags), idle))
    assert all(0 < share < 0.1 for share in busy.shares())


STOPPED = """
import signal
from hugs_cli import busy
def stop(number, frame):
    raise InterruptedError
signal.signal(signal.SIGINT, stop)
busy.processors, busy.TRIED = lambda: 2, 20
print("begun", flush=True)
try:
    busy.shares()
except InterruptedError:
    print("stopped", flush=True)
"""


def test_a_measurement_that_is_stopped_is_said_once():
    run = [sys.executable, "-c", STOPPED]
    with subprocess.Popen(run, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        assert process.stdout and process.stdout.readline() == "begun\n"
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
        assert process.stdout.read() == "stopped\n"
