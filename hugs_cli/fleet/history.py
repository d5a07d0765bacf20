"""What memory earlier runs in a work folder took, as their runs.jsonl tell, and how much this machine has."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from hugs_cli.fleet.clips import clip_folders

CLIPS = 500  # whose runs are read; more tell nothing new
MARGIN = 1.25  # a clip may need more memory than those before it
UNMEASURED_MB = 4000  # of a clip whose pipeline never ran here: twice what `default` took (README)
OWN_MB = 200  # of the process that starts the stages of a clip


@dataclass(frozen=True)
class History:
    """The most memory; pipeline -> bytes."""

    memory: dict[str, int]

    def megabytes(self, pipeline: str) -> int:
        """Memory to keep free for a clip, in MB of 2**20 bytes."""
        most = self.memory.get(pipeline, 0)
        return OWN_MB + round(MARGIN * most / 2**20) if most else UNMEASURED_MB


def history(work: Path) -> History:
    """What the runs of up to CLIPS clips of a work folder tell. A line that cannot be read is left out."""
    memory: dict[str, int] = defaultdict(int)
    files = filter(Path.is_file, (clip / "runs.jsonl" for clip in clip_folders(work)))
    for file in islice(files, CLIPS):
        for run in runs(file):
            with suppress(KeyError, TypeError, ValueError):
                memory[run["pipeline"]] = max(memory[run["pipeline"]], int(run["peak_memory_bytes"]))
    return History(dict(memory))


def runs(file: Path) -> list[dict]:
    """The lines of one runs.jsonl that can be read."""
    found = []
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            run = json.loads(line)
        except ValueError:
            continue
        if isinstance(run, dict):
            found.append(run)
    return found


def free_megabytes(room: Path = Path("/")) -> int:
    """Memory that processes may still take here, in MB, at least 1; 0 where the system does not say. `room`: of proc and
    sys."""
    free = []
    with suppress(OSError, ValueError, KeyError):
        free.append(numbers(room / "proc/meminfo")["MemAvailable:"] // 1024)
    with suppress(OSError, ValueError, KeyError):
        group = room / "sys/fs/cgroup"
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))  # or no limit: "max"
        kept = numbers(group / "memory.stat")["inactive_file"]  # of files, which gives way
        free.append((limit - used + kept) // 2**20)
    if not free and "SC_PHYS_PAGES" in os.sysconf_names:
        free = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2**21]  # half of all
    return max(1, min(free)) if free else 0


def numbers(file: Path) -> dict[str, int]:
    """Name -> number, of a file with a line for each."""
    lines = (line.split() for line in file.read_text().splitlines())
    return {words[0]: int(words[1]) for words in lines if len(words) > 1}
