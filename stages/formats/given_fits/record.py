"""The record that every reader of SMPL fits returns, and the checks that readers share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.arrays import check_radians, checked, take
from stages.formats.body_model import SMPL
from stages.formats.images import same_shape

SMPLX_PELVIS = np.array([0.003123, -0.351407, 0.012037])
"""Where the neutral SMPL-X body of mean shape has its pelvis, in m; SMPL's is elsewhere, and each turns about its own."""
FAR = 1e9
"""Focal length in px that stands for weak perspective: a camera so far away that depth does not matter."""
OTHER_SHAPE = "the shape numbers are those of {}, which SMPL reads as nearly the same shape"
_SHARED = ("path", "tool", "pelvis", "body", "notes")


@dataclass(frozen=True)
class SmplFit:
    """N poses, rotation vectors in radians, X = SMPL(betas, global_orient, body_pose) + transl in metres.

    In each frame's camera (x right, y down, z forward); or with `scale` [N] in the world: X_sfm = scale SMPL + transl
    in SfM units. `focal` [N] and `center` [N,2] are the tool's camera in px of our pictures, None where it is ours.

    Rows belong to frames by the pictures' `names`, by `numbers` [N] of frames in the video (from 0) or by `times` [N] s;
    with none of these, row i is frame number i. `tracks` tell several people apart; rows of one frame in one track are
    different people too. `turns` [N,3]: rotation vectors, part of `global_orient`, by which the posed body was turned
    about the origin instead of its pelvis. `pelvis` [3] is the rest pelvis about which the tool's own body turns, where
    it is not SMPL's; `offset` [N,3] m, turned as `global_orient` is, leads from there to the pelvis of our body, where that
    is another point. `points` [N,33,3] m are BlazePose's points in the camera, of which the pose is yet to be made. `joints2d`
    [N,24,2] px is where the tool itself sees SMPL's joints, NaN where it does not say.
    `body` is whose poses they are: SMPL's, those of another body by its name, or "" for the body of this run, whichever
    that is. `notes` say what was left out or simplified.
    """

    path: str
    tool: str
    betas: np.ndarray
    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    scale: np.ndarray | None = None
    names: tuple[str, ...] | None = None
    numbers: np.ndarray | None = None
    times: np.ndarray | None = None
    tracks: tuple[str, ...] | None = None
    focal: np.ndarray | None = None
    center: np.ndarray | None = None
    turns: np.ndarray | None = None
    pelvis: np.ndarray | None = None
    offset: np.ndarray | None = None
    joints2d: np.ndarray | None = None
    points: np.ndarray | None = None
    body: str = SMPL
    notes: tuple[str, ...] = ()
    what: ClassVar[str] = "poses"

    def __len__(self) -> int:
        return len(self.transl)

    def rows(self, rows: Sequence[int]) -> SmplFit:
        """The same fit with only these rows."""
        each = _per_row(self).items()
        taken: dict[str, Any] = {
            n: v[list(rows)] if isinstance(v, np.ndarray) else tuple(v[i] for i in rows) for n, v in each
        }
        return replace(self, **taken)


def _per_row(fit: SmplFit) -> dict[str, Any]:
    """What a fit has for each row."""
    every = {field.name: getattr(fit, field.name) for field in fields(SmplFit) if field.name not in _SHARED}
    return {name: values for name, values in every.items() if values is not None}


def join_fits(fits: Sequence[SmplFit], path: str) -> SmplFit:
    """The rows of all `fits` of one tool in one; StageError naming `path` if there are none."""
    if not fits:
        raise StageError(f"{path} holds no poses", "let the tool run again: it found nobody")
    each = [_per_row(fit) for fit in fits]
    parts: dict[str, Any] = {
        name: np.concatenate([one[name] for one in each])
        if isinstance(values, np.ndarray)
        else tuple(value for one in each for value in one[name])
        for name, values in each[0].items()
    }
    notes = tuple(dict.fromkeys(note for fit in fits for note in fit.notes))
    return replace(fits[0], **parts, path=path, notes=notes)


