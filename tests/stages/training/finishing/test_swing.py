"""What clothes did in the frames is told again by pose and spring, and carried by what they moved with."""

import pytest
import torch

from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.avatar.body.smpl import affine
from stages.avatar.effects.clothing import Clothing, Hung
from stages.avatar.effects.spring import sways
from stages.training.finishing.swing import DAMPING, FREE, Course, fit_swing

FRAMES = 48


def course(seed: int = 0) -> Course:
    """A body that walks to and fro and turns, its two legs swinging each its own way; the other bones go with the pelvis."""
    generator = torch.Generator().manual_seed(seed)
    times = torch.arange(FRAMES) / 12
    waves = torch.stack(
        [torch.sin(times * rate + phase) for rate, phase in ((4.0, 0), (5.3, 1.0), (2.1, 2.0), (7.0, 0.5))], 1
    )
    root = matrix_from_rotvec(torch.stack([0 * times, waves[:, 2], 0 * times], 1))
    bones = affine(root, torch.zeros(FRAMES, 3))[:, None].repeat(1, 24, 1, 1)
    pose = torch.zeros(FRAMES, 69)
    for leg in (1, 2):
        pose[:, 3 * leg - 3] = 0.5 * waves[:, leg - 1]
        turn = matrix_from_rotvec(pose[:, 3 * leg - 3 : 3 * leg])
        bones[:, leg] = bones[:, leg] @ affine(turn, torch.zeros(FRAMES, 3))
    return Course(bones, 0.3 * waves[:, [3, 0, 1]] + 0.01 * torch.rand(FRAMES, 3, generator=generator), pose, times)


def clothes(told: Course) -> Clothing:
    carriers = torch.zeros(2, 24)
    carriers[0, 0] = carriers[1, 0] = 1
    return Clothing.start(Hung(torch.tensor([[0.2, -0.5, 0.1], [-0.2, -0.5, 0]]), carriers), told.body_pose)


@pytest.fixture
def trained() -> torch.Tensor:
    found = torch.ones(FRAMES, dtype=torch.bool)
    found[::5] = False
    return found


def test_a_swing_that_follows_the_pose_is_found_without_a_spring(trained):
    told = course()
    clothing = clothes(told)
    wanted = torch.zeros_like(clothing.swings).normal_(0, 0.3, generator=torch.Generator().manual_seed(2))
    table = (wanted @ clothing.features(told.body_pose).T).permute(2, 0, 1)
    table[~trained] = 99.0  # nobody learned there
    before = clothes(told)
    assert fit_swing(clothing, table, trained, told) < 0.05
    assert not clothing.sways.any()
    for frame in (0, 7, 20):  # the first of them nobody learned
        pose, bones = told.body_pose[frame], told.bones[frame]
        true = before.hang(bones, wanted @ before.features(pose))[24:]
        assert (clothing.hang(bones, clothing.swing(pose))[24:] - true).abs().max() < 0.04


@pytest.mark.slow
def test_what_swings_on_a_spring_is_told_by_that_spring(trained):
    told = course()
    clothing = clothes(told)
    clothing.spring.copy_(torch.tensor([FREE[1], DAMPING[0]]))
    sway = torch.stack(list(sways(clothing, told.bones, told.transl, told.times)))
    gain = torch.zeros(2, 6, 3)
    gain[:, 3:] = 15 * torch.eye(3)
    table = torch.einsum("kor,fkr->fko", gain, sway)
    untold = fit_swing(clothing, table, trained, told)
    torch.testing.assert_close(clothing.spring, torch.tensor([FREE[1], DAMPING[0]]))
    assert untold < 0.1 and (clothing.sways - gain).norm() < 0.2 * gain.norm()
    torch.testing.assert_close(clothing.reach, sway.norm(dim=2).amax(0))


def test_noise_is_neither_pose_nor_spring(trained):
    told = course()
    clothing = clothes(told)
    table = torch.randn(FRAMES, 2, 6, generator=torch.Generator().manual_seed(3))
    assert fit_swing(clothing, table, trained, told) > 0.9 and not clothing.sways.any()


def test_a_bone_is_carried_by_what_it_moves_with(trained):
    """The first hangs on the pelvis and goes with the left leg in the frames; the second stays."""
    told = course()
    clothing = clothes(told)
    goal = told.bones[:, 1] @ torch.cat([clothing.centres[0], torch.ones(1)])
    root, turn = told.bones[:, 0], told.bones[:, 0, :3, :3].mT @ told.bones[:, 1, :3, :3]
    table = torch.zeros(FRAMES, 2, 6)
    table[:, 0, :3] = rotvec_from_matrix(turn) / 0.3
    table[:, 0, 3:] = ((root[:, :3, :3].mT @ goal[:, :3, None])[..., 0] - clothing.centres[0]) / 0.05
    fit_swing(clothing, table, trained, told)
    assert clothing.carriers[0, 1] > 0.95 and clothing.carriers[1, 0] > 0.95
    torch.testing.assert_close(clothing.carriers.sum(1), torch.ones(2))
    assert clothing.swings.abs().max() < 0.1, "and need not swing"
