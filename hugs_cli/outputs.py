"""Where commands write: over what they wrote themselves, and over what others made only if forced; never over results."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import content_digest, files_under
from hugs_cli.cache.locks import locked
from hugs_cli.cache.whole import replace
from hugs_cli.cache.workspace import LOCK, STAMP, read_json
from hugs_cli.fleet.clips import clip_folders
from hugs_cli.pipelines import UsageError

MEMORY = ".drawn.json"  # in the work folder: path -> digests of what was drawn there, the last ones
KEPT = 4  # of these: that of a file which a killed command was about to put there, and those before it
MOST = 1000  # paths; beyond it those whose files are gone are forgotten
ELSEWHERE = "choose another `--out`"


def check_out(out: Path, work: Path, given: Iterable[Path | None], force: bool, is_folder: bool = False) -> None:
    """UsageError if drawing to `out`, a file or a folder, would change what no earlier drawing made.

    Never drawn to, not even with `force`: sources of the clips in `work`, files `given` to the command, stored results.
    """
    place = Path(os.path.realpath(out))
    for kind, kept in protected(work, given, place):
        if any(one.exists() and one.samefile(kept) for one in (place, *place.parents)):
            raise UsageError(f"cannot write {out}: it is {kind}, or lies in one", ELSEWHERE, [str(kept)])
    ground = next(one for one in (place, *place.parents) if one.exists())
    if ground != place and not ground.is_dir():
        raise UsageError(f"cannot write {out}: {ground} is not a folder", ELSEWHERE)
    if ground == place and place.is_dir() != is_folder:
        what = "a file, not a folder" if is_folder else "a folder, not a file"
        raise UsageError(f"cannot write {out}: it is {what}", ELSEWHERE)
    if force or not os.path.lexists(out) or (is_folder and not any(out.iterdir())):
        return
    known = read_json(work / MEMORY)
    if not out.exists() or any(
        content_digest(file) not in known.get(name_of(file), ()) for file in files_under(out).values()
    ):
        facts = ["`hugs` did not write it, or it has changed since"]
        raise UsageError(f"{out} is already there", f"{ELSEWHERE}, or overwrite it with `--force`", facts)


def protected(work: Path, given: Iterable[Path | None], place: Path) -> Iterator[tuple[str, Path]]:
    """What no drawing may change, each with its kind in words: files given, sources of all clips in `work` and of the runs
    given, stores, and whatever holds `place` and is a result of any work folder."""
    named = [path for path in given if path is not None]
    runs = (Path(os.path.realpath(link)).parents[1] for run in named if run.is_dir() for link in run.glob("train"))
    clips = [*clip_folders(work), *runs]
    paths = (entry.get("path") for clip in clips for entry in sources_of_results(clip))
    sources = (Path(path) for path in paths if path and isinstance(path, str))
    yield from (("a source", path) for path in (*named, *sources) if path.exists())
    yield from (("a folder of results", clip / "store") for clip in clips if (clip / "store").is_dir())
    yield from (("a result", one) for one in place.parents if (one / STAMP).exists())


def sources_of_results(clip: Path) -> list[dict[str, Any]]:
    """What is known of those sources of a clip that a result in its store was made of."""
    stamps = (read_json(stamp).get("inputs") for stamp in (clip / "store").glob(f"*/{STAMP}"))
    made_of = {content for inputs in stamps if isinstance(inputs, dict) for content in inputs.values()}
    known = (entry for entry in read_json(clip / "sources.json").values() if isinstance(entry, dict))
    return [entry for entry in known if entry.get("sha256") in made_of - {None}]


def name_of(out: Path) -> str:
    """The name by which a file is remembered: of a link itself, not of what it leads to."""
    return os.path.join(os.path.realpath(out.parent), out.name)


def remember_out(out: Path, part: Path, work: Path) -> None:
    """Note what is about to appear at `out` and is still called `part`, so that it may be drawn again without `--force`."""
    memory = work / MEMORY
    # in a folder that may only be read nothing is noted: the next drawing asks for --force
    with suppress(OSError), locked(work / LOCK, lambda holder: None, without=True):
        known = read_json(memory)
        if len(known) > MOST:
            known = {path: drawn for path, drawn in known.items() if os.path.exists(path)}
        before, new = known.get(name_of(out), []), content_digest(part)
        before = [one for one in before if one != new] if isinstance(before, list) else [before]
        replace(memory, json.dumps({**known, name_of(out): [*before[1 - KEPT :], new]}, indent=1))


def remembering(work: Path, heard: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
    """What hears the events of a command's job: notes each file that it writes, and passes on the rest."""

    def hear(event: dict[str, Any]) -> None:
        if event["event"] == "writes":
            remember_out(event["out"], event["part"], work)
        else:
            heard(event)

    return hear
