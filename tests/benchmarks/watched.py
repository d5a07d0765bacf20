"""`python -m tests.benchmarks.watched FILE run clip.mp4 ...`: the command `hugs`, and in FILE what its countdown said when."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from hugs_cli import main
from hugs_cli.console import Console


def watch(file: Path) -> None:
    """Run the command of `sys.argv`; FILE gets [seconds since the first saying, seconds to go] of each, then the end."""
    said: list[tuple[float, float]] = []

    def draw(console: Console, stage: str) -> None:
        now = time.monotonic()
        left = console.countdown.left(stage, console.progress, console.clock()) if console.countdown else None
        if left is not None:
            said.append((now, left))

    Console.draw = draw  # type: ignore[method-assign]
    try:
        main()
    finally:
        began = said[0][0] if said else 0.0
        rows = [(now - began, left) for now, left in said]
        file.write_text(json.dumps({"said": rows, "took": time.monotonic() - began}))


if __name__ == "__main__":
    place = Path(sys.argv.pop(1))
    watch(place)
