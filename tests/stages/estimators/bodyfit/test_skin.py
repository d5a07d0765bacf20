"""Chosen vertices of the body: where the whole body has them, with and without pose correctives."""

from __future__ import annotations

import pytest
import torch

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.skin import Bones, Skin
from tests.stages.avatar.conftest import make_small_body


@pytest.mark.parametrize("posedirs", [True, False])
@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("own", [True, False])
def test_chosen_vertices_lie_where_the_whole_body_has_them_and_pull_as_it_does(posedirs, frames, own):
    body = Body(make_small_body(posedirs=posedirs), torch.float64)
    torch.manual_seed(0)
    betas, pose = torch.randn(10, dtype=torch.float64), 0.5 * torch.randn(frames, 24, 3, dtype=torch.float64)
    chosen = torch.randint(0, 60, (frames, 9)) if own else torch.randint(0, 60, (9,))
    found = []
    for whole in (True, False):
        betas, pose = (part.detach().clone().requires_grad_() for part in (betas, pose))
        if whole:
            vertices = body(betas, pose[:, 0], pose[:, 1:].flatten(1), torch.zeros(frames, 3))[0]
            points = vertices.gather(1, chosen.expand(frames, 9)[..., None].expand(-1, -1, 3))
        else:
            points = Skin.of(body, chosen).posed(Bones.of(body, betas, matrix_from_rotvec(pose)))[0]
        points.sin().sum().backward()
        found.append((points.detach(), betas.grad, pose.grad))
    for expected, actual in zip(*found, strict=True):
        torch.testing.assert_close(actual, expected, atol=1e-12, rtol=1e-9)
