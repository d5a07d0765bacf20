"""The floor under the placed bodies of a clip."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import rescale_viewmats
from stages.avatar.motion.placing import Soles
from stages.estimators.bodyfit.inputs import Inputs
from stages.estimators.ground import find_ground
from stages.records import BodyModel, BodyPoses, Ground


def floor_of(clip: Inputs, *people: tuple[BodyModel, BodyPoses]) -> Ground:
    """The floor under the placed bodies, from SfM's points and the soles of the frames that show somebody."""
    turns, points, stood = [], [], []
    for model, poses in people:
        seen = poses.confidence > 0
        if not seen.any():
            seen = ~seen
        turns.append(Rotation.from_rotvec(poses.global_orient[seen]).as_matrix())
        soles = Soles.of_model(model, poses.betas)
        feet, joints = soles.at(poses.global_orient[seen], poses.body_pose[seen], poses.transl[seen])
        points.append(feet)
        stood.append((joints[len(joints) // 2, 0], turns[-1][len(joints) // 2]))
    most = max(feet.shape[1] for feet in points)  # a body's shape decides how many points its soles have
    all_feet = np.concatenate([np.pad(feet, ((0, 0), (0, most - feet.shape[1]), (0, 0)), "edge") for feet in points])
    metres = people[0][1].world_from_sfm
    viewmats = rescale_viewmats(clip.cameras.viewmats, metres)
    return find_ground(clip.points * metres, all_feet, np.concatenate(turns), *stood[0], viewmats, metres)
