"""Rates that were rounded when they were written: 0.033333 s from frame to frame is a thirtieth of a second."""

from __future__ import annotations

from decimal import Decimal, DecimalException
from math import ceil, floor

COMMON = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 200, 240)
FILM = tuple(1000 * base / 1001 for base in (24, 30, 48, 60, 120, 240))  # 23.976, 29.97 and so on
FASTEST = 1000


def usual_rate(written: str, seconds: bool = False) -> float:
    """Frames a second of a number as it is `written`, with `seconds` from frame to frame.

    It stands for all that rounds to it. Among these the only whole rate is taken, or the only one of COMMON or of FILM, else
    what is written. ValueError for no number above 0.
    """
    try:
        value = Decimal(written)
        half = Decimal((0, (5,), int(value.as_tuple().exponent) - 1))
        low, high = (float(value + way * half) for way in (-1, 1))
    except (DecimalException, ValueError, TypeError) as error:
        raise ValueError(f"{written[:40]!r} is no number") from error
    rate = float(value)
    if not rate > 0 or rate == float("inf"):
        raise ValueError(f"{written[:40]!r} is not above 0")
    if seconds:
        rate, low, high = 1 / rate, 1 / high, 1 / low if low > 0 else FASTEST
    if rate > FASTEST or abs(rate - round(rate)) < 1e-9:
        return rate
    whole = range(ceil(low), floor(min(high, FASTEST)) + 1)
    for among in (whole, [one for one in COMMON if low <= one <= high], [one for one in FILM if low <= one <= high]):
        if len(among) == 1:
            return float(among[0])
    return rate
