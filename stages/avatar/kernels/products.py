"""Products of many matrices of 3x3, which torch's batched product takes 80 ns each for, and of their vectors (13 ns)."""

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


@njit(cache=True, parallel=True)
def _turn(a: np.ndarray, points: np.ndarray, a_steps: tuple[int, int], out: np.ndarray) -> None:
    """Fill out [3N] with the products of the matrices in a [9N] and the vectors in points [3N]."""
    n = len(out) // 3
    for chunk in prange(CHUNKS):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            x, y, z = points[3 * i], points[3 * i + 1], points[3 * i + 2]
            for row in range(3):
                left = 9 * i + row * a_steps[0]
                total = a[left] * x
                total += a[left + a_steps[1]] * y
                total += a[left + 2 * a_steps[1]] * z
                out[3 * i + row] = total


def _product(
    a: np.ndarray, b: np.ndarray, a_steps: tuple[int, int] = AS_IS, b_steps: tuple[int, int] = AS_IS
) -> Tensor:
    out = np.empty_like(a)
    _multiply(a.reshape(-1), b.reshape(-1), a_steps, b_steps, out.reshape(-1))
    return torch.from_numpy(out)


def _turned(a: np.ndarray, points: np.ndarray, a_steps: tuple[int, int] = AS_IS) -> Tensor:
    out = np.empty_like(points)
    _turn(a.reshape(-1), points.reshape(-1), a_steps, out.reshape(-1))
    return torch.from_numpy(out)


def _array(part: Tensor) -> np.ndarray:
    return part.detach().contiguous().numpy()


class _Products(torch.autograd.Function):
    """`a @ b`, to the bit, of float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.kept = _array(a), _array(b)
        return _product(*ctx.kept)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (a, b), arrived = ctx.kept, _array(upstream)
        d_a = _product(arrived, b, AS_IS, TURNED) if ctx.needs_input_grad[0] else None
        return d_a, _product(a, arrived, TURNED, AS_IS) if ctx.needs_input_grad[1] else None


class _Turned(torch.autograd.Function):
    """`(a @ points[..., None])[..., 0]`, to the bit, of float32 on a CPU."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, points: Tensor) -> Tensor:
        ctx.kept = _array(a), _array(points)
        return _turned(*ctx.kept)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (a, points), arrived = ctx.kept, _array(upstream)
        d_a = torch.from_numpy(arrived[:, :, None] * points[:, None]) if ctx.needs_input_grad[0] else None
        return d_a, _turned(a, arrived, TURNED) if ctx.needs_input_grad[1] else None


def _fast(*parts: Tensor) -> bool:
    return all(part.dtype == torch.float32 and part.device.type == "cpu" for part in parts)


def products(a: Tensor, b: Tensor) -> Tensor:
    """The products [N,3,3] of a[N,3,3] and b[N,3,3], row by row, with one gradient to each; as fast as memory on a CPU."""
    return _Products.apply(a, b) if _fast(a, b) and a.shape == b.shape else a @ b


def turned(a: Tensor, points: Tensor) -> Tensor:
    """The products [N,3] of a[N,3,3] and points[N,3], row by row, with one gradient to each."""
    return _Turned.apply(a, points) if _fast(a, points) else (a @ points[..., None])[..., 0]
