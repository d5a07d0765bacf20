"""A training cut short: everything that the rest of it depends on, in one file that is whole or not there.

On a CPU with as many threads the rest is the same to the bit.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

from stages.contract import StageError
from stages.training.step.fit import Fit

BROKEN = (OSError, RuntimeError, LookupError, ValueError, TypeError, EOFError, AttributeError, pickle.UnpicklingError)
"""What torch raises on a checkpoint that is damaged, of another model, or asks for code."""


class Checkpoint:
    """The file of one training, read onto `device`."""

    def __init__(self, path: Path, device: str = "cpu"):
        self.path, self.device = path, device

    def save(self, fit: Fit, more: dict[str, Any]) -> None:
        """Write it under another name, to the disk, and only then give it its name; `more` is plain values."""
        partial = self.path.with_suffix(".part")
        with partial.open("wb") as file:
            torch.save({"fit": fit.state(), "threads": torch.get_num_threads()} | more, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, self.path)

    def load(self, more: tuple[str, ...]) -> dict[str, Any] | None:
        """What `save` wrote, with the names in `more`; None without a file, StageError where it cannot be read."""
        self.path.with_suffix(".part").unlink(missing_ok=True)
        if not self.path.exists():
            return None
        try:
            saved = torch.load(self.path, map_location=self.device, weights_only=True)
            return {name: saved[name] for name in ("fit", "threads", *more)}
        except BROKEN as error:
            raise self._unusable(error) from error

    def resume(self, fit: Fit, state: dict[str, Any]) -> None:
        """Put a training where it was; StageError where its loaded `state` is of another model."""
        try:
            fit.load(state)
        except BROKEN as error:
            raise self._unusable(error) from error

    def _unusable(self, error: Exception) -> StageError:
        why = str(error).strip().partition(chr(10))[0] or type(error).__name__
        hint = "begin again: `hugs run VIDEO train --force`"
        return StageError("the checkpoint of the stopped training cannot be used", hint, [f"{self.path}: {why}"])
