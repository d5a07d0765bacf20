"""A command line, and the processes that it starts for stages and jobs, forked from one process whose libraries are loaded.

Loading them takes most of the time of a short command, and of a stage that does next to nothing. What a machine does instead
is started by `Flow.start`, and by the flows of whole clips.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from types import SimpleNamespace
from typing import IO, Any

from hugs_cli import app, main  # noqa: F401 - `app` is what `main` loads
from hugs_cli.cache import child, launcher
from hugs_cli.fleet import job, runner


class Forked:
    """A process that does `work`, with as much of `subprocess.Popen` as those use who start stages and jobs."""

    def __init__(self, work: Callable[[], int], stdin: int, stdout: int | IO[bytes], handles: Sequence[int] = ()):
        there, here = os.pipe()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # else the fork says it again
        self.pid, self.returncode = os.fork(), None
        if self.pid == 0:
            nothing = os.open(os.devnull, os.O_RDWR)
            output = stdout.fileno() if hasattr(stdout, "fileno") else nothing if stdout == DEVNULL else stdout
            for number, file in enumerate([there if stdin == PIPE else nothing, output, output]):
                os.dup2(file, number)
            os._exit(alone(work, handles))
        os.close(there)
        self.stdin = os.fdopen(here, "wb")

    def poll(self) -> int | None:
        """The exit code of a process that has ended."""
        pid, status = os.waitpid(self.pid, os.WNOHANG) if self.returncode is None else (0, 0)
        self.returncode = os.waitstatus_to_exitcode(status) if pid else self.returncode
        return self.returncode

    def wait(self) -> None:
        """Wait until it has ended."""
        os.waitpid(self.pid, 0)

    def kill(self) -> None:
        """End it."""
        os.kill(self.pid, signal.SIGKILL)


def start(
    command: list[str], *, stdin: int, stdout: int | IO[bytes], pass_fds: Sequence[int] = (), **more: Any
) -> Forked | Popen[bytes]:
    """As `subprocess.Popen` does; a stage or a job of a fleet is forked."""
    if child.__file__ in command:
        return Forked(lambda: stage(command), stdin, stdout, pass_fds)
    if job.__name__ in command:
        folder, *words = command[command.index(job.__name__) + 1 :]
        return Forked(lambda: job.main(Path(folder), *words), stdin, stdout)
    return Popen(command, stdin=stdin, stdout=stdout, pass_fds=pass_fds, **more)


def stage(command: list[str]) -> int:
    """The process of a stage."""
    sys.argv = command[command.index(child.__file__) :]
    return child.main()


def alone(work: Callable[[], int], handles: Sequence[int]) -> int:
    """Do it as a new process would: with no other handles, streams, signals or modules of stages; its exit code."""
    os.setsid()
    sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__  # a job has a stderr of its own
    for handle in map(int, os.listdir("/proc/self/fd")):
        if handle > 2 and handle not in handles:
            with suppress(OSError):  # that of the listing is closed
                os.close(handle)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    for name in [name for name in sys.modules if name.partition(".")[0] == "flow"]:
        del sys.modules[name]
    try:
        return work()
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def ended() -> int:
    """The exit code of the command line, which has said all that it says."""
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else bool(end.code)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def serve() -> None:
    """Run a command line for each line of stdin, and write its exit code."""
    launcher.subprocess = runner.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": start})
    gc.freeze()
    for line in sys.stdin:
        folder, environment, path, arguments, *outputs = json.loads(line)
        if (pid := os.fork()) == 0:
            os.chdir(folder)
            os.environ.clear()
            os.environ.update(environment)
            sys.path[1:1] = path
            sys.argv = ["hugs", *arguments]
            for number, file in enumerate([os.devnull, *outputs]):
                os.dup2(os.open(file, os.O_RDWR), number)
            os._exit(ended())
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
