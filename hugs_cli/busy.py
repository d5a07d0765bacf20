"""How busy the machine is: what a forecast of seconds has to be multiplied with."""

from __future__ import annotations

import os
import time

from hugs_cli.cache.child import processors

TRIED = 0.3
"""Seconds for which processors are kept busy to see what is left of them."""
LEAST = 0.02
"""The least share: less cannot be measured in that time."""


def shares() -> tuple[float, float]:
    """Shares of processor time that one more program gets, from LEAST up to 1: on one processor, and on all.

    On an idle machine both are 1. Other work slows a program on one processor less than one on all.
    """
    return _share(1), _share(processors())


def _share(tasks: int) -> float:
    """Share of processor time that so many tasks get at once, from LEAST up to 1."""
    began, running = time.monotonic(), []
    for _ in range(tasks):
        if (task := os.fork()) == 0:
            try:
                while time.monotonic() < began + TRIED:
                    pass
            finally:  # Ctrl-C reaches it, too: only its parent says so
                os._exit(0)
        running.append(task)
    got = sum(os.wait4(task, 0)[2].ru_utime for task in running)
    return min(1.0, max(LEAST, got / (TRIED * tasks)))
