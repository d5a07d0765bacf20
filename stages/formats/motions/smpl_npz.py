"""SMPL motions of other programs: arrays in .npz, .pkl and .pt, read only for the body's motion.

| family           | keys                                                                                  | metres        |
|------------------|---------------------------------------------------------------------------------------|---------------|
| AMASS            | poses [F,156] (SMPL-H), [F,165] (SMPL-X) or [F,72], trans, mocap_framerate            | yes           |
| HuMoR, SLAHMR    | root_orient, pose_body [F,63], trans, fps; of several people [P,F,...]                | yes           |
| SMPL-X           | global_orient, body_pose [F,63], transl, mocap_frame_rate, left_hand_pose [F,45]      | yes           |
| GVHMR            | smpl_params_global, with the same                                                     | yes           |
| WHAM             | by person: pose_world [F,72], trans_world                                             | yes           |
| AIST++           | smpl_poses [F,72], smpl_trans, smpl_scaling; 60 frames a second                       | trans/scaling |
| others           | poses [F,66] or [F,72], or global_orient, body_pose [F,69]; trans or transl; maybe fps | yes           |

SMPL-X's jaw and eyes are columns 66 to 75 of 165, or pose_jaw (jaw_pose) [F,3], pose_eye [F,6] or leye_pose and reye_pose; beside
them stands expression or expressions [F,E].

Sources: https://amass.is.tue.mpg.de, https://github.com/davrempe/humor, https://github.com/vye16/slahmr,
https://github.com/zju3dv/GVHMR, https://google.github.io/aistplusplus_dataset. None says which way is up: AMASS and HuMoR have
z up, AIST++ and GVHMR y, fits in a camera's frame -y.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import as_array, check_radians, checked, npz_names, read_npz, take
from stages.formats.body_model import SMPL
from stages.formats.budget import check_count
from stages.formats.face_turns import coefficients
from stages.formats.motions.rates import usual_rate
from stages.formats.poses import whose
from stages.formats.smplx_model import TAKEN
from stages.formats.tool_pickles import read_tool_file

HINT = (
    "an SMPL motion needs trans or transl [F,3] and poses [F,72] (AMASS: 156 or 165), or global_orient [F,3] (root_orient) "
    "and body_pose [F,63 or 69] (pose_body)"
)
BODY = 22  # joints that SMPL, SMPL-H and SMPL-X share; SMPL's two more are stiff hands
RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
AIST_FPS = 60.0
STEPS = ("trans", "transl", "smpl_trans", "trans_world")
WHOLE = ("poses", "smpl_poses", "pose_world")
ROOT, REST = ("global_orient", "root_orient"), ("body_pose", "pose_body")
WIDTHS = (72, 66, 156, 165)
FINGERS, WITH_FINGERS, WITH_FACE = 90, (156, 165), 165
WHOLE_HANDS, ONE_HAND = "pose_hand", ("left_hand_pose", "right_hand_pose")
FACE = {"pose_jaw": (0, 3), "jaw_pose": (0, 3), "pose_eye": (3, 9), "leye_pose": (3, 6), "reye_pose": (6, 9)}
"""Keys of jaw and eyes -> which of their nine angles they hold: jaw, left eye, right eye."""
EXPRESSIONS = ("expression", "expressions")
_MOTION = (*STEPS, *WHOLE, *ROOT, *REST, WHOLE_HANDS, *ONE_HAND, *FACE, *EXPRESSIONS, "smpl_scaling")
KEYS = (*_MOTION, *RATES, "body", "world_from_sfm")
"""All that is read: SMPL-X files of AMASS hold pickles too."""
FILES = (".npz", ".pkl", ".pt")


@dataclass(frozen=True)
class SmplMotion:
    """F poses as their file means them: `rotvecs` [F,24,3] rad, root first; `transl` [F,3] m, in the file's axes.

    `fps` frames a second, None where the file does not say. `notes` say what was left out. `body`: whose poses they are, as
    `formats.poses.whose` says. `hands` [F,2,15,3] rad are SMPL-H's or SMPL-X's fingers, 0 where they are flat, None without.
    `face` [F,K]: coefficients of SMPL-X's jaw and eyes, as FACE_NAMES, then of its first expressions; None where they stay at rest.
    """

    rotvecs: np.ndarray
    transl: np.ndarray
    fps: float | None
    notes: tuple[str, ...] = ()
    body: str = SMPL
    hands: np.ndarray | None = None
    face: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.transl)


def read_smpl_motion(path: Path) -> SmplMotion:
    """Read any of the families above; StageError with the key, what was found and what was wanted."""
    arrays, notes = _arrays(path)
    aist = "smpl_poses" in arrays
    key = _first(STEPS, arrays) or "trans"
    transl = checked(take(arrays, key, path, HINT), (None, 3), key, path, HINT).astype(np.float64)
    if not len(transl):
        raise StageError(f"{path} holds no frame", HINT, [f"{key} is 0x3"])
    check_count(len(transl), "poses", path)
    if aist:
        transl = transl / _positive(arrays, "smpl_scaling", path)
    poses, hands, more = _poses(arrays, len(transl), path)
    face, said = _face(arrays, len(transl), path)
    rate = _first(RATES, arrays)
    if rate:
        _positive(arrays, rate, path)
    fps = usual_rate(str(arrays[rate].reshape(-1)[0])) if rate else AIST_FPS if aist else None
    return SmplMotion(poses, transl, fps, (*notes, *more, *said), whose(arrays, path), hands, face)


def _first(keys: Iterable[str], arrays: Mapping[str, np.ndarray]) -> str | None:
    return next((key for key in keys if key in arrays), None)


def _arrays(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The arrays of one person's motion, by name, and what else the file holds, in words."""
    notes: tuple[str, ...] = ()
    if path.suffix.lower() == ".npz":
        arrays = read_npz(path, HINT, KEYS)
        if not arrays:
            raise StageError(
                f"{path} has no motion", HINT, [f"it holds {', '.join(npz_names(path)[:20]) or 'nothing'}"]
            )
    else:
        content = read_tool_file(path, HINT)
        content = content.get("smpl_params_global", content) if isinstance(content, Mapping) else {}
        people = list(content.values()) if all(isinstance(one, Mapping) for one in content.values()) else []
        if people:
            content, notes = people[0], _of_people(len(people))
        arrays = {str(key): as_array(value, str(key), path, HINT) for key, value in content.items()}
    steps = arrays.get(_first(STEPS, arrays) or "")
    if steps is not None and steps.ndim == 3 and len(steps):  # several people in arrays of one more axis
        notes = _of_people(len(steps))
        arrays |= {key: array[0] for key, array in arrays.items() if key in _MOTION and array.ndim > 1}
    return arrays, notes


