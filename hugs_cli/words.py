"""Numbers, times, sizes and paths as a person reads them."""

from __future__ import annotations

import os
import re
import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")


def plain(text: str) -> str:
    """The text on one line, with line ends and control characters (a terminal obeys them) written as \\n and \\x1b."""
    return CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def duration(seconds: float) -> str:
    """3.2 s, 2m 31s, 1h 02m."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m {rest:02d}s" if minutes < 60 else f"{minutes // 60}h {minutes % 60:02d}m"


def size(amount: float) -> str:
    """812 B, 24 KiB, 2.1 GiB."""
    for unit in ("B", "KiB", "MiB"):
        if amount < 1024:
            return f"{amount:.0f} {unit}"
        amount /= 1024
    return f"{amount:.1f} GiB"


def ago(made: str) -> str:
    """How long ago a stamp's time was: 2 days ago."""
    seconds = (datetime.now(UTC) - datetime.fromisoformat(made)).total_seconds()
    for unit, length in (("day", 86400), ("hour", 3600), ("minute", 60)):
        if seconds >= length:
            return f"{count(int(seconds // length), unit)} ago"
    return "just now"


def number(name: str, value: Any) -> str:
    """One named number of a stage's progress: 'psnr 27.1', '142k gaussians', '2.1 GiB'."""
    if name.endswith("bytes"):
        return size(value)
    if isinstance(value, float):
        return f"{name} {value:.3g}"
    if not isinstance(value, int):
        return f"{name} {value}"
    short = f"{value / 1e6:.1f}M" if value >= 1_000_000 else f"{value // 1000}k" if value >= 10_000 else str(value)
    return f"{short} {name}"


def count(number: int, what: str) -> str:
    """1 module, 2 modules."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def relative(path: Path) -> str:
    """A path as short as it can be said from here, on one line."""
    return plain(os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path))


def command(*said: object, pipeline: str, work: Path) -> str:
    """A `hugs` command that a shell takes as it is, whatever the names in it; pipeline and work folder where they matter."""
    chosen = () if pipeline == "default" else ("--pipeline", pipeline)
    kept = () if work == Path("work") else ("--work", work)
    return shlex.join(map(str, ("hugs", *said, *chosen, *kept)))
