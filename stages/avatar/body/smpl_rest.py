"""SMPL at rest: the joints of its neutral body of mean shape."""

from __future__ import annotations

import numpy as np

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
BONES = (
    (-0.0018, -0.2233, 0.0282),
    (0.0695, -0.0914, -0.0068),
    (-0.0677, -0.0905, -0.0043),
    (-0.0025, 0.1090, -0.0267),
    (0.0343, -0.3752, -0.0045),
    (-0.0383, -0.3826, -0.0089),
    (0.0055, 0.1352, 0.0011),
    (-0.0136, -0.3980, -0.0437),
    (0.0158, -0.3984, -0.0423),
    (0.0015, 0.0529, 0.0254),
    (0.0264, -0.0558, 0.1193),
    (-0.0254, -0.0481, 0.1233),
    (-0.0028, 0.2139, -0.0429),
    (0.0788, 0.1217, -0.0341),
    (-0.0818, 0.1188, -0.0386),
    (0.0052, 0.0650, 0.0513),
    (0.0910, 0.0305, -0.0089),
    (-0.0960, 0.0326, -0.0091),
    (0.2596, -0.0128, -0.0275),
    (-0.2537, -0.0133, -0.0214),
    (0.2492, 0.0090, -0.0012),
    (-0.2553, 0.0078, -0.0056),
    (0.0840, -0.0082, -0.0149),
    (-0.0846, -0.0061, -0.0103),
)
"""Each joint of neutral SMPL of mean shape from its parent, m: published with the SMPL humanoid of MuJoCo benchmarks."""


def smpl_rest() -> np.ndarray:
    """Joints [24,3] of neutral SMPL of mean shape at rest, m, y up and facing +z."""
    joints = np.array(BONES)
    for joint, parent in enumerate(PARENTS[1:], 1):
        joints[joint] += joints[parent]
    return joints
