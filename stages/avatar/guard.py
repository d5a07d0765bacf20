"""What keeps one bad gradient from all that remembers: rows are masked, networks clipped, both counted (H01, H02).

Adam never forgets a gradient that is not finite, and one of 1e12 times the usual size takes 47,000 steps to forget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

ABSURD = 300.0  # times the usual largest entry; trainings of good clips stay under 30 times
SPIKE = 10.0  # gradients of shared networks are clipped to this many times their usual norm
MANY = 0.01  # of the rows: then the whole step counts as bad
BAD_STEPS = 20  # in a row, after which training stops
LARGEST = torch.finfo(torch.float32).max


class Guard:
    """Judges all gradients of a training. `usual` are running means by name, `streaks` bad steps in a row by owner."""

    def __init__(self) -> None:
        self.usual: dict[str, float] = {}
        self.streaks: dict[str, int] = {}
        self.left_out = 0

    @property
    def alarmed(self) -> bool:
        """True when one more bad step would stop training."""
        return max(self.streaks.values(), default=0) >= BAD_STEPS - 1

    def contain(self, owner: str, grads: Mapping[str, Tensor]) -> None:
        """Zero, in place, each row of `grads` (name -> [N,...]) that is not finite or absurdly large in any of them.

        Absurd is an entry of more than ABSURD times what the tensor's largest used to be. FloatingPointError when more
        than MANY of the rows went, BAD_STEPS times in a row.
        """
        grads = {f"{owner}.{name}": grad for name, grad in grads.items() if grad.numel()}
        if not grads:
            return
        limits = [min(ABSURD * self.usual.get(name, math.inf), LARGEST) for name in grads]
        largest, left_out, why = _largest(grads), 0, ""
        if not all(entry <= limit for entry, limit in zip(largest, limits, strict=True)):
            each = [
                ~(g.abs().reshape(len(g), -1).amax(1) <= limit) for g, limit in zip(grads.values(), limits, strict=True)
            ]
            bad = torch.stack(each).any(0)
            for grad in grads.values():
                grad[bad] = 0
            left_out, largest = int(bad.sum()), _largest(grads)
            name, rows = next((name, rows) for name, rows in zip(grads, each, strict=True) if rows.any())
            why = f"{left_out} of {len(bad)} gradients left out, the first in {name} row {int(rows.nonzero()[0])}"
        for name, entry in zip(grads, largest, strict=True):
            self._learn(name, entry)
        self.left_out += left_out
        self.judge(owner, left_out > MANY * len(next(iter(grads.values()))), why)

    def clip(self, owner: str, grads: list[Tensor]) -> bool:
        """Scale the gradients of shared networks, in place, to SPIKE times their usual norm at most.

        False when they are not finite and the step must be left out.
        """
        norm, usual = torch.nn.utils.get_total_norm(grads).item(), self.usual.get(owner, 0.0)
        finite = math.isfinite(norm)
        if usual and finite and norm > SPIKE * usual:
            torch._foreach_mul_(grads, SPIKE * usual / norm)
            norm = SPIKE * usual
        self._learn(owner, norm if finite else 0.0)
        self.left_out += not finite
        self.judge(owner, not finite, f"a norm of {norm}")
        return finite

    def judge(self, owner: str, bad: bool, why: str) -> None:
        """Count bad steps of `owner` in a row; FloatingPointError, with the last reason, when there are BAD_STEPS."""
        self.streaks[owner] = self.streaks.get(owner, 0) + 1 if bad else 0
        if self.streaks[owner] >= BAD_STEPS:
            raise FloatingPointError(f"{BAD_STEPS} bad steps in a row for the {owner}: {why}")

    def _learn(self, name: str, entry: float) -> None:
        if entry:
            self.usual[name] = 0.99 * self.usual[name] + 0.01 * entry if name in self.usual else entry

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"usual": dict(self.usual), "streaks": dict(self.streaks), "left_out": self.left_out}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.usual, self.streaks = dict(state["usual"]), dict(state["streaks"])
        self.left_out = state["left_out"]


def _largest(grads: Mapping[str, Tensor]) -> list[float]:
    return torch.stack([grad.abs().amax() for grad in grads.values()]).tolist()
