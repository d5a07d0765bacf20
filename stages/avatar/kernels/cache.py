"""Where compiled kernels are kept: a folder whose name is a digest of all their sources.

Numba misses an edit of a function that another file's kernel calls (numba #1833); in a new folder it recompiles.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
import time
from pathlib import Path

import numba

from stages.avatar.compiled import places

KEPT = 30 * 86400.0  # s; a process marks its folder when it begins, and none runs for a month


def folder() -> Path:
    """A writable folder for the kernels of exactly these sources, which Numba unpickles: in the user's cache, or else in the
    machine's temporary folder; a new one for this process alone where somebody else could have filled both.

    Removes folders of other sources that no process has begun with for KEPT seconds.
    """
    for place, followed in zip(places(), (True, False), strict=True):
        root = place.parents[1]
        try:
            root.mkdir(mode=0o700, parents=True, exist_ok=True)
            place.parent.mkdir(mode=0o700, exist_ok=True)
            place.mkdir(mode=0o700, exist_ok=True)
            top = root.resolve() if followed else root  # a link of the user's own
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


FOLDER = folder()
numba.config.CACHE_DIR = str(FOLDER)  # read where a kernel is defined; Numba forgets it when its environment changes
