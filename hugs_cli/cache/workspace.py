"""The folders of one clip: a store with one folder per key, links for each pipeline, stamps, lock, garbage.

work/dance/  sources.json  runs.jsonl  .lock
    default/train -> ../store/train-3f2a9c1b
    store/train-3f2a9c1b/  ... stamp.json log.txt        store/train-77e0b3d4.part/  cut short
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NotRequired

from pydantic import AfterValidator, TypeAdapter
from typing_extensions import TypedDict  # as pydantic checks it, before Python 3.12

from hugs_cli.cache import fingerprint
from hugs_cli.cache.locks import locked
from hugs_cli.cache.whole import replace
from hugs_cli.pipelines import UsageError
from stages.contract import whole

STAMP, LOG = "stamp.json", "log.txt"
OPTIONS = "options.json"  # in a pipeline's folder: those of its last run
OURS = (STAMP, LOG)  # in a result's folder, but no part of the result
PART, OLD = ".part", ".old"
LOCK, USERS = ".lock", ".users.json"  # of a store; which folders of clips have it by a link
RESULT = re.compile(r"[a-z][a-z0-9_]*-[0-9a-f]{8}(\.part|\.old)?")


def with_zone(text: str) -> str:
    """The text if it is a time with a zone, else ValueError."""
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("a time without its zone")
    return text


Time = Annotated[str, AfterValidator(with_zone)]


class FileFacts(TypedDict):
    """One file of a result."""

    size: int
    mtime_ns: int
    sha256: str


class Machine(TypedDict):
    """Where a result was made."""

    host: str
    device: str
    system: str
    processors: int
    versions: dict[str, str]
    peak_gpu_memory_bytes: NotRequired[int]


class Accepted(TypedDict):
    """One use of `hugs accept`: when, the key before it, and the changes of code."""

    when: Time
    instead_of: str
    changes: list[str]


@dataclass(frozen=True)
class Stamp:
    """The recipe and the costs of a finished result. Written last: a folder with a stamp is whole."""

    stage: str
    key: str
    seed: int
    code: dict[str, str]
    params: dict[str, Any]
    inputs: dict[str, str | None]
    content: str
    """Digest of names and bytes of all files. Later stages depend on it, not on the key."""
    files: dict[str, FileFacts]
    """By relative name."""
    made: Time
    seconds: float
    peak_memory_bytes: int
    machine: Machine
    """Shown, never compared."""
    reasons: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    accepted: list[Accepted] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Stamp | None:
        """The stamp of a folder; None if there is none, or a broken one."""
        try:
            return stamp_form().validate_json((folder / STAMP).read_bytes(), strict=True)
        except (OSError, ValueError):
            return None

    def write(self, folder: Path) -> None:
        """Write the stamp in one step and make sure that it is on the disk."""
        write_json(folder / STAMP, asdict(self))
        sync(folder)

    def damage(self, folder: Path) -> str:
        """The first file that is missing or has changed, or ''. Reads bytes only where size or time differ, and once of files
        to which something was done after the stamp was written, as by a copy: it is touched then."""
        late, name = False, STAMP
        try:
            sealed = os.stat(folder / STAMP)
            for name, facts in self.files.items():
                stat = os.stat(folder / name)
                late |= (after := stat.st_ctime_ns > sealed.st_ctime_ns)
                read = after or (stat.st_size, stat.st_mtime_ns) != (facts["size"], facts["mtime_ns"])
                if read and fingerprint.file_digest(folder / name) != facts["sha256"]:
                    return f"{name} is not what was written"
        except OSError:
            return f"{name} is missing"
        if late:
            with suppress(OSError):  # where it may only be read, that costs time
                os.utime(folder / STAMP, ns=(sealed.st_atime_ns, sealed.st_mtime_ns))
        return ""


@cache
def stamp_form() -> TypeAdapter[Stamp]:
    """The check of a stamp's JSON; built once, since that takes time."""
    return TypeAdapter(Stamp)


