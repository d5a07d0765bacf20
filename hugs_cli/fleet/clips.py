"""The clips of a fleet: from paths, globs, list files and tables, each with a folder of its own for its results."""

from __future__ import annotations

import csv
import glob
import io
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import digest
from hugs_cli.cache.workspace import clip_name, read_json
from hugs_cli.pipelines import UsageError, document, text_of, unknown

COLUMNS = ("clip", "pipeline", "settings", "masks", "fit", "person")
TABLES = (".csv", ".yaml", ".yml")
LISTS = (".txt",)
LARGEST = 2_000_000  # values of a table
READABLE = "check the path; it must be text in UTF-8"
LONGEST = 240  # bytes of a folder's name, of 255 that it may have
UNSAFE, OLD_UNSAFE = re.compile(r"[^\w.-]"), re.compile(r"[^A-Za-z0-9_.-]")  # in names of folders: now, and before


@dataclass(frozen=True)
class Row:
    """One clip with one pipeline: what `hugs run` is asked to do."""

    video: Path
    work: Path
    pipeline: str
    settings: tuple[str, ...] = ()
    masks: Path | None = None
    fit: Path | None = None
    person: str | None = None

    @property
    def name(self) -> str:
        """The clip as pages name it."""
        return clip_name(self.video)

    @property
    def root(self) -> Path:
        """The folder of the clip's results."""
        return self.work / self.name

    @property
    def id(self) -> str:
        """What tells this row from all others of its fleet: safe as a file's name."""
        told = f"{self.name}.{self.pipeline}"
        return f"{UNSAFE.sub('_', told)[:40]}.{digest([str(self.work), told])[:12]}"

    @property
    def same(self) -> tuple[Any, ...]:
        """Equal for rows that are one, whatever their paths count from."""
        paths = (path and os.path.abspath(path) for path in (self.video, self.work, self.masks, self.fit))
        return *paths, self.pipeline, self.settings, self.person


def read(given: Iterable[str], pipeline: str, settings: Iterable[str], work: Path) -> list[Row]:
    """The rows of all clips given, in order, none twice; UsageError where a table or a pattern cannot be understood.

    What a table leaves open is taken from `pipeline`, and its settings are added to `settings`.
    """
    rows: dict[tuple[Any, ...], Row] = {}
    for text in given:
        for entry, where in entries(text):
            row = row_of(entry, where, pipeline, tuple(settings), work)
            rows.setdefault(row.same, row)
    return told_apart(list(rows.values()))


def entries(text: str) -> Iterator[tuple[dict[str, Any], str]]:
    """The clips that one argument stands for, each with its columns and the place that names it. Paths in a list or table
    are seen from its folder."""
    path = Path(text)
    kind = path.suffix.lower()
    if not path.exists() and glob.has_magic(text):
        found = sorted(glob.glob(text, recursive=True))
        if not found:
            raise UsageError(f"no clip fits {text}", "check the pattern")
        yield from (({"clip": Path(one)}, one) for one in found)
    elif kind in (*TABLES, *LISTS) and not path.is_dir():
        for number, entry in enumerate(listed(path) if kind in LISTS else tabled(path), 1):
            where = f"{path}, clip {number}"
            yield beside(entry, path.parent, where), where
    else:
        yield {"clip": path}, text


def listed(path: Path) -> list[dict[str, Any]]:
    """A clip a line; empty lines and those that begin with # are left out."""
    lines = (line.strip() for line in text_of(path, READABLE).splitlines())
    return [{"clip": line} for line in lines if line and not line.startswith("#")]


def tabled(path: Path) -> list[dict[str, Any]]:
    """The rows of a table: columns by name."""
    if path.suffix.lower() == ".csv":
        text = io.StringIO(text_of(path, READABLE))
        try:
            return [{str(k): v for k, v in row.items()} for row in csv.DictReader(text, strict=True)]
        except csv.Error as error:
            raise UsageError(f"{path} is not valid CSV", "correct what is named above", [str(error)]) from error
    content = document(path, READABLE, LARGEST)
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        raise UsageError(f"{path} holds no list of clips", "write each as `- {clip: dance.mp4, pipeline: preview}`")
    return content


