"""Limits the memory a file may take: its own bytes, and BUDGET more for what is packed or repeated.

A few bytes can stand for any number of them: a packed array, a joint for each frame, a size in a header. Readers ask here
before they take memory.
"""

from __future__ import annotations

from pathlib import Path

from stages.contract import StageError

BUDGET = 1 << 30
"""Bytes. The most that a minute of a phone's film needs of one file: five people's SMPL vertices (0.75 GB), a picture of
8K with three channels (0.1 GB), 60 joints of motion (11 million of them a GB)."""
STACK = 1 << 32
"""The same for a stack of masks, the largest of all: 1,800 frames of 1920x1080 (a minute at 30 a second) are 3.7 GB."""
MOST = {
    "pictures": 216_000,  # two hours at 30 a second
    "poses": 108_000,  # an hour of them; each takes some 36 kB on its way to the floor
    "joints": 5_000,  # of a skeleton; those of films, with faces and skirts, have some hundreds
    "bones of clothes": 232,  # with the skeleton's 24 they are numbered by a byte
    "letters": 1_000,  # of a name
    "tracks": 5_000,  # of masks; each is looked for in each picture
}
"""How much of a kind a film, a motion, a skeleton or a name may have."""
HINT = "no file of a phone clip needs that much; if it is right, make it of a shorter clip or smaller pictures"


def check_count(count: float, kind: str, where: Path | str, hint: str = "make it shorter") -> None:
    """StageError where `where` has more of a `kind` than MOST: before memory is taken for them."""
    if not count <= MOST[kind]:
        facts = [f"{count:,.0f} {kind}" if count < 1e15 else f"{count:.3g} {kind}", f"{MOST[kind]:,} are the most"]
        raise StageError(f"{where} has too many {kind}", hint, facts)


class Budget:
    """Counts the bytes of memory that the file `path` may still take; `there` is its own size."""

    def __init__(self, path: Path | str, there: int = 0, most: int = BUDGET):
        self.path, self.most, self.spent = path, there + most, 0

    def spend(self, wanted: int, what: str) -> None:
        """Take `wanted` bytes for `what`; StageError where fewer are left."""
        self.spent += wanted
        if self.spent > self.most:
            left = f"{(self.most - self.spent + wanted) / 1e9:.2f} of its {self.most / 1e9:.2f} GB are left"
            facts = [f"{what} would take {wanted / 1e9:.2f} GB, {left}"]
            raise StageError(f"{self.path} needs too much memory", HINT, facts)
