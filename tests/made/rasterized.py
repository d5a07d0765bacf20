"""Gaussians, cameras and pictures that the rasterizer's tests share, and how far two results are apart."""

import math

import pytest
import torch

from stages.avatar.rasterize import Camera, Gaussians, Layer, cpu, reference

WIDTH, HEIGHT = 61, 45
BACKGROUND = torch.tensor([0.2, 0.5, 0.7])
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmat", "background")
PICTURE = ("image", "alpha", "depth")
STRAIGHT = torch.eye(4)
MAKERS = [(cpu, torch.float32), (reference, torch.float64)]
both = pytest.mark.parametrize("maker, dtype", MAKERS, ids=["cpu", "reference"])


def camera(width=WIDTH, height=HEIGHT, focal=60.0, cx=None, cy=None):
    view = torch.eye(4)
    angle = 0.2
    view[:3, :3] = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    view[:3, 3] = torch.tensor([0.1, -0.05, 0.3])
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return view, torch.tensor([[focal, 0, cx], [0, 1.1 * focal, cy], [0, 0, 1]])


def gaussians(n=300, kind="mixed", seed=0):
    """means, quats, scales, opacities, colors in front of `camera`."""
    g = torch.Generator().manual_seed(seed)

    def u(*shape):
        return torch.rand(*shape, generator=g)

    means = torch.cat([4 * (u(n, 2) - 0.5), 2 + 3 * u(n, 1)], 1)
    quats = torch.randn(n, 4, generator=g)
    scales = {
        "mixed": 0.02 + 0.2 * u(n, 3) ** 2,
        "needles": torch.tensor([0.5, 0.004, 0.004]) * (0.5 + u(n, 3)),
        "huge": 2 + 3 * u(n, 3),
        "tiny": 0.002 + 0.004 * u(n, 3),
        "deep": 0.4 + 0.4 * u(n, 3),
        "opaque": 0.05 + 0.2 * u(n, 3),
        "beside": 0.3 + 0.5 * u(n, 3),
    }[kind if kind not in ("tied", "kilometres") else "mixed"]
    if kind == "tied":  # each place twice: the order of rows decides
        means = means[::2].repeat_interleave(2, 0)
    elif kind == "beside":  # most lie outside the picture and reach in: their Jacobian is clamped
        means = means * torch.tensor([3.0, 3, 1])
    elif kind == "kilometres":
        means, scales = 1000 * means, 1000 * scales
    low, high = {"deep": (0.02, 0.12), "opaque": (0.97, 0.99999), "tiny": (0.5, 0.99)}.get(kind, (0.05, 0.99))
    return means, quats, scales, low + (high - low) * u(n), u(n, 3)


def draw(maker, parts, view, K, width=WIDTH, height=HEIGHT, dtype=torch.float32, background=BACKGROUND, **options):
    """The picture of `parts` and all gradients of a fixed random function of colour, coverage and depth."""
    leaves = [p.detach().to(dtype).requires_grad_() for p in (*parts, view, background)]
    means, quats, scales, opacities, colors, view, background = leaves
    axes = maker.gaussian_axes(quats, scales)
    gaussians = Gaussians(means, axes, opacities, colors, options.get("antialias", False))
    (drawn,) = maker.rasterize(gaussians, Camera(view, K.to(dtype), width, height), [Layer(background=background)])
    g = torch.Generator().manual_seed(5)
    weights = [torch.rand(t.shape, generator=g).to(dtype) for t in (drawn.image, drawn.alpha, drawn.depth)]
    loss = sum((w * t).sum() for w, t in zip(weights, (drawn.image, drawn.alpha, 0.1 * drawn.depth)))
    loss.backward()
    return drawn, [leaf.grad for leaf in leaves]


def apart(a, b):
    """Relative L2 distance."""
    return ((a.double() - b.double()).norm() / b.double().norm().clamp_min(1e-12)).item()


def ball(n=1, z=3.0, sigma=0.2, opacity=0.5):
    """n equal round Gaussians on the axis: means, quats, scales, opacities, colors."""
    colors = torch.rand(n, 3, generator=torch.Generator().manual_seed(1))
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return [torch.tensor([0.0, 0, z]).repeat(n, 1), quats, torch.full((n, 3), sigma), torch.full((n,), opacity), colors]


def show(maker, parts, view, K, width, height, antialias=False, **options):
    """The picture of `parts` (means, quats, scales, opacities, colors) over black, without gradients."""
    means, quats, scales, opacities, colors = parts
    axes = maker.gaussian_axes(quats, scales)
    gaussians = Gaussians(means, axes, opacities, colors, antialias)
    (drawn,) = maker.rasterize(gaussians, Camera(view, K, width, height).to(means), **options)
    return drawn


def cast(parts, dtype=torch.float64):
    return [p.to(dtype) for p in parts]


def largest(a, b):
    return (a.double() - b.double()).detach().abs().max().item()


def worst(values):
    """The largest; unlike Python's max, not-a-number if one is."""
    return torch.tensor(list(values), dtype=torch.float64).max().item()
