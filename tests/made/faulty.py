"""Readers with the faults that tests/tools/fuzz.py is there to find: the first file is read, the next ones meet one fault each."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from tests.made.kinds import Kind


def faults(last: Callable[[], object]) -> Callable[[Path], None]:
    """A bug, a file written elsewhere, memory without end, and `last`, one after the other."""
    calls = iter(range(100))

    def read(root: Path) -> None:
        match next(calls):
            case 1:
                raise KeyError("a bug")
            case 2:
                (root / "elsewhere").write_text("")
            case 3:
                bytearray(4 << 30)
            case 4:
                last()

    return read


KINDS = [Kind("points.ply", faults(os.abort)), Kind("body.npz", faults(lambda: time.sleep(60)))]
