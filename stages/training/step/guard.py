"""Keeps a bad gradient out of Adam's moments: rows are masked, networks clipped, and each is counted (H01, H02).

Adam never forgets a gradient that is not finite, and one of 1e12 times the usual size takes 47,000 steps to forget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

ABSURD = 300.0  # times the usual largest entry; trainings of good clips stay under 30 times
QUIET = 0.01  # a tensor counts as this share of its owner's loudest at least: one that begins at 0 may wake
YOUNG = 20  # first comparisons, in which an owner's rows are also compared with each other, for want of a past
SPIKE = 10.0  # gradients of shared networks are clipped to this many times their usual norm
MANY = 0.01  # of the rows: then the whole step counts as bad
BAD_STEPS = 20  # in a row, after which training stops
LARGEST = torch.finfo(torch.float32).max


class Guard:
    """Checks all gradients of a training.

    `usual` are running means by name; `compared` comparisons and `streaks` bad steps in a row, both by owner.
    """

    def __init__(self) -> None:
        self.usual: dict[str, float] = {}
        self.compared: dict[str, int] = {}
        self.streaks: dict[str, int] = {}
        self.left_out = self.clipped = 0

    @property
    def alarmed(self) -> bool:
        """True when one more bad step would stop training."""
        return max(self.streaks.values(), default=0) >= BAD_STEPS - 1

    def contain(self, owner: str, grads: Mapping[str, Tensor]) -> None:
        """Zero, in place, each row of `grads` (name -> [N,...]) that is not finite or absurdly large in any of them.

        Absurd is an entry over the limit of its tensor, see `_limits`. FloatingPointError when more than MANY of the
        rows went, BAD_STEPS times in a row.
        """
        grads = {f"{owner}.{name}": grad for name, grad in grads.items() if grad.numel()}
        if not grads:
            return
        limits, largest, left_out, why = self._limits(owner, grads), _largest(grads), 0, ""
        if not all(entry <= limit for entry, limit in zip(largest, limits, strict=True)):
            each = [~(_sizes(grad) <= limit) for grad, limit in zip(grads.values(), limits, strict=True)]
            bad = torch.stack(each).any(0)
            for grad in grads.values():
                grad[bad] = 0
            left_out, largest = int(bad.sum()), _largest(grads)
            name, rows = next((name, rows) for name, rows in zip(grads, each, strict=True) if rows.any())
            why = f"{left_out} of {len(bad)} gradients left out, the first in {name} row {int(rows.nonzero()[0])}"
        for name, entry in zip(grads, largest, strict=True):
            self._learn(name, entry)
        self.compared[owner] = self.compared.get(owner, 0) + any(largest)
        self.left_out += left_out
        self.count(owner, left_out > MANY * len(next(iter(grads.values()))), why)

    def _limits(self, owner: str, grads: Mapping[str, Tensor]) -> list[float]:
        """The largest entry that is let through, of each tensor: ABSURD times what its largest used to be.

        A tensor that was 0 so far (the turns of Gaussians that begin as spheres) counts as QUIET times the loudest of its
        owner. While the owner is young, up to ABSURD^2 times the common entry of this step passes, too: real clips have
        120 times, and the first frame may be a faint one.
        """
        known = [usual for name, usual in self.usual.items() if name.startswith(f"{owner}.")]
        floor = QUIET * max(known, default=0.0)
        least = ABSURD**2 * _common(grads) if self.compared.get(owner, 0) < YOUNG else 0.0
        return [min(max(ABSURD * max(self.usual.get(name, 0.0), floor), least), LARGEST) for name in grads]

    def clip(self, owner: str, grads: list[Tensor]) -> bool:
        """Scale the gradients of shared networks, in place, to SPIKE times their usual norm at most.

        False when they are not finite and the step must be left out.
        """
        norm, usual = torch.nn.utils.get_total_norm(grads).item(), self.usual.get(owner, 0.0)
        finite = math.isfinite(norm)
        if usual and finite and norm > SPIKE * usual:
            torch._foreach_mul_(grads, SPIKE * usual / norm)
            norm = SPIKE * usual
            self.clipped += 1
        self._learn(owner, norm if finite else 0.0)
        self.left_out += not finite
        self.count(owner, not finite, f"a norm of {norm}")
        return finite

    def count(self, owner: str, bad: bool, why: str) -> None:
        """Count bad steps of `owner` in a row; FloatingPointError, with the last reason, when there are BAD_STEPS."""
        self.streaks[owner] = self.streaks.get(owner, 0) + 1 if bad else 0
        if self.streaks[owner] >= BAD_STEPS:
            raise FloatingPointError(f"{BAD_STEPS} bad steps in a row, {owner}: {why}")

    def _learn(self, name: str, entry: float) -> None:
        if entry:
            self.usual[name] = 0.99 * self.usual[name] + 0.01 * entry if name in self.usual else entry

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        counts = {"left_out": self.left_out, "clipped": self.clipped}
        return {"usual": dict(self.usual), "compared": dict(self.compared), "streaks": dict(self.streaks)} | counts

    def load(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.usual, self.compared, self.streaks = (dict(state[name]) for name in ("usual", "compared", "streaks"))
        self.left_out, self.clipped = state["left_out"], state["clipped"]


def _sizes(grad: Tensor) -> Tensor:
    """The largest entry of each row."""
    return grad.abs().reshape(len(grad), -1).amax(1)


def _common(grads: Mapping[str, Tensor]) -> float:
    """What the rows with a gradient stay under, but for a share MANY, at least one; infinite for a single row."""
    rows = torch.cat([_sizes(grad) for grad in grads.values()])
    rows = rows[rows.isfinite() & (rows > 0)]
    rank = len(rows) - max(1, int(MANY * len(rows)))
    return rows.kthvalue(rank).values.item() if rank > 0 else math.inf


def _largest(grads: Mapping[str, Tensor]) -> list[float]:
    return torch.stack([grad.abs().amax() for grad in grads.values()]).tolist()
