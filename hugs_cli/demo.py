"""Writes the synthetic clip with known truth, once for each seed and version of its code."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
from pathlib import Path

from hugs_cli.cache.fingerprint import Code, digest
from hugs_cli.console import Console
from hugs_cli.direct import run_directly
from stages.contract import Job, StageError

MODULE = "stages.commands.demo"


def synthetic_clip(work: Path, seed: int, console: Console) -> Path:
    """The path of the clip, written if it is not there yet; its truth lies in truth/ beside it."""
    folder = work / "clip" / "synthetic"
    video, note = folder / "clip.mp4", folder / "made.json"
    made_of = digest([seed, Code().digests(MODULE)])
    if video.is_file() and note.is_file() and json.loads(note.read_bytes()) == made_of:
        return video
    folder.parent.mkdir(parents=True, exist_ok=True)
    console.say(f"making the synthetic clip in {folder}")
    with tempfile.TemporaryDirectory(
        dir=folder.parent, prefix=".synthetic-"
    ) as room:  # whole or not there, two at once or not
        part = Path(room, "new")
        part.mkdir()
        writer = multiprocessing.get_context("spawn").Process(target=write, args=(part, seed), daemon=True)
        writer.start()
        writer.join()
        if writer.exitcode != 0:
            raise StageError("the synthetic clip could not be made", "the lines above say why; please report them")
        (part / note.name).write_text(json.dumps(made_of))
        if os.path.lexists(folder):
            os.rename(folder, Path(room, "old"))
        os.rename(part, folder)
    return video


def write(folder: Path, seed: int) -> None:
    """Make the clip. Runs in a process of its own, which gives its memory back."""
    run_directly(MODULE, Job(folder, seed=seed))
