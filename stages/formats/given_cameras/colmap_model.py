"""A COLMAP model, binary or text: the pictures of a folder with their lenses, poses and points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.given_cameras import colmap_binary, colmap_text
from stages.formats.given_cameras.colmap_text import HINT
from stages.formats.given_cameras.record import GivenCameras, checked_pose, one_size
from stages.formats.kinds import names_in

FILES = ("cameras", "images", "points3D")


def is_model(folder: Path) -> bool:
    """True if the folder holds the pictures of a model."""
    return any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap(folder: Path) -> GivenCameras:
    """Read a model's three files, the binary ones where both are there, in the order of the pictures' names.

    StageError with file and line or byte for what cannot be read, with the picture's name for an invalid pose, and
    for pictures of several sizes.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    reader = colmap_binary if suffix == ".bin" else colmap_text
    paths = [folder / f"{name}{suffix}" for name in FILES]
    missing = [path.name for path in paths if not path.is_file()]
    if missing:
        found = names_in(folder) if folder.is_dir() else "no such folder"
        raise StageError(f"the COLMAP model in {folder} lacks {', '.join(missing)}", HINT, [f"found: {found}"])
    lenses = reader.lens_rows(paths[0])
    images = sorted(reader.picture_rows(paths[1]), key=lambda image: image[3])
    if not images:
        raise StageError(f"no picture has a camera in {paths[1]}", HINT, ["it lists 0 pictures"])
    lost = [image for image in images if image[2] not in lenses]
    if lost:
        facts = [f"{len(lost)} of {len(images)} pictures; first {lost[0][3]} with camera {lost[0][2]}"]
        raise StageError(f"{paths[0]} lacks cameras that {paths[1].name} names", HINT, facts)
    used = [lenses[image[2]] for image in images]
    one_size(used, folder)
    row = {image[0]: i for i, image in enumerate(images)}
    points = list(reader.point_rows(paths[2]))
    values = np.array([numbers for numbers, _ in points], np.float64).reshape(-1, 7)
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values).all(1))
        fact = f"{len(bad)} of {len(values)} points, first: {' '.join(f'{value:g}' for value in values[bad[0]])}"
        raise StageError(f"{paths[2]} has points that are not finite", HINT, [fact])
    return GivenCameras(
        source=f"COLMAP model ({suffix[1:]})",
        files=tuple(image[3] for image in images),
        viewmats=np.stack([_viewmat(pose, f"{name} in {paths[1]}") for _, pose, _, name in images]),
        lenses=tuple(used),
        points=values[:, :3],
        colors=values[:, 3:6].astype(np.uint8),
        errors=values[:, 6],
        tracks=tuple(np.array([row[i] for i in dict.fromkeys(seen) if i in row], np.int64) for _, seen in points),
    )


def _viewmat(pose: np.ndarray, what: str) -> np.ndarray:
    """camera_from_world [4,4] of a quaternion w x y z of any length but 0, and a translation."""
    w, x, y, z = pose[:4] / (np.linalg.norm(pose[:4]) or np.nan)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = pose[4:]
    return checked_pose(viewmat, what, HINT)
