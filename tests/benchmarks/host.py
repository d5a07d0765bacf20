"""What the benchmarks share: the clock, summaries of repeated times, thread counts, and the machine they belong to."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numba
import numpy as np
import torch
from numba import njit, prange

from stages.avatar import rasterize  # noqa: F401  (first: it names the folder of the compiled kernels)

CHAIN, WIDTH, ROUNDS = 4, 512, 500_000  # multiply-adds at a time, numbers a thread (2 KiB, they stay in L1), passes
SCALE, SHIFT = np.float32(0.5), np.float32(0.25)


def clock(work: Callable[[], object]) -> float:
    """Wall-clock milliseconds of one call."""
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def summary(times: list[float]) -> dict[str, float]:
    """Least, quartiles and number of repeated times."""
    low, middle, high = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else 3 * times
    return {"min": min(times), "q1": low, "median": middle, "q3": high, "repeats": len(times)}


def all_threads() -> int:
    """The most threads that both torch and numba may use here."""
    return min(len(os.sched_getaffinity(0)), numba.config.NUMBA_NUM_THREADS)


def use_threads(count: int) -> None:
    """Let torch and numba use `count` threads from now on."""
    torch.set_num_threads(count)
    numba.set_num_threads(count)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _multiply_add(threads, rounds, out):
    for thread in prange(threads):
        values = np.ones(WIDTH, np.float32)
        for _ in range(rounds):
            for i in range(WIDTH):
                value = values[i]
                for _ in range(CHAIN):
                    value = value * SCALE + SHIFT
                values[i] = value
        out[thread] = values.sum()


def fma_peak(threads: int) -> float:
    """Most floating-point operations a second that a loop of multiply-adds in registers reaches on `threads` threads."""
    use_threads(threads)
    out = np.empty(threads, np.float32)
    _multiply_add(threads, 1, out)
    best = min(clock(lambda: _multiply_add(threads, ROUNDS, out)) for _ in range(7))
    return 2 * CHAIN * WIDTH * ROUNDS * threads / best * 1e3


def machine() -> dict[str, object]:
    """What the milliseconds belong to."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "threads": all_threads(),
        "load": os.getloadavg(),
        "python": platform.python_version(),
    } | {name: version(name) for name in ("torch", "numba", "llvmlite", "numpy", "warp-lang")}


def version(package: str) -> str | None:
    """Of an installed package, else None."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def tell(found: dict, file: Path | None) -> None:
    """Print what was found, with the machine it belongs to, and write it to a file too if there is one."""
    text = json.dumps(found | {"machine": machine()}, indent=1, default=float)
    print(text)
    if file:
        file.write_text(text + "\n")
