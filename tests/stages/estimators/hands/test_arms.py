"""Arms turned to palms that are seen, on a made body."""

from dataclasses import replace

import numpy as np
import torch

from stages.avatar.body.joints import ELBOWS, SHOULDERS, WRISTS
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import Body, rest_relative_transforms
from stages.avatar.cameras.pinhole import pinhole, project
from stages.estimators.hands.arms import SeenPalms, arms_to_palms
from stages.estimators.hands.clip import palms_of
from stages.records import BodyPoses, Cameras
from tests.made.hands import MODEL, RIG

FRAMES = 6
NAMES = tuple("012345")
TIMES = np.arange(FRAMES) / 15
VIEW = np.diag([1.0, -1, -1, 1])
VIEW[2, 3] = 3
CAMERAS = Cameras(NAMES, np.tile(VIEW, (FRAMES, 1, 1)), np.tile(pinhole(800.0, 900, 900), (FRAMES, 1, 1)), 900, 900)
REST = palms_of(RIG, MODEL, np.zeros(10))


def posed(turns):
    """Poses whose joints turn by `turns`, joint -> [3] rad."""
    body_pose = np.zeros((FRAMES, 23, 3))
    for joint, turn in turns.items():
        body_pose[:, joint - 1] = turn
    still = np.zeros((FRAMES, 3))
    return BodyPoses(NAMES, np.zeros(10), still, body_pose.reshape(FRAMES, 69), still, np.ones(FRAMES))


def palms(poses):
    """Where and how the camera sees the palms of a body."""
    body, pose = Body(MODEL), np.concatenate([poses.global_orient, poses.body_pose], 1)
    turns = matrix_from_rotvec(torch.tensor(pose, dtype=torch.float32).unflatten(1, (24, 3)))
    wrists = (
        rest_relative_transforms(body.rest_joints(torch.zeros(10)), turns, body.parents)[:, list(WRISTS)]
        .double()
        .numpy()
    )
    points = np.einsum("fsij,spj->fspi", wrists[..., :3, :3], REST) + wrists[:, :, None, :3, 3]
    pixels = project(points.reshape(FRAMES, 10, 3), CAMERAS.viewmats, CAMERAS.Ks)[0].reshape(FRAMES, 2, 5, 2)
    read = np.ones((FRAMES, 2), bool)
    return SeenPalms(pixels, VIEW[:3, :3] @ wrists[..., :3, :3], read, np.full((FRAMES, 2), 50.0), REST)


def off(poses, seen):
    """Mean distance [F,2] px of the palms' points, and the angle [F,2] rad between the palms."""
    found = palms(poses)
    cosine = (np.einsum("fsij,fsij->fs", found.turns, seen.turns) - 1) / 2
    return np.linalg.norm(found.points - seen.points, axis=-1).mean(-1), np.arccos(cosine.clip(-1, 1))


def test_a_twisted_forearm_is_found_and_the_rest_of_the_body_stays():
    start, truth = posed({ELBOWS[1]: [0, 0.8, 0]}), posed({ELBOWS[1]: [0.4, 0.8, 0], WRISTS[1]: [0.5, 0, 0.4]})
    seen = palms(truth)
    turned = arms_to_palms(MODEL, start, CAMERAS, TIMES, seen)
    before, after = off(start, seen), off(turned, seen)
    assert before[1][:, 1].min() > 0.8 and after[1].max() < 0.2 and after[0].max() < 3
    changed = np.abs(turned.body_pose - start.body_pose).reshape(FRAMES, 23, 3).max((0, 2))
    assert set(np.flatnonzero(changed > 1e-4) + 1) <= {*SHOULDERS, *ELBOWS, *WRISTS} and changed[WRISTS[1] - 1] > 0.3


def test_a_hand_that_is_never_read_moves_no_arm():
    start = posed({})
    seen = palms(posed({WRISTS[0]: [0.6, 0, 0], WRISTS[1]: [0.6, 0, 0]}))
    alone = replace(seen, read=np.tile([True, False], (FRAMES, 1)))
    turned = arms_to_palms(MODEL, start, CAMERAS, TIMES, alone)
    changed = np.abs(turned.body_pose - start.body_pose).reshape(FRAMES, 23, 3).max((0, 2))
    assert changed[WRISTS[0] - 1] > 0.1 and not changed[[SHOULDERS[1] - 1, ELBOWS[1] - 1, WRISTS[1] - 1]].any()
