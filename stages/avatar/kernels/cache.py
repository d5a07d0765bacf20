"""Where compiled kernels are kept: a folder whose name is a digest of all their sources.

Numba misses an edit of a function that another file's kernel calls (numba #1833); in a new folder it recompiles.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import stat
import tempfile
import time
from pathlib import Path

import numba
from numba.core.dispatcher import Dispatcher

HOUSE = Path(__file__).parents[1]
ROOM = "stages.avatar.kernels"
IMPORTED = re.compile(r"^from (stages\.avatar[\w.]*) import", re.MULTILINE)
KEPT = 30 * 86400.0  # s; a process marks its folder when it begins, and none runs for a month


def sources(house: Path = HOUSE) -> list[Path]:
    """Files of the package `avatar` that define kernels, or constants that kernels read: those that import `kernels`,
    and what they import.
    """
    texts = {file: file.read_text() for file in sorted(house.rglob("*.py"))}
    named = {".".join(file.relative_to(house.parents[1]).with_suffix("").parts): file for file in texts}
    own = [file for file, text in texts.items() if f"from {ROOM}" in text or file.parent == house / "kernels"]
    read = (named.get(module) for file in own for module in IMPORTED.findall(texts[file]))
    return sorted({*own, *filter(None, read)})


def folder() -> Path:
    """A writable folder for the kernels of exactly these sources, which Numba unpickles: in the user's cache, or else in the
    machine's temporary folder; a new one for this process alone where somebody else could have filled both.

    Removes folders of other sources that no process has begun with for KEPT seconds.
    """
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sources())).hexdigest()[:16]
    home = Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs")
    for root in (home, Path(tempfile.gettempdir()) / f"hugs-{os.getuid()}"):
        place = root / "kernels" / digest
        try:
            root.mkdir(mode=0o700, parents=True, exist_ok=True)
            place.parent.mkdir(mode=0o700, exist_ok=True)
            place.mkdir(mode=0o700, exist_ok=True)
            top = root.resolve() if root is home else root  # a link of the user's own is followed
            if os.access(place, os.W_OK) and is_ours(top) and is_ours(place.parent) and is_ours(place):
                place.touch()
                tidy(place.parent, time.time() - KEPT)
                return place
        except OSError:
            continue
    own = Path(tempfile.mkdtemp(prefix="hugs-kernels-"))
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def is_ours(place: Path) -> bool:
    """Whether only this user (and root) can have put something into a folder, or anything in its place."""
    info = os.lstat(place)
    return (
        stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


def tidy(root: Path, before: float) -> None:
    """Remove the folders in `root` that were last marked before a time; another process may be doing the same."""
    with os.scandir(root) as entries:
        for entry in entries:
            try:
                old = entry.is_dir(follow_symlinks=False) and entry.stat().st_mtime < before
            except OSError:
                continue
            if old:
                shutil.rmtree(entry.path, ignore_errors=True)


def compiled(kernel: Dispatcher) -> bool:
    """Whether this installation has compiled a kernel of Numba before, for this processor or another."""
    return any(Path(str(kernel.stats.cache_path)).glob(f"*.{kernel.py_func.__name__}-*.nbi"))


FOLDER = folder()
numba.config.CACHE_DIR = str(FOLDER)  # read where a kernel is defined; Numba forgets it when its environment changes
