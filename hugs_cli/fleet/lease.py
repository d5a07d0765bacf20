"""Who works on a clip, or leads a fleet: a file that its holder touches every few seconds.

The lock of a clip's folder (Workspace.lock) is exact on one machine. On a file system shared by many, such as NFS, it
may hold nobody back. So a fleet's job takes a lease as well: a file made with O_EXCL, which such systems do honour.
A lease that nobody touches any more is taken over; no clock of another machine is trusted.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

NAME = ".lease"
TOUCH_EVERY = 5.0  # s
DEAD_AFTER = 120.0  # s without a touch, of a holder on another machine; NFS may show old times for a minute
LOOK_EVERY = 1.0  # s
NO_LINKS = (errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)  # says a file system that has none


class Lease:
    """One held lease."""

    def __init__(self, path: Path, me: dict[str, Any]):
        self.path, self.me = path, me

    def touch(self) -> bool:
        """Say that its holder is alive; False if somebody else has it now. A file system that does not answer costs
        nothing: others wait DEAD_AFTER."""
        try:
            if holder(self.path) != self.me:
                return False
            os.utime(self.path)
        except FileNotFoundError:  # taken away between the two lines
            return False
        except OSError:
            pass
        return True

    def give_back(self) -> None:
        """Remove it, if it is still ours."""
        if holds(self.path, self.me):
            remove(self.path, self.me)


@contextmanager
def lease(path: Path, waiting: Callable[[str], None], me: dict[str, Any] | None = None) -> Iterator[Lease]:
    """Take a lease, as `me` or with a new identity. If another has it, calls `waiting` with its name, once, and waits
    until it is given back or its holder is gone. The caller touches it every TOUCH_EVERY seconds."""
    me, told, watch = me or identity(), False, Watch(path)
    while not take(path, me):
        if watch.dead():
            remove(path, watch.seen)
            continue
        if not told and watch.seen:  # it may be given back at any moment, and then nobody is named
            told = True
            waiting(name_of(watch.seen))
        time.sleep(LOOK_EVERY)
    held = Lease(path, me)
    try:
        yield held
    finally:
        held.give_back()


class Watch:
    """Looks at a lease again and again, to see whether its holder still touches it."""

    def __init__(self, path: Path):
        self.path = path
        self.seen: dict[str, Any] = {}
        self.state: tuple[Any, ...] = ()
        self.since = time.monotonic()
        self.touched = False
        """Whether its holder touched it while we looked."""

    def dead(self) -> bool:
        """Whether the lease is there and its holder is gone: on this machine at once, on others after DEAD_AFTER."""
        try:
            self.seen = holder(self.path)
            state = (self.seen, os.stat(self.path).st_mtime_ns)
        except OSError:
            self.seen = {}
            return False
        if state != self.state:
            self.touched = bool(self.state)
            self.state, self.since = state, time.monotonic()
        alive = is_alive(self.seen)
        return not alive if alive is not None else time.monotonic() - self.since > DEAD_AFTER


def lives(path: Path) -> bool:
    """Whether a lease has a holder that lives. For one on another machine it looks on until that is sure, up to
    DEAD_AFTER."""
    watch = Watch(path)
    while os.path.lexists(path) and not watch.dead():
        if is_alive(watch.seen) or watch.touched:
            return True
        time.sleep(LOOK_EVERY)
    return False


def take(path: Path, me: dict[str, Any]) -> bool:
    """Make the file, whole from the start; False if another has it. A link is made or not, on NFS too."""
    own = path.with_name(f"{path.name}.{me['token']}")
    try:
        own.write_text(json.dumps(me))
        os.link(own, path)
    except FileExistsError:  # NFS may say so of a link that it made, when its first answer was lost
        return holds(path, me)
    except OSError as error:
        if error.errno not in NO_LINKS:
            raise
        return write_new(path, me)
    finally:
        with suppress(OSError):
            own.unlink()
    return True


def write_new(path: Path, me: dict[str, Any]) -> bool:
    """`take` where there are no links. A lease that was not written whole is taken away again."""
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        return False
    try:
        with open(handle, "w") as file:
            json.dump(me, file)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    return True


def remove(path: Path, seen: dict[str, Any]) -> None:
    """Remove the lease that was `seen` dead. If it was taken anew meanwhile, it is put back: one wins, and the other's
    `touch` says so."""
    aside = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    with suppress(OSError):
        os.rename(path, aside)
        if holder(aside) != seen:
            os.link(aside, path)
    with suppress(OSError):
        aside.unlink()


def holds(path: Path, me: dict[str, Any]) -> bool:
    """Whether a lease is `me`'s; False if it cannot be read."""
    try:
        return holder(path) == me
    except OSError:
        return False


def holder(path: Path) -> dict[str, Any]:
    """Who holds a lease; empty where there is none (it may be given back at any moment), or if it cannot be read."""
    try:
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def identity() -> dict[str, Any]:
    """This process, told from all others on all machines."""
    pid = os.getpid()
    return {"host": platform.node(), "kernel": kernel(), "pid": pid, "began": began(pid), "token": uuid.uuid4().hex}


def is_alive(one: dict[str, Any]) -> bool | None:
    """Whether a process still runs; None for one that cannot be seen from here: of another machine or container, of this
    machine before it was started again (another may have its name), or where the system does not tell."""
    if not kernel() or (one.get("host"), one.get("kernel")) != (platform.node(), kernel()):
        return None
    return one.get("began") == began(one.get("pid", 0)) != ""


def kernel() -> str:
    """What tells the processes that can be seen from here: this start of the machine, and the container; '' where the
    system does not say."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def began(pid: int) -> str:
    """When a process of this machine began, in ticks; '' if there is none, or only its exit code is left."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] in "ZX" else fields[19]


def name_of(one: dict[str, Any]) -> str:
    """A holder in words."""
    return f"process {one.get('pid', '?')} on {one.get('host', '?')}"
