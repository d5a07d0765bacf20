"""Writes the synthetic clip with known truth, once for each seed and version of its code."""

from __future__ import annotations

import json
import multiprocessing
from pathlib import Path

from hugs_cli.cache.fingerprint import Code, digest
from hugs_cli.console import Console
from stages.contract import StageError

MODULES = ("stages.synthetic.clip", "stages.synthetic.files")


def synthetic_clip(work: Path, seed: int, console: Console) -> Path:
    """The path of the clip, written if it is not there yet; its truth lies in truth/ beside it."""
    folder = work / "clip" / "synthetic"
    video, note = folder / "clip.mp4", folder / "made.json"
    made_of = digest([seed, [Code().digests(module) for module in MODULES]])
    if video.is_file() and note.is_file() and json.loads(note.read_bytes()) == made_of:
        return video
    folder.mkdir(parents=True, exist_ok=True)
    note.unlink(missing_ok=True)
    console.say(f"making the synthetic clip in {folder}")
    writer = multiprocessing.get_context("spawn").Process(target=write, args=(folder, seed), daemon=True)
    writer.start()
    writer.join()
    if writer.exitcode != 0:
        raise StageError("the synthetic clip could not be made", "the lines above say why; please report them")
    note.write_text(json.dumps(made_of))
    return video


def write(folder: Path, seed: int) -> None:
    """In a process of its own, so that what it loads is gone afterwards."""
    from stages.formats.body_model import read_body_model
    from stages.synthetic.clip import make_clip
    from stages.synthetic.files import write_clip

    write_clip(folder, make_clip(read_body_model(None), seed=seed))
