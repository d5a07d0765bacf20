"""How far a pose is from those that training has seen: where an avatar has to show that it moves."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SHARE = 1 / 3  # of the frames


def farthest(body_pose: np.ndarray, asked: list[int], seen: np.ndarray) -> list[int]:
    """The third of the frames `asked`, one at least, whose poses are farthest from the nearest of those `seen` [F].

    body_pose [F,69] rad; the distance of two poses is the mean angle between their joints. In the order of `asked`; none
    where nothing is asked or seen.
    """
    if not asked or not seen.any():
        return []
    turns = Rotation.from_rotvec(np.asarray(body_pose, np.float64).reshape(-1, 3)).as_quat()
    turns = turns.reshape(len(body_pose), -1, 4)
    same = np.abs(np.einsum("ajk,sjk->asj", turns[asked], turns[seen])).clip(max=1)
    away = (2 * np.arccos(same)).mean(2).min(1)
    order = np.argsort(-away, kind="stable")[: max(1, round(SHARE * len(asked)))]
    return [asked[i] for i in sorted(order)]
