"""Where `hugs render` and `hugs animate` write: they overwrite only what they drew themselves, unless forced."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import content_digest
from hugs_cli.cache.workspace import STAMP, read_json, write_json
from hugs_cli.fleet.clips import clip_folders
from hugs_cli.pipelines import UsageError

MEMORY = ".drawn.json"  # in the work folder: path -> digest of what was drawn there
ELSEWHERE = "choose another `--out`"


def check_out(out: Path, work: Path, given: Iterable[Path | None], force: bool, is_folder: bool = False) -> None:
    """UsageError if drawing to `out`, a file or a folder, would change what no earlier drawing made.

    Never drawn to, not even with `force`: sources of the clips in `work`, files `given` to the command, stored results.
    """
    place = Path(os.path.realpath(out))
    for kind, kept in protected(work, given):
        if any(one.exists() and one.samefile(kept) for one in (place, *place.parents)):
            raise UsageError(f"{out} is {kind}, or lies in it, and is never written over", ELSEWHERE, [str(kept)])
    ground = next(one for one in (place, *place.parents) if one.exists())
    if ground != place and not ground.is_dir():
        raise UsageError(f"cannot write {out}: {ground} is no folder", ELSEWHERE)
    if ground == place and place.is_dir() != is_folder:
        what = "a file, and pictures need a folder" if is_folder else "a folder, and a video is a file"
        raise UsageError(f"cannot write {out}: it is {what}", ELSEWHERE)
    if force or not os.path.lexists(out) or (is_folder and not any(out.iterdir())):
        return
    if not out.exists() or read_json(work / MEMORY).get(str(place)) != content_digest(out):
        facts = ["`hugs` did not write it, or it has changed since"]
        raise UsageError(f"{out} is already there", f"{ELSEWHERE}, or write over it with `--force`", facts)


def protected(work: Path, given: Iterable[Path | None]) -> Iterator[tuple[str, Path]]:
    """What no drawing may change, each with its kind in words: files given, sources of all clips in `work`, stores."""
    clips = list(clip_folders(work))
    entries = (entry for clip in clips for entry in sources_of_results(clip))
    paths = (entry.get("path") for entry in entries)
    sources = (Path(path) for path in paths if path and isinstance(path, str))
    yield from (("a source", path) for path in (*filter(None, given), *sources) if path.exists())
    yield from (("a folder of results", clip / "store") for clip in clips if (clip / "store").is_dir())


def sources_of_results(clip: Path) -> list[dict[str, Any]]:
    """What is known of those sources of a clip that a result in its store was made of."""
    stamps = (read_json(stamp).get("inputs") for stamp in (clip / "store").glob(f"*/{STAMP}"))
    made_of = {content for inputs in stamps if isinstance(inputs, dict) for content in inputs.values()}
    known = (entry for entry in read_json(clip / "sources.json").values() if isinstance(entry, dict))
    return [entry for entry in known if entry.get("sha256") in made_of - {None}]


@contextmanager
def remembering(outs: Iterable[Path], work: Path) -> Iterator[None]:
    """Note what is drawn meanwhile; where that is cut short, what has changed until then, so that it may be drawn again."""
    before = {out: content_digest(out) if out.exists() else None for out in outs}
    try:
        yield
    except BaseException:
        for out, found in before.items():
            if out.exists() and content_digest(out) != found:
                remember_out(out, work)
        raise
    for out in before:
        remember_out(out, work)


def remember_out(out: Path, work: Path) -> None:
    """Note what was drawn to `out`, so that it may be drawn again without `--force`."""
    memory = work / MEMORY
    known = {path: drawn for path, drawn in read_json(memory).items() if os.path.exists(path)}
    with suppress(OSError):  # a folder that may only be read: the next drawing asks for --force
        write_json(memory, {**known, os.path.realpath(out): content_digest(out)})
