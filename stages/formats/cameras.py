"""cameras.npz: the pose and pinhole lens of each frame's camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz
from stages.formats.budget import Budget
from stages.formats.facts import is_file_name
from stages.records import Cameras

LARGEST_SIDE = 1 << 16  # px
PIXEL = 12  # bytes of a drawn pixel: three floats


def write_cameras(path: Path, cameras: Cameras) -> None:
    """Write `cameras` as .npz without pickles."""
    np.savez(
        path,
        names=np.array(cameras.names, dtype=np.str_),
        viewmats=np.asarray(cameras.viewmats, dtype=np.float64),
        Ks=np.asarray(cameras.Ks, dtype=np.float64),
        width=np.int64(cameras.width),
        height=np.int64(cameras.height),
    )


def read_cameras(path: Path) -> Cameras:
    """Read a cameras.npz and check it; `names` may be absent (a user's camera path) and are then 000000, 000001 ...

    Raises StageError with the offending key, shape or camera.
    """
    hint = "cameras need viewmats [C,4,4] (camera from world, OpenCV axes), Ks [C,3,3] in px, width and height"
    arrays = read_npz(path, hint)
    missing = sorted({"viewmats", "Ks", "width", "height"} - arrays.keys())
    if missing:
        raise StageError(f"{path} has no {', '.join(missing)}", hint, [f"it holds {', '.join(sorted(arrays))}"])
    viewmats, Ks = arrays["viewmats"], arrays["Ks"]
    count = len(np.atleast_1d(viewmats))
    if viewmats.shape != (count, 4, 4) or Ks.shape != (count, 3, 3) or count == 0:
        raise StageError(f"wrong shapes in {path}", hint, [f"viewmats {viewmats.shape}, Ks {Ks.shape}"])
    if not {viewmats.dtype.kind, Ks.dtype.kind} <= set("fiu"):
        raise StageError(f"{path} does not hold numbers", hint, [f"viewmats {viewmats.dtype}, Ks {Ks.dtype}"])
    viewmats, Ks = viewmats.astype(np.float64), Ks.astype(np.float64)
    names = arrays.get("names", np.array([f"{i:06d}" for i in range(count)]))
    if names.shape != (count,) or len(set(names.tolist())) != count:
        raise StageError(f"the {names.size} names in {path} do not name its {count} cameras one by one", hint)
    unfit = [str(name) for name in names if not is_file_name(str(name))]
    if unfit:
        raise StageError(f"a camera name in {path} cannot be a file name", hint, [f"found {unfit[0]!r}"])
    _check_values(path, viewmats, Ks, hint)
    width, height = (int(checked(arrays[key], (), key, path, hint)) for key in ("width", "height"))
    if not 0 < min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise StageError(f"{path} has an impossible picture size", hint, [f"{width}x{height} px"])
    Budget(path).spend(width * height * PIXEL, f"a picture of {width}x{height} px")
    return Cameras(
        names=tuple(str(name) for name in names),
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
    )


def _check_values(path: Path, viewmats: np.ndarray, Ks: np.ndarray, hint: str) -> None:
    finite = np.isfinite(viewmats).all((1, 2))
    rotation = np.where(finite[:, None, None], viewmats, np.eye(4))[:, :3, :3]
    off = np.abs(rotation @ rotation.mT - np.eye(3)).max((1, 2))
    off = np.maximum(off, np.abs(np.linalg.det(rotation) - 1))
    off = np.maximum(off, np.abs(viewmats[:, 3] - [0, 0, 0, 1]).max(1))
    bad = ~finite | ~(off < 1e-4)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        det = np.linalg.det(viewmats[i, :3, :3])
        fact = f"off by {off[i]:.2g}, determinant {det:.4g}: viewmat = {viewmats[i].tolist()}"
        raise StageError(f"camera {i} of {path} is not a rotation and a translation", hint, [fact])
    bad = ~np.isfinite(Ks).all((1, 2)) | ~(Ks[:, 0, 0] > 0) | ~(Ks[:, 1, 1] > 0)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise StageError(f"camera {i} of {path} has no usable focal length", hint, [f"K = {Ks[i].tolist()}"])
    rest = np.abs(Ks - np.eye(3))[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]].max(1)
    if not (rest < 1e-6 * Ks[:, 0, 0]).all():
        i = int(rest.argmax())
        fact = f"K = {Ks[i].tolist()}, wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        raise StageError(f"camera {i} of {path} has a skewed or transposed K", hint, [fact])
