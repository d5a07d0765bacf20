"""Where the time of a training goes."""

from __future__ import annotations

import time


class Clock:
    """Seconds by part of what was done, each moment counted once: a part ends where its lap is told.

    One reading of the system's clock a lap. On a GPU, which works while the program goes on, a part holds the time in
    which results were waited for.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.mark = time.perf_counter()

    def start(self) -> None:
        """What was done up to now belongs to no part."""
        self.mark = time.perf_counter()

    def lap(self, part: str) -> None:
        """What was done since the last lap, or `start`, was `part`."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self.mark
        self.mark = now
