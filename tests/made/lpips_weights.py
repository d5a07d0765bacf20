"""Weights of LPIPS's networks, made at random: the true layers with few channels."""

import numpy as np

ALEX = [(11, 3, 4, 4, 2), (5, 4, 6, 1, 2), (3, 6, 8, 1, 1), (3, 8, 5, 1, 1), (3, 5, 5, 1, 1)]
VGG_WIDTHS = [3, 4, 4, 5, 5, 6, 6, 6, 7, 7, 7, 7, 7, 7]


def small_weights(net):
    """The true layers with few channels: [k, in, out] convolutions and five heads."""
    rng = np.random.default_rng(0)
    layers = [c[:3] for c in ALEX] if net == "alex" else [(3, *VGG_WIDTHS[i : i + 2]) for i in range(13)]
    arrays = {}
    for i, (size, channels, features) in enumerate(layers):
        arrays[f"conv{i}_w"] = rng.normal(0, 1 / size, (features, channels, size, size)).astype(np.float16)
        arrays[f"conv{i}_b"] = rng.normal(0, 0.1, features).astype(np.float16)
    taps = range(5) if net == "alex" else (1, 3, 6, 9, 12)
    return arrays | {f"lin{t}": rng.random(layers[i][2]).astype(np.float16) for t, i in enumerate(taps)}
