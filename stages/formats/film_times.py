"""When the pictures of a film are shown, and which slot of time each belongs to, whatever times its file gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SAME = 1e-6  # s, and of a slot
STRAYS = 0.01  # of the pictures, or one: so few at an end, beyond a gap longer than all the rest, have a wrong time
PAUSE = 2.0  # s, and ten steps: a longer one is said


class TimesFall(Exception):
    """A picture is not shown later than the one before."""


class FilmTimes:
    """The pictures of a film by their `times` [N] s, which rise, cut into `count` slots of time, one for each if they are fewer.

    No slot is empty: the longest steps count as less, as little as that takes. So rounded times and pauses lose no picture.
    """

    def __init__(self, times: Sequence[float], duration: float, count: int):
        """`duration` s, of the last picture too."""
        self.known, self.last, self.said = np.asarray(times, np.float64), -1, list[str]()
        self.times = spread_equal(self.known)
        self.good, wrong = self._good()
        self.times = self.times - self.times[self.good][0]
        ends = self.times[self.good]
        ends = np.append(ends, ends[-1] + np.median(np.diff(ends))) if wrong else np.append(ends, duration)
        self.duration, steps = float(ends[-1]), np.diff(ends)
        self.slots = min(count, len(steps))
        if wrong:
            named = ", ".join(f"{self.known[i]:.1f} s" for i in wrong[:3])
            self.said.append(
                f"left out, as their times lie far from all others: {len(wrong)} of the pictures, at {named}"
            )
        if len(steps) > 1 and steps[:-1].max() > max(PAUSE, 10 * np.median(steps)):
            long = int(steps[:-1].argmax())
            self.said.append(f"the film pauses for {steps[long]:.1f} s after {ends[long]:.1f} s")
        self.places = np.full(len(self.times), np.nan)
        self.places[self.good] = self._spread(ends, steps)

    def _good(self) -> tuple[np.ndarray, list[int]]:
        first, last, strays = 0, len(self.times), max(1, STRAYS * len(self.times))
        while last - first > 2:
            times = self.times[first:last]
            gap = int(np.diff(times).argmax()) + 1
            begin, end = (first + gap, last) if gap <= len(times) - gap else (first, first + gap)
            if max(begin, len(self.times) - end) > strays or np.diff(times).max() <= (times[-1] - times[0]) / 2:
                break
            first, last = begin, end
        good = np.zeros(len(self.times), bool)
        good[first:last] = True
        return good, np.flatnonzero(~good).tolist()

    def _spread(self, ends: np.ndarray, steps: np.ndarray) -> np.ndarray:
        places = ends[:-1] / ends[-1] * self.slots
        low, high = float(steps.min()), float(steps.max())
        for _ in range(40):
            if len(np.unique((places + SAME).astype(int))) >= self.slots:
                return places
            middle = low if high - low < SAME * low else (low + high) / 2
            ends = np.append(0, np.minimum(steps, middle).cumsum())
            places = ends[:-1] / ends[-1] * self.slots
            high = middle
        return places

    def at(self, time: float) -> tuple[float, float] | None:
        """Seconds from the first picture and place among the slots of the next picture that decodes; None to leave it out.

        TimesFall if its `time`, as the film gives it, is not later than that of the one before.
        """
        found = self.last + 1 if np.isnan(time) else int(np.searchsorted(self.known, time - SAME))
        if found <= self.last < len(self.known) - 1 and abs(self.known[self.last + 1] - time) < SAME:
            found = self.last + 1  # another picture of the same time
        if found < len(self.known) and not self.good[found]:
            return None
        if not self.last < found < len(self.known):
            raise TimesFall
        self.last = found
        return float(self.times[found]), float(self.places[found])


def spread_equal(times: np.ndarray) -> np.ndarray:
    """Times [N] that do not fall, with equal ones spread to the next later one."""
    unique, first, counts = np.unique(times, return_index=True, return_counts=True)
    if len(unique) == len(times) or len(unique) < 2:
        return times if len(unique) == len(times) else np.arange(len(times), dtype=np.float64)
    width = np.append(np.diff(unique), np.median(np.diff(unique)))
    return np.repeat(unique, counts) + np.repeat(width / counts, counts) * (
        np.arange(len(times)) - np.repeat(first, counts)
    )