class Workspace:
    """The folders of one clip's results, as one pipeline sees them."""

    def __init__(self, video: Path, work: Path, pipeline: str):
        self.root = work / clip_name(video)
        self.store = self.root / "store"
        self.links = self.root / pipeline
        self.work = work
        self.leased = False
        """Whether this process holds the clip's lease (fleet/lease.py), and can do without locks."""

    def create(self) -> None:
        """Make the folders; UsageError where they cannot be written."""
        try:
            self.store.mkdir(parents=True, exist_ok=True)
            self.links.mkdir(exist_ok=True)
            self.log_run()
            if self.store.is_symlink() and (root := os.path.realpath(self.root)) not in (users := self.users()):
                write_json(self.beside(USERS), {"users": [*users, root]})
        except OSError as error:
            hint = "choose a writable folder with `--work`"
            raise UsageError(f"cannot write to {self.root}", hint, [str(error.strerror)]) from error

    def folder(self, stage: str, key: str) -> Path:
        """The folder of a finished result."""
        return self.store / f"{stage}-{key[:8]}"

    def part(self, stage: str, key: str) -> Path:
        """The folder of an unfinished result."""
        return self.store / f"{stage}-{key[:8]}{PART}"

    def linked(self, stage: str) -> Path | None:
        """The store folder that the pipeline's link of a stage points to."""
        name = result_behind(self.links / stage)
        return self.store / name if name else None

    def keep_options(self, options: dict[str, Any]) -> None:
        """Keep the options of the pipeline's last run beside its results; nothing where there are none."""
        if options and read_json(self.links / OPTIONS) != options:
            self.links.mkdir(exist_ok=True)
            write_json(self.links / OPTIONS, options)

    def link(self, stage: str, folder: Path) -> None:
        """Point this pipeline's link at a result, in one step."""
        self.links.mkdir(exist_ok=True)
        self.point(self.links / stage, folder)

    def point(self, link: Path, folder: Path) -> None:
        """Point any link at a result; a copy of a result that stands in the link's place goes to the store."""
        name = result_behind(link)
        if link.is_dir() and not link.is_symlink():
            if name is None:
                raise UsageError(f"{link} is not a link to a result", "move it away, then run again")
            old = self.store / (name + OLD)
            shutil.rmtree(old, ignore_errors=True)
            shutil.move(link, old if (self.store / name).exists() else self.store / name)
            shutil.rmtree(old, ignore_errors=True)
        elif os.path.realpath(link) == os.path.realpath(folder):
            return
        way, real = os.path.join("..", "store", folder.name), os.path.realpath(folder)
        if os.path.realpath(link.parent / way) != real:  # the pipeline's folder is a link, or the clip's is another one
            way = os.path.relpath(real, os.path.realpath(link.parent))
        with whole(link) as new:
            new.symlink_to(way)

    def publish(self, part: Path, folder: Path) -> None:
        """Give a stamped folder its final name. Replaces a damaged or forced one of that name."""
        old = folder.with_name(folder.name + OLD)
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.rename(folder, old)
        os.rename(part, folder)
        sync(self.store)
        shutil.rmtree(old, ignore_errors=True)

    def source(self, name: str, path: Path | None) -> str | None:
        """Digest of a source's content; None if not given. Remembered while size and time of its files stay."""
        if path is None:
            return None
        memory = self.root / "sources.json"
        known, stat, place = read_json(memory), fingerprint.stat_digest(path), os.path.abspath(path)
        entry = known.get(name)
        if isinstance(entry, dict) and (entry.get("path"), entry.get("stat")) == (place, stat) and "sha256" in entry:
            return str(entry["sha256"])
        sha256 = fingerprint.content_digest(path)
        files = fingerprint.files_under(path).values()
        size = sum(file.stat().st_size for file in files)
        old, entry = entry, {"path": place, "size": size, "files": len(files), "stat": stat, "sha256": sha256}
        if isinstance(old, dict) and "sha256" in old:  # results may be made of it, and it is still a source then
            known[f"{name} {old['sha256']}"] = old
        with suppress(OSError):  # no folder yet, or one that may only be read: it costs time, not correctness
            write_json(memory, {**known, name: entry})
        return sha256

    def with_content(self, stage: str, content: str | None) -> Iterator[tuple[Path, Stamp]]:
        """The stored results of a stage that have that content."""
        for folder in sorted(self.store.glob(f"{stage}-*")):
            stamp = Stamp.read(folder)
            if stamp and stamp.content == content:
                yield folder, stamp

    def films(self, stamp: Stamp) -> set[str]:
        """Digests of the films behind a result, found through the stored results before it; empty where these are
        gone. Films that give the same frames share all later results."""
        found, open_ = set(), list(stamp.inputs.items())
        for need, content in open_:
            if need == "video" and content:
                found.add(content)
            for _, before in self.with_content(need, content):
                open_ += [item for item in before.inputs.items() if item not in open_]
        return found

    def log_run(self, **facts: Any) -> None:
        """Add a line to runs.jsonl, never to a file elsewhere. Without facts: only test that it can be written."""
        log = self.root / "runs.jsonl"
        if log.is_symlink() and log.is_file():
            log.unlink()
        with open(log, "a", encoding="utf-8") as file:
            file.write(json.dumps(facts) + "\n" if facts else "")

    @contextmanager
    def lock(self, waiting: Callable[[str], None]) -> Iterator[int]:
        """Lock the store, for all folders of links that have it; see `locks.locked`. The lock belongs to the open file, so a
        stage's process that outlives a killed run still holds it."""
        with locked(self.beside(LOCK), waiting, without=self.leased) as handle:
            yield handle

    def beside(self, name: str) -> Path:
        """A file that belongs to the real store, wherever links to it lie: in the clip's folder, or in a store of another name."""
        store = Path(os.path.realpath(self.store))
        return (store.parent if store.name == "store" else store) / name

    def users(self) -> set[str]:
        """The folders of clips that have this store by a link, and are there."""
        named = read_json(self.beside(USERS)).get("users")
        return {one for one in named if os.path.lexists(str(one))} if isinstance(named, list) else set()


