"""SMPL motions of other programs: the .npz families, read only for the body's motion.

| family   | keys                                                                               | metres        |
|----------|------------------------------------------------------------------------------------|---------------|
| AMASS    | poses [F,156] (SMPL-H), [F,165] (SMPL-X) or [F,72], trans, mocap_framerate         | yes           |
| AIST++   | smpl_poses [F,72], smpl_trans, smpl_scaling; 60 frames a second                    | trans/scaling |
| others   | poses [F,72] or global_orient, body_pose; trans or transl; maybe fps               | yes           |

Sources: https://amass.is.tue.mpg.de, https://google.github.io/aistplusplus_dataset. None says which way is up: AMASS
has z up, AIST++ y, fits in a camera's frame -y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, take
from stages.formats.body_model import SMPL
from stages.formats.poses import whose

HINT = "an SMPL motion needs poses [F,72] (AMASS: 156 or 165, AIST++: smpl_poses) and trans [F,3]"
BODY = 22  # joints that SMPL, SMPL-H and SMPL-X share; SMPL's two more are stiff hands
RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
AIST_FPS = 60.0
_MOTION = ("poses", "smpl_poses", "global_orient", "body_pose", "trans", "transl", "smpl_trans", "smpl_scaling")
KEYS = (*_MOTION, *RATES, "body", "world_from_sfm")
"""All that is read: SMPL-X files of AMASS hold pickles too."""


@dataclass(frozen=True)
class SmplMotion:
    """F poses as their file means them: `rotvecs` [F,24,3] rad, root first; `transl` [F,3] m, in the file's axes.

    `fps` frames a second, None where the file does not say. `notes` say what was left out. `body`: whose poses they are, as
    `formats.poses.whose` says.
    """

    rotvecs: np.ndarray
    transl: np.ndarray
    fps: float | None
    notes: tuple[str, ...] = ()
    body: str = SMPL

    def __len__(self) -> int:
        return len(self.transl)


def read_smpl_motion(path: Path) -> SmplMotion:
    """Read any of the families above; StageError with the key, what was found and what was wanted."""
    arrays = read_npz(path, HINT, KEYS)
    aist = "smpl_poses" in arrays
    key = "smpl_trans" if aist else next((key for key in ("trans", "transl") if key in arrays), "trans")
    transl = checked(take(arrays, key, path, HINT), (None, 3), key, path, HINT).astype(np.float64)
    if not len(transl):
        raise StageError(f"{path} holds no frame", HINT, [f"{key} is 0x3"])
    if aist:
        transl = transl / _positive(arrays, "smpl_scaling", path)
    poses, notes = _poses(arrays, len(transl), path)
    rate = next((key for key in RATES if key in arrays), None)
    fps = _positive(arrays, rate, path) if rate else AIST_FPS if aist else None
    return SmplMotion(poses, transl, fps, notes, whose(arrays, path))


def _poses(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """All 24 rotation vectors [F,24,3], and what was left out."""
    key = "smpl_poses" if "smpl_poses" in arrays else "poses"
    if key not in arrays and "body_pose" in arrays:
        key, width = "body_pose", 72
        poses = np.concatenate(
            [_flat(arrays, part, count, (n,), path) for part, n in (("global_orient", 3), (key, 69))], 1
        )
    else:
        poses = _flat(arrays, key, count, (72, 156, 165), path)
        width = poses.shape[1]
    kept = 24 if width == 72 else BODY
    whole = np.zeros((count, 24, 3))
    whole[:, :kept] = poses[:, : 3 * kept].reshape(count, kept, 3)
    angles = np.linalg.norm(whole, axis=2)
    if angles.max() > 4 * np.pi:
        frame, joint = (int(i) for i in np.unravel_index(angles.argmax(), angles.shape))
        facts = [f"frame {frame}, joint {joint} turns by {angles.max():.1f}"]
        raise StageError(f"{key} in {path} looks like degrees", "rotation vectors are in radians", facts)
    left_out = {156: ("fingers left out",), 165: ("fingers and face left out",)}
    return whole, left_out.get(width, ())


def _flat(arrays: Mapping[str, np.ndarray], key: str, count: int, widths: tuple[int, ...], path: Path) -> np.ndarray:
    """Rotation vectors [F,J,3] or [F,3J] as float64 [F,3J], where 3J is one of `widths`."""
    array = take(arrays, key, path, HINT)
    flat = array.reshape(len(array), -1) if array.ndim == 3 and len(array) else array
    width = flat.shape[1] if flat.ndim == 2 and flat.shape[1] in widths else widths[0]
    return checked(flat, (count, width), key, path, HINT).astype(np.float64)


def _positive(arrays: Mapping[str, np.ndarray], key: str, path: Path) -> float:
    value = take(arrays, key, path, HINT)
    number = float(checked(value.reshape(-1), (1,), key, path, HINT)[0])
    if number <= 0:
        raise StageError(f"{key} in {path} is not above 0", HINT, [f"it is {number:g}"])
    return number
