"""Where the time of a training goes."""

from __future__ import annotations

import time


class Clock:
    """Seconds by part of a step, each moment counted once.

    One reading of the system's clock a lap. A GPU works while the program goes on: there a part holds the time spent
    waiting for its results.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.mark = time.perf_counter()

    def start(self) -> None:
        """Count the time up to now for no part."""
        self.mark = time.perf_counter()

    def lap(self, part: str) -> None:
        """Count the time since the last lap, or `start`, for `part`."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self.mark
        self.mark = now
