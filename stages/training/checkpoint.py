"""A training cut short: everything that the rest of it depends on, in one file that is whole or not there.

Same state, same threads: the same rest, bit for bit on a CPU.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from stages.training.optimizers import optimizers
from stages.training.schedule import Phase

if TYPE_CHECKING:
    from stages.training.fit import Fit

BROKEN = (OSError, RuntimeError, LookupError, ValueError, TypeError, EOFError, AttributeError, pickle.UnpicklingError)
"""What torch raises on a checkpoint that is damaged, of another model, or asks for code."""


def snapshot(fit: Fit) -> dict[str, Any]:
    """Everything that the rest of the run depends on, in part by reference."""
    leaves = {} if fit.leaves is None else fit.leaves._asdict()
    return {
        "models": {n: m.state_dict() for n, m in fit.modules().items()},
        "adam": {n: a.state_dict() for n, a in fit.adam.items()},
        "growth": {n: g.state() for n, g in fit.growth.items()},
        "guard": fit.guard.state(),
        "generator": fit.generator.get_state(),
        "order": fit.order.clone(),
        "reference": [fit.reference.clone(), fit.reference_at.clone()],
        "taught": fit.taught.clone(),
        "behind": None if fit.behind is None else fit.behind.clone(),
        "leaves": {n: leaf.grad.clone() for n, leaf in leaves.items() if leaf.grad is not None},
        "numbers": [fit.step, fit.undrawn],
        "phases": [tuple(phase) for phase in fit.phases],
    }


def restore(fit: Fit, state: dict[str, Any]) -> None:
    """Continue from a `snapshot`; raises RuntimeError, naming tensor and shapes, when it belongs to another model."""
    for name, module in fit.modules().items():
        saved = state["models"][name]
        owned = [(module, row) for row in getattr(module, "ROWS", ())] + (module.rows() if name == "human" else [])
        for owner, row in owned:
            old, like = getattr(owner, row), torch.empty_like(saved[row if owner is module else f"residuals.{row}"])
            setattr(owner, row, torch.nn.Parameter(like) if isinstance(old, torch.nn.Parameter) else like)
        module.load_state_dict(saved)
    fit.adam = optimizers(fit.frames, fit.human, fit.scene, fit.options.extent, fit.effects)
    for name, optimizer in fit.adam.items():
        optimizer.load_state_dict(state["adam"][name])
    for name, growth in fit.growth.items():
        growth.load(state["growth"][name])
    fit.guard.load(state["guard"])
    fit.generator.set_state(state["generator"].cpu())  # both live on the CPU, wherever the rest was loaded
    fit.order = state["order"].cpu().clone()
    fit.reference, fit.reference_at = (t.clone() for t in state["reference"])
    fit.taught = state["taught"].clone()
    fit.behind = None if state["behind"] is None else state["behind"].clone()
    fit.step, fit.undrawn = state["numbers"]
    fit.phases = tuple(Phase(*phase) for phase in state["phases"])
    fit.leaves = fit.near = None
    for name, grad in state["leaves"].items():
        getattr(fit.resting(), name).grad = grad.clone()


def save(path: Path, fit: Fit, more: dict[str, Any]) -> None:
    """Write a checkpoint under another name, to the disk, and only then give it its name; `more` is plain values."""
    partial = path.with_suffix(".part")
    with partial.open("wb") as file:
        torch.save({"fit": snapshot(fit), "threads": torch.get_num_threads()} | more, file)
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
        restore(fit, state)
    except BROKEN as error:
        raise ValueError(_said(path, error)) from error


def _said(path: Path, error: Exception) -> str:
    return f"{path}: {str(error).strip().partition(chr(10))[0] or type(error).__name__}"
