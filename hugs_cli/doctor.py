"""Checks the machine, the installed libraries and the model files, and says how to get what is missing."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hugs_cli.cache import child
from hugs_cli.device import find_device
from hugs_cli.direct import run_directly
from hugs_cli.words import size
from stages.contract import Job

DISTRIBUTIONS = {
    **child.LIBRARIES,
    **{name: name for name in ("typer", "pydantic", "typing_extensions", "jinja2", "matplotlib", "backports-zstd")},
    "yaml": "PyYAML",
}
HINTS = {"free body": "clone the repository again", "film colours": "pip install --upgrade av"}
MEMORY_NEEDED, DISK_NEEDED = 6 * 2**30, 2 * 2**30  # to run all stages; for the results of one clip and copies


@dataclass(frozen=True)
class Finding:
    """One thing that was checked."""

    name: str
    ok: bool
    text: str = ""
    hint: str = ""
    optional: bool = False


def examine() -> list[Finding]:
    """All findings, in the order in which they are printed."""
    return [*machine(), *packages(), *codecs(), *models()]


def machine() -> list[Finding]:
    """Python, processors, memory, disk, GPU."""
    python = sys.version_info[:2]
    memory, disk = memory_bytes(), shutil.disk_usage(Path.cwd()).free
    gpu = find_device() == "cuda"
    return [
        Finding("python", (3, 11) <= python <= (3, 13), platform.python_version(), "use Python 3.11, 3.12 or 3.13"),
        Finding("processors", True, str(child.processors())),
        Finding("memory", memory >= MEMORY_NEEDED, size(memory), "6 GiB are needed; try `--pipeline preview`", True),
        Finding("disk", disk >= DISK_NEEDED, f"{size(disk)} free", "`hugs gc` frees some", True),
        Finding("GPU", gpu, "CUDA" if gpu else "", "not needed; with an NVIDIA GPU install torch for CUDA", True),
        *([gsplat()] if gpu else []),
    ]


def gsplat() -> Finding:
    """The library that draws on a GPU, and the compiler it needs once."""
    found = importlib.util.find_spec("gsplat")
    if found is None:
        return Finding("gsplat", False, hint="pip install 'hugs-avatar[gpu]'", optional=True)
    built = any(list(Path(folder).glob("csrc.*")) for folder in found.submodule_search_locations or ())
    if not built and shutil.which("nvcc") is None:
        text = "gsplat builds its kernels at the first use and needs nvcc (the CUDA toolkit)"
        return Finding("gsplat", False, hint=text, optional=True)
    return Finding("gsplat", True, importlib.metadata.version("gsplat"))


def memory_bytes() -> int:
    """Memory of the machine, or of the container where that is less."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.is_file() else "max"
    return total if text == "max" else min(total, int(text))


def packages() -> list[Finding]:
    """Each library that hugs depends on, with its version."""
    found = []
    for distribution in DISTRIBUTIONS.values():
        try:
            found.append(Finding(distribution, True, importlib.metadata.version(distribution)))
        except importlib.metadata.PackageNotFoundError:
            found.append(Finding(distribution, False, hint=f"pip install {distribution}"))
    return found


def codecs() -> list[Finding]:
    """Can videos be read and H.264 be written?"""
    if importlib.util.find_spec("av") is None:
        return []
    import av

    found = []
    wanted: tuple[tuple[str, Literal["r", "w"], str], ...] = (
        ("h264", "r", "reads H.264"),
        ("hevc", "r", "reads HEVC"),
        ("libx264", "w", "writes H.264"),
    )
    for name, mode, what in wanted:
        hint = "pip install --force-reinstall av"
        found.append(Finding(f"codec {name}", name in av.codecs_available, what, hint))
        if found[-1].ok:
            av.codec.Codec(name, mode)
    return found


def models() -> list[Finding]:
    """The body that ships with hugs, how films are decoded, and the model files that are fetched."""
    found: list[Finding] = []

    def heard(event: dict[str, Any]) -> None:
        hint = HINTS.get(event["name"], "hugs doctor --fetch")
        found.append(Finding(event["name"], event["here"], event["why"], hint))

    run_directly("stages.commands.models", Job(Path(), emit=heard))
    return found


def fetch_missing(say: Callable[[str], None]) -> None:
    """Fetch every model file that is missing; StageError if one cannot be had."""

    def heard(event: dict[str, Any]) -> None:
        if event["event"] == "note":
            say(event["text"])

    run_directly("stages.commands.models", Job(Path(), emit=heard), {"fetch": True})
