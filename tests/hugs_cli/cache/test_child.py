"""The stage's process: what it tells of what went wrong, and what it is given to compute with."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import pytest

from hugs_cli.cache.child import count_compiling, error_event, processors
from stages.contract import StageError
from tests.made.said import holds


class OutOfMemoryError(RuntimeError):
    """As torch.cuda's."""


def raised(error: Exception) -> dict:
    try:
        raise error
    except Exception as caught:
        return error_event(caught, "store/train.part")


@pytest.mark.parametrize(
    ("error", "facts"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), ("disk", "full", "store/train.part")),
        (MemoryError(), ("memory", "stage")),
        (OutOfMemoryError("CUDA out of memory. Tried"), ("memory", "stage")),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), ("memory", "stage")),
    ],
)
def test_what_the_machine_lacks_is_an_error_with_a_hint(error, facts):
    event = raised(error)
    assert event["event"] == "error" and holds(event["problem"], *facts) and event["hint"]


def test_a_stage_error_passes_unchanged_and_a_bug_is_one_line_with_its_traceback():
    event = raised(StageError("no person", "look", ["in 3 frames"]))
    assert event == {"event": "error", "problem": "no person", "facts": ("in 3 frames",), "hint": "look"}
    event = raised(OSError(errno.ENOENT, "No such file"))
    assert event["event"] == "crash" and "Traceback" in event["traceback"]
    event = raised(ValueError("first\nsecond"))
    assert event["problem"] == "ValueError: first" and "second" in event["traceback"]


def test_processors_are_those_of_this_process():
    assert 1 <= processors() <= len(os.sched_getaffinity(0))


def test_the_seconds_of_compiling_are_counted_once_for_kernels_that_call_each_other():
    import time

    import numba

    seconds = count_compiling()
    assert seconds() == 0

    @numba.njit
    def inner(n):
        return n * n + 1

    @numba.njit
    def outer(n):
        return inner(n) + inner(2 * n)

    began = time.monotonic()
    outer(3)
    took, counted = time.monotonic() - began, seconds()
    assert 0 < counted <= took + 1e-3, "counted in milliseconds"
    outer(4)
    assert seconds() == counted, "compiled before"


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "4"}, "4")])
def test_openblas_which_waits_by_spinning_has_one_thread_unless_the_user_gives_it_more(given, used):
    command = (
        "from hugs_cli.cache.child import prepare; prepare(); import os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", command], env=kept | given, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == used
