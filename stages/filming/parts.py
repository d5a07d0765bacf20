"""What is kept of a film between two runs: pieces of it, and what its files were made of."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.contract import Job, whole

MADE = "made.json"  # file -> what it was made of, and its digest
OURS = re.compile(r"([0-9a-f]{24}|\.hugs-[0-9a-f]{12})\.\w+")  # names of pieces, and of files that were not ended


def mark(*things: object) -> str:
    """A digest of arrays, tensors, texts, numbers and None, and of lists and tuples of them."""
    digest = hashlib.sha256()
    for thing in things:
        _feed(digest, thing)
    return digest.hexdigest()


def _feed(digest: Any, thing: object) -> None:
    if isinstance(thing, torch.Tensor):
        thing = thing.detach().cpu().numpy()
    if isinstance(thing, np.ndarray):
        digest.update(f"{thing.dtype}{thing.shape}".encode() + np.ascontiguousarray(thing).tobytes())
    elif isinstance(thing, list | tuple):
        digest.update(f"[{len(thing)}".encode())
        for one in thing:
            _feed(digest, one)
    elif thing is None or isinstance(thing, str | int | float):
        digest.update(f"{type(thing).__name__} {thing!r}\n".encode())
    else:
        raise TypeError(f"no digest of a {type(thing).__name__}")


class Parts:
    """A folder in which pieces of a film wait for the next run, and a note of what the finished files were made of.

    `code` stands for the program: with another one nothing that was kept counts. `job` writes the files.
    """

    def __init__(self, folder: Path, code: str, job: Job | None = None):
        self.folder, self.code, self.job = folder, code, job or Job(folder)
        self.used: set[str] = {MADE}
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self.made = json.loads((folder / MADE).read_bytes())
            assert isinstance(self.made, dict)
        except (OSError, ValueError, AssertionError):
            self.made = {}

    def piece(self, ending: str, *made_of: object) -> Path:
        """Where a piece is kept that is made of these; it is whole if it is there."""
        path = self.folder / f"{mark(self.code, ending, *made_of)[:24]}{ending}"
        self.used.add(path.name)
        return path

    def bring(self, out: Path, make: Callable[[Path], object], *made_of: object) -> bool:
        """Let `make` write a file that takes the place of `out`, unless it is there as it was made of the same; whether it was
        made."""
        name, key = os.path.join(os.path.realpath(out.parent), out.name), mark(self.code, out.suffix, *made_of)
        if out.is_file() and self.made.get(name) == [key, _digest(out)]:
            return False
        out.parent.mkdir(parents=True, exist_ok=True)
        with self.job.writes(out) as part:
            make(part)
        self.made[name] = [key, _digest(out)]
        with whole(self.folder / MADE) as part:
            part.write_text(json.dumps(self.made, indent=1))
        return True

    def tidy(self) -> None:
        """Remove the pieces that this run had no use for, and what killed ones left; nothing else that lies there."""
        for path in self.folder.iterdir():
            if path.name not in self.used and OURS.fullmatch(path.name):
                with suppress(OSError):
                    path.unlink()


def spans(count: int, length: int) -> Iterable[range]:
    """`count` pictures in pieces of `length`, the last one shorter."""
    return (range(first, min(first + length, count)) for first in range(0, count, length))


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
