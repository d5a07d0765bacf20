"""A command line, and processes of its stages, that are forked from one process whose libraries are loaded.

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
from contextlib import suppress
from types import SimpleNamespace

from hugs_cli import app, main  # noqa: F401 - `app` is what `main` loads
from hugs_cli.cache import child, launcher


class Forked:
    """What `launcher.Process` starts, with as much of `subprocess.Popen` as it uses."""

    def __init__(self, command: list[str], *, stdout: int, pass_fds: tuple[int, ...], **as_ever: object):
        there, here = os.pipe()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # else the fork says it again
        self.pid, self.returncode = os.fork(), None
        if self.pid == 0:
            output = os.open(os.devnull, os.O_WRONLY) if stdout == subprocess.DEVNULL else stdout
            for number, file in enumerate([there, output, output]):
                os.dup2(file, number)
            os._exit(stage(command[command.index(child.__file__) :], pass_fds))
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


def stage(words: list[str], handles: tuple[int, ...]) -> int:
    """The process of a stage, as a new one would be: no other handles, signals or modules of stages; its exit code."""
    os.setsid()
    for handle in map(int, os.listdir("/proc/self/fd")):
        if handle > 2 and handle not in handles:
            with suppress(OSError):  # that of the listing is closed
                os.close(handle)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    for name in [name for name in sys.modules if name.partition(".")[0] == "flow"]:
        del sys.modules[name]
    sys.argv = words
    try:
        return child.main()
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def serve() -> None:
    """Run a command line for each line of stdin, and write its exit code."""
    launcher.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": Forked})
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
            main()
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
