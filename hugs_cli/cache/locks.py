"""Locks of folders: whoever comes second waits."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hugs_cli.pipelines import UsageError

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)  # NFS and Lustre, as some are set up


@contextmanager
def locked(file: Path, waiting: Callable[[str], None], without: bool = False) -> Iterator[int]:
    """Lock a file, which is made; never one that a link leads to. If another process holds it, calls `waiting` with its name
    and waits. Yields the open handle, for a child. UsageError on a file system without locks, unless it goes `without`.
    """
    handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waiting(os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process")
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            if not without:
                hint = "choose one on another disk with `--work`, or use `hugs fleet`, which needs no locks"
                raise UsageError(f"no file can be locked in {file.parent}", hint, [str(error.strerror)]) from error
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()}".encode(), 0)
        yield handle
    finally:
        os.close(handle)
