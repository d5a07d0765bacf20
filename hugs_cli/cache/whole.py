"""Writes a small file whole: whoever reads it finds the old content or the new."""

from __future__ import annotations

import os
from pathlib import Path


def replace(path: Path, text: str, flush: bool = False) -> None:
    """Replace a file in one step; `flush` it to the disk before. Raises OSError, and leaves nothing, where there is no room."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(part, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            if flush:
                os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
