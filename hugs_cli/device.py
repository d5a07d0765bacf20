"""Where the heavy stages compute: on the GPU, or on the processor; and why."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from hugs_cli.pipelines import UsageError

NAMES = ("auto", "cpu", "cuda")


def find_device() -> str:
    """'cuda' if the driver shows a GPU and torch was built for it, else 'cpu'; without importing torch."""
    import ctypes

    torch = importlib.util.find_spec("torch")
    if torch is None or not torch.origin or not list((Path(torch.origin).parent / "lib").glob("*torch_cuda.*")):
        return "cpu"
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "cpu"
    count = ctypes.c_int(0)
    found = cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0
    return "cuda" if found and count.value else "cpu"


def device_of(name: str) -> tuple[str, str]:
    """'cpu' or 'cuda' for a name that may be 'auto', and why; UsageError where the GPU, or gsplat, is missing."""
    if name not in NAMES:
        raise UsageError(f"no device {name!r}", f"one of: {', '.join(NAMES)}")
    if name == "cpu":
        return "cpu", "as asked"
    gpu, why = find_device() == "cuda", "no GPU that torch can use"
    if gpu and importlib.util.find_spec("gsplat"):
        return "cuda", "a GPU that torch can use, and gsplat"
    if name == "cuda" and not gpu:
        raise UsageError(why, "leave out `--device cuda`; `hugs doctor` shows what is here")
    if name == "cuda":
        raise UsageError("a GPU is here, but gsplat, which draws on it, is missing", "pip install 'hugs-avatar[gpu]'")
    return "cpu", "a GPU is here, but gsplat is missing: pip install 'hugs-avatar[gpu]'" if gpu else why
