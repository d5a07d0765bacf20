"""The pose of a body of ours whose limbs, hips, head and feet point as points of another body do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.motion.retarget import turn_between
from stages.estimators.bodyfit.evidence import LandmarkEvidence, model_landmarks
from stages.estimators.bodyfit.resting import SEGMENTS, lines_between, nearest_lengths
from stages.estimators.bodyfit.start import normalize, rotations_of_axes, start_pose
from stages.formats.given_fits.record import SmplFit
from stages.formats.landmarks import NAMES
from stages.records import JOINT_NAMES, BodyModel

LIMBS = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
NECK, HEAD = JOINT_NAMES.index("neck"), JOINT_NAMES.index("head")
ENDS = (
    ("hip", "knee", "ankle", "foot", ("foot_index",)),
    ("shoulder", "elbow", "wrist", "hand", ("index", "pinky")),
)
"""What a foot and a hand hang from, their two joints, and the points that they follow."""


def from_points(fit: SmplFit, model: BodyModel) -> SmplFit:
    """A fit of `points` [N,33,3] m in each camera as one of `model`, with the hips' middle in the same place.

    Trunk and limbs point along the lines between the points, elbows and knees bend in their plane; the head follows ears and
    nose, feet and hands their toes and knuckles. Limbs are as long as the points', by the median of the rows.
    """
    points = np.asarray(fit.points, np.float64)
    at = {name: points[:, k] for k, name in enumerate(NAMES)}
    betas, joints = _shaped(at, model)
    rest = dict(zip(JOINT_NAMES, joints, strict=True))
    void = np.ones(points.shape[:2])
    middle = 0.5 * (at["left_hip"] + at["right_hip"])
    seen = np.ones(len(points), bool)
    evidence = LandmarkEvidence(NAMES, void[..., None] * np.zeros(2), void, points - middle[:, None], seen, void[:, 0])
    root, local = start_pose(evidence, joints)
    for side in ("left", "right"):
        for upper, lower, joint, end, marks in ENDS:
            above = [local[:, JOINT_NAMES.index(f"{side}_{part}") - 1] for part in (upper, lower)]
            frame = root @ above[0] @ above[1]
            bone = frame @ normalize(rest[f"{side}_{end}"] - rest[f"{side}_{joint}"])
            aim = normalize(np.mean([at[f"{side}_{mark}"] for mark in marks], axis=0) - at[f"{side}_{joint}"])
            bent = turn_between(bone, np.where(np.isfinite(aim), aim, bone))
            local[:, JOINT_NAMES.index(f"{side}_{joint}") - 1] = frame.transpose(0, 2, 1) @ bent @ frame
    ears = at["left_ear"] - at["right_ear"]
    face = rotations_of_axes(normalize(ears), normalize(at["nose"] - 0.5 * (at["left_ear"] + at["right_ear"])))
    straight = rotations_of_axes(np.array([1.0, 0, 0]), np.array([0.0, 0, 1]))
    turned = Rotation.from_matrix(root.transpose(0, 2, 1) @ face @ straight.T)
    half = (turned**0.5).as_matrix()
    local[:, NECK - 1] = local[:, HEAD - 1] = half
    way = root @ (0.5 * (rest["left_hip"] + rest["right_hip"]) - joints[0])
    return replace(
        fit,
        betas=np.tile(betas, (len(fit), 1)),
        global_orient=Rotation.from_matrix(root).as_rotvec(),
        body_pose=Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(fit), 69),
        transl=middle - way - joints[0],
        points=None,
        notes=(
            *fit.notes,
            f"the points of {fit.tool} are carried over to the {model.name}, its limbs as long as theirs",
        ),
    )


def _shaped(at: dict[str, np.ndarray], model: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """Betas [10] of a body whose trunk and limbs are as long as those between the points, and its joints [24,3] at rest, which are
    its landmarks where it has such."""
    regressor = model.J_regressor.astype(np.float64)
    for name, row in zip(*model_landmarks(model), strict=True):
        if name in JOINT_NAMES and not name.endswith(("_hand", "_foot")):
            regressor[JOINT_NAMES.index(name)] = row
    rest, change = regressor @ model.v_template, np.einsum("jv,vcb->jcb", regressor, model.shapedirs)
    bones = [at[f"{side}_{b}"] - at[f"{side}_{a}"] for a, b in LIMBS for side in ("left", "right")]
    trunk = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    wanted = np.median(np.linalg.norm([0.5 * trunk, *bones], axis=-1), axis=1)
    segments = np.concatenate([lines_between(((1, 2), (16, 17))), SEGMENTS[1:]])
    betas = nearest_lengths(rest, change, segments, wanted)
    return betas, rest + change @ betas