@dataclass(frozen=True)
class Fields:
    """Named values of one file, or of one person in it; `where` and `hint` are what errors say."""

    values: Mapping[str, Any]
    where: str
    hint: str

    def __post_init__(self) -> None:
        if not isinstance(self.values, Mapping):
            raise StageError(f"{self.where} holds no named values", self.hint, [f"it is {_kind(self.values)}"])

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def take(self, key: str) -> Any:
        """The value of that name; StageError listing the names there are."""
        return take({str(k): v for k, v in self.values.items()}, key, self.where, self.hint)

    def array(self, key: str) -> np.ndarray:
        """The value of that name as an array of numbers."""
        value = self.take(key)
        try:
            array = np.asarray(value)
        except ValueError:
            array = np.empty(0, object)
        if array.dtype.kind not in "fiub":
            raise StageError(f"{key} in {self.where} does not hold numbers", self.hint, [f"it is {_kind(value)}"])
        return array

    def get(self, key: str, *shape: int | None) -> np.ndarray:
        """A float64 array of finite numbers of that shape (None: any length)."""
        return checked(self.array(key), shape, key, self.where, self.hint).astype(np.float64)

    def count(self, key: str) -> int:
        """How many rows the array `key` has; StageError if none."""
        array = self.array(key)
        if array.ndim < 2 or not len(array):
            raise StageError(f"{key} in {self.where} has no rows", self.hint, [f"its shape is {array.shape}"])
        return len(array)

    def rotations(self, key: str, count: int, joints: int) -> np.ndarray:
        """Rotation vectors [count, 3 joints] from vectors in radians or from matrices, in any shape that has them in order."""
        array = self.array(key)
        size = array.size // max(count, 1)
        if array.shape[:1] == (count,) and array.shape[-2:] == (3, 3) and size == joints * 9:
            return self._from_matrices(checked(array, array.shape, key, self.where, self.hint), key, joints)
        flat = array.reshape(count, -1) if array.ndim == 3 and array.shape[0] == count else array
        flat = checked(flat, (count, joints * 3), key, self.where, self.hint).astype(np.float64)
        check_radians(flat.reshape(count, joints, 3), key, self.where)
        return flat

    def _from_matrices(self, array: np.ndarray, key: str, joints: int) -> np.ndarray:
        matrices = array.reshape(-1, joints, 3, 3).astype(np.float64)
        off = np.abs(matrices @ matrices.mT - np.eye(3)).max((-1, -2))
        off = np.maximum(off, np.abs(np.linalg.det(matrices) - 1))
        if off.max() > 1e-2:
            row, joint = (int(i) for i in np.unravel_index(off.argmax(), off.shape))
            determinant = np.linalg.det(matrices[row, joint])
            facts = [f"row {row}, joint {joint}: off by {off.max():.3g}, determinant {determinant:.3g}"]
            raise StageError(f"{key} in {self.where} holds matrices that are not rotations", self.hint, facts)
        return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(-1, joints * 3)

    def betas(self, key: str, count: int) -> np.ndarray:
        """Ten shape numbers a row [count,10], of a file with one row for all or one each; further ones are left out."""
        betas = np.atleast_2d(self.array(key))
        rows = count if len(betas) == count else 1
        if betas.ndim == 2 and betas.shape[1] > 10:
            betas = betas[:, :10]
        betas = checked(betas, (rows, 10), key, self.where, self.hint).astype(np.float64)
        return np.broadcast_to(betas, (count, 10)).copy()


def _kind(value: Any) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"


def same_picture(theirs: np.ndarray, ours: tuple[int, int], where: str, hint: str) -> np.ndarray:
    """Factor [N] from the tool's px to ours; `theirs` [N,2] are its pictures' (width, height).

    StageError if their shape is another, or no size at all.
    """
    theirs = np.asarray(theirs, np.float64)
    if not (theirs > 0).all():
        raise StageError(f"{where} was made from pictures without a size", hint, [f"found {theirs.min():g}"])
    strange = [size for size in theirs if not same_shape(size, ours)]
    if strange:
        facts = [f"theirs are {strange[0][0]:g}x{strange[0][1]:g}, ours {ours[0]}x{ours[1]}"]
        raise StageError(f"{where} was made from pictures of another shape", "run the tool on this very video", facts)
    return ours[0] / theirs[:, 0]
