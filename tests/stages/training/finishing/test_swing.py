"""What clothes did in the frames is told again by the pose, and carried by what they moved with."""

from typing import NamedTuple

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors

from stages.avatar.body.joints import HIPS, KNEES
from stages.avatar.body.rotations import rotvec_from_matrix
from stages.avatar.body.smpl import Body
from stages.avatar.effects.clothing import Clothing, Hung
from stages.avatar.model.person import bone_transforms
from stages.formats.body_model import read_body_model
from stages.training.finishing.swing import fit_swing
from tests.made.skeleton import PARENTS

FRAMES = 48


class Course(NamedTuple):
    bones: torch.Tensor
    body_pose: torch.Tensor


JOINTS = Body(read_body_model(None)).rest(torch.zeros(10))[1]


def course() -> Course:
    """The free body that turns, its two legs swinging each its own way."""
    times = torch.arange(FRAMES) / 12
    waves = torch.stack([torch.sin(times * rate + phase) for rate, phase in ((4.0, 0), (5.3, 1.0), (2.1, 2.0))], 1)
    root, pose = torch.stack([0 * times, waves[:, 2], 0 * times], 1), torch.zeros(FRAMES, 69)
    pose[:, [0, 3]] = 0.5 * waves[:, :2]
    return Course(torch.stack([bone_transforms(JOINTS, PARENTS, *one) for one in zip(root, pose)]), pose)


def clothes(told: Course) -> Clothing:
    carriers = torch.zeros(2, 24)
    carriers[0, 0] = carriers[1, 0] = 1
    centres = JOINTS[list(KNEES)] + torch.tensor([[0, 0, 0.1], [-0.1, 0, 0]])
    return Clothing.start(Hung(centres, carriers), JOINTS, told.body_pose)


@pytest.fixture
def trained() -> torch.Tensor:
    found = torch.ones(FRAMES, dtype=torch.bool)
    found[::5] = False
    return found


def test_a_swing_that_follows_the_pose_is_found(trained):
    told = course()
    clothing = clothes(told)
    wanted = torch.zeros_like(clothing.swings).normal_(0, 0.3, generator=torch.Generator().manual_seed(2))
    table = (wanted @ clothing.features(told.body_pose).T).permute(2, 0, 1)
    table[~trained] = 99.0  # nobody learned there
    before = clothes(told)
    assert fit_swing(clothing, table, trained, *told) < 0.05
    for frame in (0, 7, 20):  # the first of them nobody learned
        pose, bones = told.body_pose[frame], told.bones[frame]
        true = before.hang(bones, wanted @ before.features(pose))[24:]
        assert (clothing.hang(bones, clothing.swing(pose))[24:] - true).abs().max() < 0.04


def test_noise_is_not_told(trained):
    told = course()
    clothing = clothes(told)
    table = torch.randn(FRAMES, 2, 6, generator=torch.Generator().manual_seed(3))
    assert fit_swing(clothing, table, trained, *told) > 0.9


def test_a_bone_is_carried_by_what_it_moves_with(trained):
    """The first hangs on the pelvis and is pushed by the left leg in the frames; the second stays."""
    told = course()
    clothing = clothes(told)
    pushed = clothing.pushed(told.bones)[:, 0, HIPS[0], None, None]
    left = torch.linalg.solve(
        told.bones[:, 0], torch.lerp(clothing.upright(told.bones), told.bones[:, HIPS[0]], pushed)
    )
    centre = clothing.centres[0]
    table = torch.zeros(FRAMES, 2, 6)
    table[:, 0, :3] = rotvec_from_matrix(left[:, :3, :3]) / 0.3
    table[:, 0, 3:] = ((left[:, :3, :3] @ centre) + left[:, :3, 3] - centre) / 0.05
    fit_swing(clothing, table, trained, *told)
    assert clothing.carriers[0, [1, 4, 7, 10]].sum() > 0.95 and clothing.carriers[1, 0] > 0.95
    torch.testing.assert_close(clothing.carriers.sum(1), torch.ones(2))
    assert clothing.swings.abs().max() < 0.1, "and need not swing"


class FarTensors(TorchFunctionMode):
    """Takes tensors for those of a GPU, but for those that were just made without a device: where the two meet, it refuses."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        inside = [one for arg in args for one in (arg if isinstance(arg, list | tuple) else [arg])]
        here = [hasattr(one, "here") for one in inside if isinstance(one, torch.Tensor) and one.dim()]
        assert name in ("to", "__getitem__") or len(set(here)) < 2, f"{name} of tensors on two devices"
        assert name != "numpy" or all(here), "a GPU's tensor is no array"
        found = func(*args, **kwargs)
        if name == "to":
            return found.clone()
        made = func in _device_constructors() and "device" not in kwargs
        if isinstance(found, torch.Tensor) and (made or name == "cpu" or (here and all(here))):
            found.here = True
        return found


def test_on_a_gpu_nothing_meets_a_tensor_of_the_processor(trained):
    told = course()
    clothing, table = clothes(told), torch.zeros(FRAMES, 2, 6)
    with FarTensors():
        assert fit_swing(clothing, table, trained, *told) < 1
