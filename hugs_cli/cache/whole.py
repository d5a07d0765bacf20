"""Writes a small file whole: whoever reads it finds the old content or the new."""

from __future__ import annotations

from pathlib import Path

from stages.contract import whole


def replace(path: Path, text: str, flush: bool = False) -> None:
    """Replace a file in one step; `flush` it to the disk before. Raises OSError, and leaves nothing, where there is no room."""
    with whole(path, flush=flush) as part, open(part, "w", encoding="utf-8") as file:
        file.write(text)
