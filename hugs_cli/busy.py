"""How busy the machine is: what a forecast of seconds has to be multiplied with."""

from __future__ import annotations

import os
import time

from hugs_cli.cache.child import processors

TRIED = 0.4
"""Seconds for which every processor is kept busy to see what is left of it."""
LEAST = 0.02
"""The least share: less cannot be measured in that time."""


def share() -> float:
    """Share of its processors that the machine gives to one more program, from LEAST up to 1: all of them, when nothing else runs.

    As many processes as there are processors compute for TRIED seconds; theirs is the time of processors that they got.
    """
    began, tasks = time.monotonic(), []
    for _ in range(processors()):
        if (task := os.fork()) == 0:
            try:
                while time.monotonic() < began + TRIED:
                    pass
            finally:  # Ctrl-C reaches it, too: only its parent says so
                os._exit(0)
        tasks.append(task)
    got = sum(os.wait4(task, 0)[2].ru_utime for task in tasks)
    return min(1.0, max(LEAST, got / (TRIED * len(tasks))))
