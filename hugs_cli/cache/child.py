"""The process of a stage; `launcher.py` is on the other side.

It loads the libraries that it is called with, reads its job from stdin and lives as long as that stays open, so it ends with a
run that is killed. It reports events as JSON lines on a pipe; its stdout and stderr go to log.txt.
"""

from __future__ import annotations

import errno
import importlib
import json
import os
import platform
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stages.contract import StageError

LIBRARIES = {
    "torch": "torch",
    "numpy": "numpy",
    "scipy": "scipy",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "cv2": "opencv-contrib-python-headless",
    "OpenImageIO": "OpenImageIO",
    "PIL": "pillow",
    "av": "av",
    "trimesh": "trimesh",
    "skimage": "scikit-image",
    "fast_simplification": "fast-simplification",
    "xatlas": "xatlas",
    "ai_edge_litert": "ai-edge-litert",
}
"""Libraries that compute: module -> name of the package."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
GONE = (errno.ENOENT, errno.EIO, errno.ESTALE, errno.ENOTDIR, errno.EISDIR, errno.ELOOP)
PROGRESS_EVERY = 0.1  # s between progress events of one stage
TORCH_MEMORY = ("OutOfMemoryError", "can't allocate memory")  # how torch says it, on a GPU and without


def prepare() -> None:
    """Set the environment that numerical libraries read when they load.

    Spinning OpenMP threads made a 4.7 ms call take 37 ms on a shared machine, and threads that sleep at once cost a
    training step 7 %: they spin a thousand times, a few microseconds. OpenBLAS, which numpy and scipy use, spins for
    longer: with two threads `survey` took 32 to 200 s beside one busy process in place of 7, and alone no stage is faster.
    Libraries count the machine's processors, not the container's; pycolmap corrupts the heap unless the system's zlib
    was loaded before it.
    """
    import zlib  # noqa: F401

    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, str(processors()))


def processors() -> int:
    """Processors that this process may use: its affinity, and the container's quota where there is one."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
    except (OSError, ValueError):
        return count
    return count if quota == "max" else max(1, min(count, round(int(quota) / int(period))))


def main() -> int:
    """The stage's process."""
    import faulthandler
    import threading

    prepare()
    for library in sys.argv[1:]:
        with suppress(Exception):  # the stage will fail by it, and say so
            importlib.import_module(library)
    compiling = count_compiling()
    job = json.loads(read_line(0))
    sys.path[:] = job["path"]
    os.set_inheritable(job["events"], False)
    pipe = os.fdopen(job["events"], "w", encoding="utf-8", buffering=1)
    if "checks" in job:
        if not check(job["checks"], pipe):
            return 1
        job = json.loads(read_line(0))
    with open(job["log"], "ab") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    faulthandler.enable()
    watch = threading.Thread(target=end_with_parent, daemon=True)
    watch.start()
    from stages.contract import Job, StageError, StageRecord, Stopped, load_stage

    last = 0.0

    def emit(event: dict[str, Any]) -> None:
        nonlocal last
        if event["event"] == "progress" and event["done"] < event["total"]:
            if time.monotonic() - last < PROGRESS_EVERY:
                return
            last = time.monotonic()
        pipe.write(json.dumps(event, default=float) + "\n")

    upstream = {name: StageRecord(**record) for name, record in job["upstream"].items()}
    stage_job = Job(Path(job["out"]), job["device"], job["seed"], emit, upstream)
    if job["resumes"]:
        stage_job.listen_for_stop()
    else:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        module = load_stage(job["module"])
        inputs = {name: Path(path) if path else None for name, path in job["inputs"].items()}
        module.run(stage_job, module.params(**job["params"]), **inputs)
        facts = {"versions": versions(), "peak_memory_bytes": peak_memory(), **gpu_memory()}
        emit({"event": "done", "compiling": compiling(), **facts})
        return 0
    except Stopped:
        emit({"event": "stopped", "compiling": compiling()})
        return 130
    except Exception as error:
        if not isinstance(error, StageError):
            traceback.print_exc()
        emit(error_event(error, job["out"], job["inputs"].values()))
    return 1


def check(jobs: list[dict[str, Any]], pipe: IO[str]) -> bool:
    """Let stages check what they are given, and report it; whether all take it."""
    from stages.contract import load_stage

    for job in jobs:
        pipe.write(json.dumps({"event": "checks", "stage": job["stage"]}) + "\n")
        try:
            stage = load_stage(job["module"])
            assert stage.check, "those without one are not asked"
            inputs = {name: Path(path) if path else None for name, path in job["inputs"].items()}
            stage.check(stage.params(**job["params"]), **inputs)
        except Exception as error:
            pipe.write(json.dumps(error_event(error, "", job["inputs"].values())) + "\n")
            return False
    pipe.write(json.dumps({"event": "checked"}) + "\n")
    return True