def beside(entry: dict[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """The columns of a clip, checked: paths seen from the table's folder, settings as a list."""
    for column in entry:
        if column not in COLUMNS:
            raise unknown("column", column, COLUMNS, where)
    known = {column: value for column, value in entry.items() if value not in (None, "")}
    settings = known.get("settings", [])
    settings = settings.split(";") if isinstance(settings, str) else settings
    if not isinstance(settings, list) or not all(isinstance(one, str) for one in settings):
        raise UsageError(f"{where}: settings are not understood", "write `train.steps=800; frames.count=40`")
    known["settings"] = tuple(one.strip() for one in settings if one.strip())
    for column in ("clip", "pipeline", "masks", "fit", "person"):
        if isinstance(known.get(column, ""), dict | list):
            raise UsageError(f"{where}: {column} is not a text", "give each clip one")
    if "clip" not in known:
        raise UsageError(f"{where} has no clip", f"columns are {', '.join(COLUMNS)}")
    return known | {column: folder / str(known[column]) for column in ("clip", "masks", "fit") if column in known}


def row_of(entry: dict[str, Any], where: str, pipeline: str, settings: tuple[str, ...], work: Path) -> Row:
    """One row from its columns; UsageError for a path that names no clip."""
    person = entry.get("person")
    row = Row(
        video=entry["clip"],
        work=work,
        pipeline=str(entry.get("pipeline", pipeline)),
        settings=(*settings, *entry.get("settings", ())),
        masks=entry.get("masks"),
        fit=entry.get("fit"),
        person=None if person is None else str(person),
    )
    try:
        clip_name(row.video)
    except UsageError as error:
        raise UsageError(f"{where}: {error.problem}", error.hint) from error
    return row


def told_apart(rows: list[Row]) -> list[Row]:
    """The rows, those of other clips of the same name with a work folder of their own: `work/from-monday` for
    monday/dance.mp4.

    A clip keeps the folder that has its results. UsageError for one clip that is to run twice with one pipeline.
    """
    owners: dict[Path, str] = {}  # folder of results -> clip
    places: dict[str, Path] = {}  # clip -> its work folder
    paths = {os.path.abspath(row.video): row for row in rows}
    for settled in (True, False):  # those that have results choose first
        for path, row in paths.items():
            for work in [] if path in places else work_folders(row.work, Path(path)):
                root = work / row.name
                if root not in owners and (recorded(root) == path if settled else recorded(root) in (None, path)):
                    places[path], owners[root] = work, path
                    break
    found = [replace(row, work=places[os.path.abspath(row.video)]) for row in rows]
    ids: dict[str, Row] = {}
    for row in found:
        if ids.setdefault(row.id, row).same != row.same:
            facts = [f"{' '.join(one.settings) or 'no settings'}, masks {one.masks}, fit {one.fit}, person {one.person}"
                     for one in (ids[row.id], row)]  # fmt: skip
            hint = "give each row another pipeline, see `--pipelines-file`"
            raise UsageError(f"{row.video} is listed twice with pipeline {row.pipeline}", hint, facts)
    return found


def clip_folders(work: Path) -> Iterator[Path]:
    """Folders in a work folder that may hold a clip's results, also those one deeper, in `from-...` (see `work_folders`)."""
    for place in ("*", "from-*/*"):
        yield from work.glob(place)


def work_folders(work: Path, video: Path) -> Iterator[Path]:
    """Where results of a clip may lie: in the work folder, else in one named after the folders that the clip lies in."""
    yield work
    for unsafe in (UNSAFE, OLD_UNSAFE):
        parents = [unsafe.sub("_", part) for part in video.parent.parts[1:]]
        for count in range(1, len(parents) + 1):
            yield work / f"from-{short('-'.join(parents[-count:]))}"
        yield work / f"from-{short('-'.join([*parents, unsafe.sub('_', video.suffix[1:])]))}"
    yield work / f"from-{digest(str(video))[:12]}"  # no other has that


def short(name: str) -> str:
    """The end of a name that no folder may have."""
    return name if len(os.fsencode(name)) < LONGEST else name[-LONGEST // 4 :]


def recorded(root: Path) -> str | None:
    """The clip whose results lie in a folder; None if there is none, or it is no longer where it was."""
    entry = read_json(root / "sources.json").get("video")
    path = entry.get("path") if isinstance(entry, dict) else None
    return path if isinstance(path, str) and os.path.exists(path) else None
