"""Products of many matrices of 3x3, which torch's batched product takes 80 ns each for."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.kernels import njit, prange

CHUNKS = 16  # ranges of matrices
AS_IS, TURNED = (3, 1), (1, 3)  # steps from row to row and from column to column of a matrix, and of its transpose


@njit(cache=True, parallel=True)
def _multiply(
    a: np.ndarray, b: np.ndarray, a_steps: tuple[int, int], b_steps: tuple[int, int], out: np.ndarray
) -> None:
    """Fill out [9N] with the products of the matrices in a and b [9N]."""
    n = len(out) // 9
    for chunk in prange(CHUNKS):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            for row in range(3):
                for column in range(3):
                    left, right = 9 * i + row * a_steps[0], 9 * i + column * b_steps[1]
                    total = a[left] * b[right]
                    total += a[left + a_steps[1]] * b[right + b_steps[0]]
                    total += a[left + 2 * a_steps[1]] * b[right + 2 * b_steps[0]]
                    out[9 * i + 3 * row + column] = total


def _product(
    a: np.ndarray, b: np.ndarray, a_steps: tuple[int, int] = AS_IS, b_steps: tuple[int, int] = AS_IS
) -> Tensor:
    out = np.empty_like(a)
    _multiply(a.reshape(-1), b.reshape(-1), a_steps, b_steps, out.reshape(-1))
    return torch.from_numpy(out)


class _Products(torch.autograd.Function):
    """`a @ b`, to the bit, of float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.kept = tuple(np.ascontiguousarray(part.detach().numpy()) for part in (a, b))
        return _product(*ctx.kept)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (a, b), arrived = ctx.kept, np.ascontiguousarray(upstream.numpy())
        d_a = _product(arrived, b, AS_IS, TURNED) if ctx.needs_input_grad[0] else None
        return d_a, _product(a, arrived, TURNED, AS_IS) if ctx.needs_input_grad[1] else None


def products(a: Tensor, b: Tensor) -> Tensor:
    """The products [N,3,3] of a[N,3,3] and b[N,3,3], row by row, with one gradient to each; as fast as memory on a CPU."""
    fast = all(part.dtype == torch.float32 and part.device.type == "cpu" for part in (a, b)) and a.shape == b.shape
    return _Products.apply(a, b) if fast else a @ b
