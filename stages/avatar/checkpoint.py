"""A training cut short: everything that the rest of it depends on, in one file that is whole or not there."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from stages.avatar.fit import Fit

BROKEN = (OSError, RuntimeError, LookupError, ValueError, TypeError, EOFError, AttributeError, pickle.UnpicklingError)
"""What torch raises on a checkpoint that is damaged, of another model, or asks for code."""


def save(path: Path, fit: Fit, more: dict[str, Any]) -> None:
    """Write a checkpoint under another name, to the disk, and only then give it its name; `more` is plain values."""
    partial = path.with_suffix(".part")
    with partial.open("wb") as file:
        torch.save({"fit": fit.state(), "threads": torch.get_num_threads()} | more, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def load(path: Path, device: str, more: tuple[str, ...]) -> dict[str, Any] | None:
    """What `save` wrote, with the names in `more`; None if nothing was, ValueError where it cannot be read."""
    path.with_suffix(".part").unlink(missing_ok=True)
    if not path.exists():
        return None
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
        return {name: saved[name] for name in ("fit", "threads", *more)}
    except BROKEN as error:
        raise ValueError(_said(path, error)) from error


def resume(fit: Fit, state: dict[str, Any], path: Path) -> None:
    """Put a training where it was; ValueError where its `state`, read from `path`, is of another model."""
    try:
        fit.load(state)
    except BROKEN as error:
        raise ValueError(_said(path, error)) from error


def _said(path: Path, error: Exception) -> str:
    return f"{path}: {str(error).strip().partition(chr(10))[0] or type(error).__name__}"