def _of_people(count: int) -> tuple[str, ...]:
    return (f"it holds {count} people: the first is taken",) if count > 1 else ()


def _poses(
    arrays: Mapping[str, np.ndarray], count: int, path: Path
) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """All 24 rotation vectors [F,24,3], those of fingers [F,2,15,3], if there are any, and what was left out."""
    key, rest = _first(WHOLE, arrays) or "poses", _first(REST, arrays)
    if key not in arrays and rest:
        root = _first(ROOT, arrays) or ROOT[0]
        parts = _flat(arrays, root, count, (3,), path), _flat(arrays, rest, count, (69, 63), path)
        key, poses = rest, np.concatenate(parts, 1)
    else:
        poses = _flat(arrays, key, count, WIDTHS, path)
    width = poses.shape[1]
    kept = 24 if width == 72 else BODY
    whole = np.zeros((count, 24, 3))
    whole[:, :kept] = poses[:, : 3 * kept].reshape(count, kept, 3)
    check_radians(whole, key, path)
    hands = poses[:, -FINGERS:].reshape(count, 2, 15, 3) if width in WITH_FINGERS else _hands(arrays, count, path)
    if hands is not None:
        check_radians(hands.reshape(count, 30, 3), f"fingers of {key}", path)
    notes = []
    if hands is None and any(key in arrays for key in ONE_HAND):
        notes.append("fingers left out: they are no rotations of 15 bones a hand")
    elif hands is None and width == 66:
        notes.append("hands are not in it: held straight")
    return whole, hands, tuple(notes)


def _hands(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> np.ndarray | None:
    """Fingers [F,2,15,3] in arrays of their own: together, or one a hand; components (PCA) of MANO are none."""
    for keys, width in (((WHOLE_HANDS,), FINGERS), (ONE_HAND, FINGERS // 2)):
        if all(key in arrays and arrays[key].size == count * width for key in keys):
            parts = [_flat(arrays, key, count, (width,), path) for key in keys]
            return np.concatenate(parts, 1).reshape(count, 2, 15, 3)
    return None


def _face(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> tuple[np.ndarray | None, list[str]]:
    """Coefficients [F,K] of jaw, eyes and expressions, None where all are 0, and what of them was left out or held."""
    notes: list[str] = []
    turns, whole = np.zeros((count, 9)), arrays.get(_first(WHOLE, arrays) or "")
    if whole is not None and whole.size == count * WITH_FACE:
        turns = whole.reshape(count, -1)[:, 3 * BODY : -FINGERS].astype(np.float64)
    else:
        for key in (key for key in FACE if key in arrays):
            first, last = FACE[key]
            if arrays[key].size == count * (last - first):
                turns[:, first:last] = _flat(arrays, key, count, (last - first,), path)
            else:
                notes.append(f"{key} left out: it is no turn a frame")
    check_radians(turns.reshape(count, 3, 3), "jaw and eyes", path)
    face, beyond = coefficients(turns.reshape(count, 3, 3))
    if beyond:
        notes.append(f"{beyond} turns of jaw and eyes beyond those of a face are held there")
    if told := _first(EXPRESSIONS, arrays):
        if arrays[told].ndim == 2 and len(arrays[told]) == count:
            own = checked(arrays[told], (count, None), told, path, HINT)[:, :TAKEN]
            face = np.concatenate([face, own.astype(np.float64)], 1)
        else:
            notes.append(f"{told} left out: it is no row a frame")
    return (face if face.any() else None), notes


def _flat(arrays: Mapping[str, np.ndarray], key: str, count: int, widths: tuple[int, ...], path: Path) -> np.ndarray:
    """Rotation vectors [F,J,3] or [F,3J] as float64 [F,3J], where 3J is one of `widths`."""
    array = take(arrays, key, path, HINT)
    flat = array.reshape(len(array), -1) if array.ndim == 3 and len(array) and array.size else array
    width = flat.shape[1] if flat.ndim == 2 and flat.shape[1] in widths else widths[0]
    return checked(flat, (count, width), key, path, HINT).astype(np.float64)


def _positive(arrays: Mapping[str, np.ndarray], key: str, path: Path) -> float:
    value = take(arrays, key, path, HINT)
    number = float(checked(value.reshape(-1), (1,), key, path, HINT)[0])
    if number <= 0:
        raise StageError(f"{key} in {path} is not above 0", HINT, [f"it is {number:g}"])
    return number
