"""The page of a fleet. No pipeline names it; `hugs fleet` runs it again and again while clips are made."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from stages import contract
from stages.contract import Job, StageError, whole

ORDER = ("failed", "lost", "running", "before", "waiting", "todo", "stopped", "done", "fresh")
WORDS = {"todo": "to do", "before": "before training done"}
RELOAD = 5  # s, while clips are made
PATIENCE = 180  # s without a new page, after which the old one says so
PICTURES = ".fleet/pictures"  # small ones, in the work folder
TALL = 54  # px
SHARE = 1.0  # s that new pictures may take of one writing of a live page; the rest come with the next


class Params(contract.Params):
    pass


def run(
    job: Job, params: Params, *, name: str, rows: Sequence[Mapping[str, Any]], totals: Mapping[str, Any], live: bool
) -> None:
    """Write NAME.html in one step: `rows` and `totals` as `hugs fleet --json` prints them. `live` pages load themselves again."""
    from stages.formats import page

    _draw(job.out, rows, SHARE if live else float("inf"))
    states = [(state, WORDS.get(state, state), totals["states"][state]) for state in _sorted(totals["states"])]
    text = page.fill(
        "fleet.html",
        title=f"{name}: {', '.join(f'{count} {shown}' for _, shown, count in states)}",
        name=name,
        rows=[_shown(job.out, row) for row in rows],
        states=states,
        failures=totals["failures"],
        hours=[("machine time in these results", _time(totals["machine_seconds"])),
               ("machine time of this call", _time(totals["spent_seconds"])),
               *([("left, about", _time(totals["seconds_left"]))] if live else [])],
        reload=RELOAD if live else 0,
        patience=PATIENCE,
        written=time.strftime("%Y-%m-%d %H:%M:%S %Z"),
        page=f"{time.time_ns():x}",
    )  # fmt: skip
    _replace(job.out / f"{name}.html", text.encode(errors="replace"))


def _sorted(states: Mapping[str, int]) -> list[str]:
    return [state for state in ORDER if state in states]


def _small(row: Mapping[str, Any]) -> str:
    """Where the small picture of a row lies, seen from the work folder. Results never change, so neither does it."""
    name = hashlib.sha256(os.fsencode(f"{row['folder']}/{row['picture']}")).hexdigest()
    return f"{PICTURES}/{name[:20]}.jpg"


def _draw(work: Path, rows: Sequence[Mapping[str, Any]], seconds: float) -> None:
    """Make the small pictures that are missing, as many as that time allows. A page opens in no time with these; with the
    pictures that they show it took seconds."""
    import cv2

    from stages.formats.images import read_image

    end = time.monotonic() + seconds
    (work / PICTURES).mkdir(parents=True, exist_ok=True)
    for row in rows:
        small = work / _small(row)
        if not row["picture"] or small.exists():
            continue
        if time.monotonic() > end:
            return
        try:
            pixels = read_image(work / row["folder"] / "store" / row["picture"])
        except (StageError, OSError):
            continue  # the run itself says what is wrong with it
        wide = max(1, round(pixels.shape[1] * TALL / pixels.shape[0]))
        pixels = cv2.resize(pixels, (wide, TALL), interpolation=cv2.INTER_AREA)
        _replace(small, cv2.imencode(".jpg", pixels[..., ::-1])[1].tobytes())


def _replace(path: Path, data: bytes) -> None:
    with whole(path) as part:
        part.write_bytes(data)


def _shown(work: Path, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with its words and links."""
    small = _small(row) if row["picture"] else ""
    place = quote(os.fsencode(f"{row['folder']}/{row['pipeline']}"))
    pages = [
        (path.rpartition("/")[2].removesuffix(".html"), f"{place}/{quote(os.fsencode(path))}") for path in row["pages"]
    ]
    percent = "" if row["percent"] is None else f" {row['percent']} %"
    silent = "" if row["silent"] is None else f", no sign of life for {_time(row['silent'])}"
    return {
        **row,
        "order": ORDER.index(row["state"]),
        "said": WORDS.get(row["state"], row["state"]),
        "at": f"{row['stage']}{percent}{silent}" if row["stage"] else "",
        "left": "" if not row["seconds_left"] else _time(row["seconds_left"]),
        "took": "" if row["seconds"] is None else _time(row["seconds"]),
        "image": small if small and (work / small).exists() else "",
        "log": quote(os.fsencode(row["log"])),
        "pages": pages,
    }


def _time(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