def result_behind(link: Path) -> str | None:
    """The name of the result that a pipeline's link points to; None if it is none.

    A work folder that was copied with its links resolved has a copy of the result there, with its stamp.
    """
    stamp = None if link.is_symlink() else Stamp.read(link)
    name = f"{stamp.stage}-{stamp.key[:8]}" if stamp else os.path.basename(os.path.realpath(link))
    return name if (stamp or link.is_symlink()) and RESULT.fullmatch(name) else None


def is_result(path: Path) -> bool:
    """Whether something in a store is a result of a run, finished or not."""
    return RESULT.fullmatch(path.name) is not None and path.is_dir() and not path.is_symlink()


def remove(path: Path) -> None:
    """Remove a folder, or only the link where it is one."""
    path.unlink() if path.is_symlink() else shutil.rmtree(path)


def clip_name(video: Path) -> str:
    """The name of a clip's folder: the video's name without its ending; UsageError for one that names no folder."""
    video = Path(os.path.abspath(video))
    name = os.fsencode(video.stem if video.suffix and not video.is_dir() else video.name).decode(errors="replace")
    if name in ("", ".", ".."):
        raise UsageError(f"no clip can be named after {video}", "give a video, or a folder with a name")
    return name


def seal(folder: Path) -> tuple[str, dict[str, FileFacts]]:
    """Flush a finished result's files to the disk; returns the digest of all and the facts of each."""
    files: dict[str, FileFacts] = {}
    for name, path in fingerprint.files_under(folder).items():
        if name in OURS:
            continue
        sync(path)
        stat = path.stat()
        sha256 = fingerprint.file_digest(path)
        files[name] = {"size": stat.st_size, "mtime_ns": stat.st_mtime_ns, "sha256": sha256}
    return fingerprint.digest({name: facts["sha256"] for name, facts in files.items()}), files


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of names, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def size_of(folder: Path) -> int:
    """Bytes of all files under a folder."""
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def read_json(path: Path) -> dict[str, Any]:
    """The values of a JSON file that is not essential: empty if it is missing or broken."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def decisions(folder: Path, stage: str) -> dict[str, bool]:
    """The `decisions` in a stage's <stage>.json, by name; empty if it has none."""
    found = read_json(folder / f"{stage}.json").get("decisions")
    return {name: on for name, on in found.items() if isinstance(on, bool)} if isinstance(found, dict) else {}


def write_json(path: Path, value: Any) -> None:
    """Replace a small JSON file in one step, and flush it to the disk."""
    replace(path, json.dumps(value, indent=1), flush=True)