def file_error(error: BaseException, out: str = "", inputs: Iterable[str | None] = ()) -> StageError | None:
    """The StageError for a full disk, or a missing or forbidden file; None if a bug is more likely.

    A missing file is a bug of the stage, unless it belongs to the inputs, which were there when the run began.
    """
    from stages.contract import StageError

    cause: BaseException | None = error
    while cause:  # torch turns a full disk into an error of its own
        if isinstance(cause, OSError) and cause.errno in FULL:
            where = f" at {out or cause.filename}" if out or cause.filename else ""
            hint = "free some space; `hugs gc` removes results that nothing uses"
            return StageError(f"the disk is full{where}", hint, [str(cause)])
        cause = cause.__cause__ or cause.__context__
    if not isinstance(error, OSError):
        return None
    name = str(error.filename or "")
    if error.errno in FORBIDDEN:
        hint = "make it readable, and the work folder writable; `--work` chooses another one"
        return StageError(f"cannot read or write {name or 'a file'}: {os.strerror(error.errno).lower()}", hint)
    if error.errno == errno.ENAMETOOLONG:
        return StageError(
            f"a name is too long for this machine: {name[:60]}...", "give it a shorter one", [f"{len(name)} letters"]
        )
    given = [path for path in inputs if path]
    if error.errno in GONE and (not out or any(name == path or name.startswith(f"{path}/") for path in given)):
        return StageError(f"{name} is gone or cannot be read", "put it back, and run again; finished stages are kept")
    return None


def error_event(error: Exception, out: str, inputs: Iterable[str | None] = ()) -> dict[str, Any]:
    """The event for an exception of a stage: 'error' if the user can help, 'crash' for a bug."""
    from stages.contract import StageError

    if said := file_error(error, out, inputs):
        error = said
    elif isinstance(error, MemoryError) or any(words in f"{type(error).__name__} {error}" for words in TORCH_MEMORY):
        hint = "close other programs, or use smaller settings (`--pipeline preview`)"
        error = StageError("the machine has no memory left for this stage", hint, [str(error).partition("\n")[0]])
    if isinstance(error, StageError):
        return {"event": "error", "problem": error.problem, "facts": error.facts, "hint": error.hint}
    problem = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
    return {"event": "crash", "problem": problem, "traceback": "".join(traceback.format_exception(error))}


def read_line(handle: int) -> bytes:
    """The first line of a file handle. Unbuffered: nothing may hold stdin when the interpreter ends."""
    line = b""
    while not line.endswith(b"\n"):
        data = os.read(handle, 65536)
        if not data:
            raise EOFError("the run that started this stage is gone")
        line += data
    return line


def end_with_parent() -> None:
    """Wait until the run that started this process is gone, then stop as on Ctrl-C."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def versions(only: Callable[[str], object] = sys.modules.get) -> dict[str, str]:
    """Versions of hugs, of Python and of the libraries in use, by default those that this process has loaded."""
    from importlib.metadata import PackageNotFoundError, version

    from stages.contract import build

    found = {"hugs": build(), "python": platform.python_version()}
    for module, distribution in LIBRARIES.items():
        with suppress(PackageNotFoundError):  # a build of one's own: unknown
            if only(module):
                found[module] = version(distribution)
    return found


def count_compiling() -> Callable[[], float]:
    """Count from now on the seconds in which Numba compiles, where it is loaded: what is called gives those so far."""
    if "numba" not in sys.modules:
        return lambda: 0.0
    from numba.core import event

    marks = event.RecordingListener()
    event.register("numba:compile", marks)

    def seconds() -> float:
        total, since, depth = 0.0, 0.0, 0
        for when, mark in marks.buffer:  # a kernel that calls another compiles it in between
            if mark.is_start:
                since, depth = (since if depth else when), depth + 1
            else:
                depth -= 1
                total += 0.0 if depth else when - since
        return round(total, 3)

    return seconds


def peak_memory() -> int:
    """The most memory that this process, or one of its own, held at once, in bytes."""
    from stages import contract

    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * contract.MAXRSS
    return max(contract.peak_memory(), children)


def gpu_memory() -> dict[str, int]:
    """The most memory that torch held on the GPU, in bytes; empty if no GPU was used."""
    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available() or not torch.cuda.is_initialized():
        return {}
    return {"peak_gpu_memory_bytes": torch.cuda.max_memory_allocated()}


if __name__ == "__main__":
    sys.exit(main())
