"""The face of a body: shapes, each a displacement of points of the head, that add up."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from stages import gestures
from stages.avatar.splats.neighbours import mean_near

SKIN = 6  # vertices of the body whose mean shape a point of the face follows


def face_at(rig: gestures.HandsFace, template: Tensor, shapedirs: Tensor, betas: Tensor) -> Tensor:
    """Points [M,3] m of the face at rest for `betas` [10], with the body's `template` [V,3] m and `shapedirs` [V,3,10]: each
    moves as the vertices nearest to it. Differentiable in the betas.
    """
    points = torch.as_tensor(rig.face_points).to(template)
    return points + mean_near(shapedirs, template, points, SKIN) @ betas


def face_vector(face: Mapping[str, float], count: int = len(gestures.FACE_NAMES)) -> np.ndarray:
    """Coefficients [count] in the order of `face_names`, 0 where `face` has no name; ValueError for names that are none of them."""
    names = gestures.face_names(count)
    if unknown := sorted(set(face) - set(names)):
        raise ValueError(f"no shape of a face is called {', '.join(unknown)}; there are {', '.join(names)}")
    return np.array([float(face.get(name, 0.0)) for name in names])
