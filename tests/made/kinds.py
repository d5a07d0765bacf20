"""What tests/made/corpus.py is made of, without the readers, which take seconds to load."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WHOLE = "whole"
"""The folder of the corpus that has every file undamaged."""


@dataclass(frozen=True)
class Kind:
    """One file of the corpus, and `read(root)`: what our program does with it, other files of `root` being whole.

    `read` may write under `root / "out"` only, which it finds empty.
    """

    file: str
    read: Callable[[Path], Any]
