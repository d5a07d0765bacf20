"""Where compiled kernels are kept. Importing this module must come before any kernel is defined.

Numba does not notice an edit of a function that another file's kernel calls (numba #1833), so the folder's name is a
digest of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
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
)


def folder() -> Path:
    """A writable folder for the kernels of exactly these sources: the user's cache, or else the machine's temporary one."""
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
            return place
    raise OSError(f"no folder for compiled kernels can be written, neither in {home} nor in {tempfile.gettempdir()}")


def compiled() -> bool:
    """Whether an earlier process has left the kernels of these sources, for this processor or another."""
    return any(Path(numba.config.CACHE_DIR).glob("*/blend.draw_backward*.nbi"))


numba.config.CACHE_DIR = str(folder())
