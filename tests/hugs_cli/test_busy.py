"""How busy the machine is, measured beside processes that compute."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hugs_cli import busy
from hugs_cli.cache.child import processors


@pytest.mark.slow
def test_a_share_falls_when_others_compute():
    """Three times as many others as processors leave a quarter, of whatever is left here now."""
    alone = busy.share()
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3 * processors())]
    try:
        beside = min(busy.share() for _ in range(3))
    finally:
        for other in others:
            other.kill()
            other.wait()
    assert 0 < beside < alone <= 1
