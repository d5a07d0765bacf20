"""Where compiled kernels are kept. Importing this module must come before any kernel is defined.

Numba does not notice an edit of a function that another file's kernel calls (numba #1833), so the folder's name is a
digest of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from pathlib import Path

import numba

SOURCES = (
    "cache.py",
    "rendering.py",
    "lanes.py",
    "kernels.py",
    "tiles.py",
    "blend.py",
    "cpu.py",
    "../ssim.py",
    "../triplane.py",
    "../mesh_render.py",
)
KEPT = 30 * 86400.0  # s; a process marks its folder when it begins, and none runs for a month


def folder() -> Path:
    """A writable folder for the kernels of exactly these sources: the user's cache, or else the machine's temporary one.

    Folders of other sources that no process has begun with for KEPT seconds are removed.
    """
    here = Path(__file__).parent
    digest = hashlib.sha256(b"".join((here / name).read_bytes() for name in SOURCES)).hexdigest()[:16]
    home = Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs")
    for root in (home, Path(tempfile.gettempdir()) / f"hugs-{os.getuid()}"):
        place = root / "kernels" / digest
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(place, os.W_OK):
            place.touch()
            tidy(place.parent, time.time() - KEPT)
            return place
    raise OSError(f"no folder for compiled kernels can be written, neither in {home} nor in {tempfile.gettempdir()}")


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


def compiled() -> bool:
    """Whether an earlier process has left the kernels of these sources, for this processor or another."""
    return any(FOLDER.glob("*/blend.draw_backward*.nbi"))


FOLDER = folder()
numba.config.CACHE_DIR = str(FOLDER)  # read where a kernel is defined; Numba forgets it when its environment changes
