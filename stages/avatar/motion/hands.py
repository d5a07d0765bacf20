"""Fingers of other skeletons on those of an avatar: bones point and twist as theirs. float64, no files.

As in `retarget`, both are compared in a reference pose, from which on the bones turn alike. In what follows hands are rotations
[F,2,15,3,3] of each bone in the axes of the one above it, from the body's hand at rest: see `avatar.body.fingers`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.fingers import from_flat
from stages.gestures import FINGER_NAMES, Fingers

NONE = 1e-6  # of a skeleton's size: a bone that is shorter points nowhere
FARTHEST = np.radians(130)  # that a finger's bone turns, in most frames: what does is a file's error, and some have it


def from_smplx(rotvecs: np.ndarray, fingers: Fingers) -> np.ndarray:
    """Hands of rotvecs [F,2,15,3] rad of SMPL-H or SMPL-X, whose fingers are flat at 0."""
    rest = torch.as_tensor(fingers.joints).double(), torch.as_tensor(fingers.tips).double()
    return matrices(from_flat(torch.as_tensor(rotvecs).double(), *rest).numpy())


def from_bones(
    turns: np.ndarray,
    places: np.ndarray,
    reference: int,
    chains: Mapping[int, tuple[int, int]],
    hands: np.ndarray,
    fingers: Fingers,
) -> np.ndarray:
    """Hands of a skeleton whose joints stand in the world at turns [1+F,J,3,3] and places [1+F,J,3], the zero pose first.

    `chains` maps bones, numbered as FINGER_NAMES, to the joints at which theirs begin and end; others follow the bone above.
    `hands` [1+F,2,3,3] are the turns of our hands in the world, of which those in the `reference` are compared with the
    skeleton's. What turns by more than FARTHEST in most frames follows the bone above, too: `broken` finds it.
    """
    tips = np.concatenate([fingers.joints.reshape(10, 3, 3), fingers.tips[:, None]], 1)
    ways = np.diff(tips, axis=1).reshape(30, 3)
    world = np.zeros((len(turns), len(FINGER_NAMES), 3, 3))
    local = world.copy()
    for bone in range(len(FINGER_NAMES)):
        above = hands[:, bone // 15] if bone % 3 == 0 else world[:, bone - 1]
        world[:, bone] = above
        if bone in chains:
            start, end = chains[bone]
            way = places[reference, end] - places[reference, start]
            aimed = above[reference]
            if np.linalg.norm(way) > NONE * np.ptp(places[reference], axis=0).max():
                aimed = _aimed(aimed @ ways[bone], way) @ aimed
            world[:, bone] = turns[:, start] @ turns[reference, start].T @ aimed
        local[:, bone] = above.mT @ world[:, bone]
        if np.median(Rotation.from_matrix(local[1:, bone]).magnitude()) > FARTHEST:
            world[:, bone], local[:, bone] = above, np.eye(3)
    return local[1:].reshape(-1, 2, 15, 3, 3)


def broken(hands: np.ndarray, chains: Collection[int]) -> int:
    """How many of the bones `chains` were left out of the hands that `from_bones` made, because they turned too far."""
    still = (hands.reshape(len(hands), -1, 3, 3) == np.eye(3)).all((0, 2, 3))
    return int(still[list(chains)].sum())


def matrices(rotvecs: np.ndarray) -> np.ndarray:
    """Rotations [...,3,3] of rotation vectors [...,3]."""
    return Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(*rotvecs.shape, 3)


def rotvecs(rotations: np.ndarray) -> np.ndarray:
    """Rotation vectors [...,3] of rotations [...,3,3]."""
    return Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(rotations.shape[:-1])


def _aimed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return Rotation.align_vectors(b[None], a[None])[0].as_matrix()
