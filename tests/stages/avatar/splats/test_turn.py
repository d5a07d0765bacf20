"""A set of Gaussians turned as a whole looks from the turned side as it looked."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.model.scene import load_scene
from stages.avatar.splats.turn import OVER, turned
from stages.records import Scene


def some(n: int = 30, degree: int = 3) -> Scene:
    rng = np.random.default_rng(0)
    parts = {
        "means": rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.01, 0.1, (n, 3)),
        "opacities": rng.random(n),
        "sh0": rng.normal(size=(n, 3)),
        "shN": rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)),
    }
    return Scene(**{name: part.astype(np.float32) for name, part in parts.items()}, antialias=True)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("turn", [OVER, Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()])
def test_places_shapes_and_colours_turn_together(degree, turn):
    before, eye = load_scene(some(degree=degree)), torch.tensor([0.5, -2.0, 3.0])
    after = load_scene(turned(some(degree=degree), turn))
    matrix = torch.as_tensor(turn, dtype=torch.float32)
    assert torch.allclose(after.means, before.means @ matrix.T, atol=1e-6)
    shapes = [splats.axes @ splats.axes.mT for splats in (before, after)]
    assert torch.allclose(shapes[1], matrix @ shapes[0] @ matrix.T, atol=1e-8)
    assert torch.allclose(after.colors(matrix @ eye), before.colors(eye), atol=1e-5)
    assert after.antialias


def test_half_a_turn_twice_is_none():
    twice = turned(turned(some(), OVER), OVER)
    np.testing.assert_array_equal(twice.means, some().means)
    np.testing.assert_allclose(np.abs(twice.quats), np.abs(some().quats), atol=1e-6)
    np.testing.assert_allclose(twice.shN, some().shN, atol=1e-6)


def test_nothing_turns_into_nothing():
    assert len(turned(some(0), OVER)) == 0
