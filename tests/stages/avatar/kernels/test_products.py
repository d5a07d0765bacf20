"""Products of many matrices: those of torch to the bit, with their gradients."""

import pytest
import torch
from torch import Tensor

from stages.avatar.kernels.products import products


def learned(a: Tensor, b: Tensor, upstream: Tensor, ours: bool) -> tuple[Tensor, ...]:
    """The products of the left parts of a[N,3,4] with b[N,3,3], and the gradients of both."""
    a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
    found = products(a[..., :3], b) if ours else a[..., :3] @ b
    found.backward(upstream)
    return found.detach(), a.grad, b.grad


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_products_and_gradients_are_those_of_torch_to_the_bit(count: int, dtype: torch.dtype) -> None:
    g = torch.Generator().manual_seed(0)
    a, b, upstream = (torch.randn(count, 3, width, generator=g, dtype=dtype) for width in (4, 3, 3))
    for ours, theirs in zip(learned(a, b, upstream, True), learned(a, b, upstream, False), strict=True):
        assert ours.dtype == dtype
        assert torch.equal(ours, theirs)


def test_what_needs_no_gradient_gets_none() -> None:
    still, moving = torch.eye(3).expand(5, 3, 3), torch.rand(5, 3, 3).requires_grad_()
    products(still, moving).sum().backward()
    assert still.grad is None
    assert torch.equal(moving.grad, torch.ones(5, 3, 3))
