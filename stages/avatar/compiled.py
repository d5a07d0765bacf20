"""Which kernels are compiled, read from the files that Numba keeps, without Numba, which takes long to load."""

from __future__ import annotations

import hashlib
import os
import pickletools
import re
import sys
import tempfile
from importlib import metadata
from pathlib import Path

HOUSE = Path(os.path.abspath(__file__)).parent
ROOM = "stages.avatar.kernels"
IMPORTED = re.compile(r"^from (stages\.avatar[\w.]*) import", re.MULTILINE)


def sources(house: Path = HOUSE) -> list[Path]:
    """Files of the package `avatar` that define kernels, or constants that kernels read: those that import `kernels`,
    and what they import.
    """
    texts = {file: file.read_text() for file in sorted(house.rglob("*.py"))}
    named = {".".join(file.relative_to(house.parents[1]).with_suffix("").parts): file for file in texts}
    own = [file for file, text in texts.items() if f"from {ROOM}" in text or file.parent == house / "kernels"]
    read = (named.get(module) for file in own for module in IMPORTED.findall(texts[file]))
    return sorted({*own, *filter(None, read)})


def places() -> tuple[Path, Path]:
    """Where kernels of exactly these sources are kept: in the user's cache, or else in the machine's temporary folder."""
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sources())).hexdigest()[:16]
    home = Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs")
    return home / "kernels" / digest, Path(tempfile.gettempdir()) / f"hugs-{os.getuid()}" / "kernels" / digest


def is_compiled(file: str, kernel: str) -> bool:
    """Whether Numba has compiled a kernel of a file of `avatar`, as 'rasterize/blend.py': of these sources, in this version, for
    this Python and this processor.
    """
    from llvmlite.binding import get_host_cpu_name

    source, needed = HOUSE / file, {metadata.version("numba"), get_host_cpu_name()}
    folder = f"{source.parent.name}_{hashlib.sha1(str(source.parent).encode()).hexdigest()}"
    name = f"{source.stem}.{kernel}-*.py{sys.version_info[0]}{sys.version_info[1]}*.nbi"
    return any(needed <= words(index) for place in places() for index in (place / folder).glob(name))


def words(index: Path) -> set[object]:
    """Texts and numbers in an index of Numba's, two pickles, of which nothing is run; none where it cannot be read."""
    try:
        with index.open("rb") as file:
            return {word for _ in range(2) for _, word, _ in pickletools.genops(file)}
    except (OSError, ValueError):
        return set()
