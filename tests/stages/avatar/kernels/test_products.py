"""Products of many matrices, and of matrices and vectors: those of torch to the bit, with their gradients."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from stages.avatar.kernels.products import products, turned

Product = Callable[[Tensor, Tensor], Tensor]


def learned(product: Product, a: Tensor, b: Tensor, upstream: Tensor) -> tuple[Tensor, ...]:
    """The products of the left parts of a[N,3,4] with b, and the gradients of both."""
    a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
    found = product(a[..., :3], b)
    found.backward(upstream)
    return found.detach(), a.grad, b.grad


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("ours", "theirs", "shape"),
    [(products, torch.matmul, (3, 3)), (turned, lambda a, points: (a @ points[..., None])[..., 0], (3,))],
)
def test_products_and_gradients_are_those_of_torch_to_the_bit(
    ours: Product, theirs: Product, shape: tuple[int, ...], count: int, dtype: torch.dtype
) -> None:
    g = torch.Generator().manual_seed(0)
    a, b, upstream = (torch.randn(count, *more, generator=g, dtype=dtype) for more in ((3, 4), shape, shape))
    for mine, true in zip(learned(ours, a, b, upstream), learned(theirs, a, b, upstream), strict=True):
        assert mine.dtype == dtype
        assert torch.equal(mine, true)


def test_what_needs_no_gradient_gets_none() -> None:
    still, moving = torch.eye(3).expand(5, 3, 3), torch.rand(5, 3, 3).requires_grad_()
    products(still, moving).sum().backward()
    assert still.grad is None
    assert torch.equal(moving.grad, torch.ones(5, 3, 3))
