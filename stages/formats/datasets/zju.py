"""A sequence of ZJU-MoCap, as NeuralBody (Peng et al., CVPR 2021) lays it out.

annots.npy                   cams: K, R, T (millimetres), D of each camera; ims: the pictures of each moment, by camera
Camera_B1/000000.jpg ...     pictures, distorted as D says; paths as annots.npy names them
mask/, mask_cihp/            the same paths, .png: not 0 = person; both together, or either
new_params/, params/         <number>.npy: Rh, Th, poses, shapes; the number is that in the picture's name, which
                             counts from 1 in the subjects 313 and 315
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import as_array, checked, take
from stages.formats.datasets.capture import Capture, Shot, require
from stages.formats.given_masks.values import read_values
from stages.formats.images import read_pixels
from stages.formats.tool_pickles import read_named

MASKS = ("mask", "mask_cihp")
PARAMS = ("new_params", "params")
HINT = "unpack the sequence again: a CoreView folder with annots.npy, the pictures, masks and params"
NUMBER = re.compile(r"_(\d{4,})(?:_|$)")


def check_folder(folder: Path) -> None:
    """StageError for what is not the folder of a sequence."""
    require(folder, ("annots.npy",), "a ZJU-MoCap sequence", "zju")


def read_zju(folder: Path, train_camera: int, train_frames: int, test_every: int) -> Capture:
    """Read the first `train_frames` moments of one camera to train on, and every `test_every`-th from all others.

    Raises StageError for what is missing or does not fit; no code of a pickle is run.
    """
    check_folder(folder)
    annots = read_named(folder / "annots.npy", HINT)
    paths = [_row(folder, i, row) for i, row in enumerate(take(annots, "ims", folder / "annots.npy", HINT))]
    if not paths:
        raise StageError(f"annots.npy in {folder} lists no pictures", HINT)
    views = _cameras(folder / "annots.npy", take(annots, "cams", folder / "annots.npy", HINT))
    count = min(len(views[0]), min(map(len, paths)))
    if not 0 <= train_camera < count:
        hint = "choose one with `--set frames.train_camera=N`; the first is 0"
        raise StageError(f"there is no camera {train_camera} in {folder.name}", hint, [f"it has 0 to {count - 1}"])
    chosen = [
        (moment, camera)
        for moment in range(min(train_frames, len(paths)))
        for camera in (train_camera, *(c for c in range(count) if c != train_camera and moment % test_every == 0))
    ]
    masks = [kind for kind in MASKS if (folder / kind).is_dir()]
    shots = tuple(
        Shot(
            source=f"{camera:02d}_{number(paths[moment][camera]):06d}",
            image=folder / paths[moment][camera],
            masks=tuple((folder / kind / paths[moment][camera]).with_suffix(".png") for kind in masks),
            moment=moment,
            split="train" if camera == train_camera else "heldout",
        )
        for moment, camera in chosen
    )
    _check_files(folder, shots, masks)
    picked = [camera for _, camera in chosen]
    height, width = read_pixels(shots[0].image).shape[:2]
    rule = (
        f"The split of HumanNeRF: camera {train_camera + 1} is trained on ({min(train_frames, len(paths))} moments), "
        f"all others are measured at every {test_every}th of these moments."
    )
    return Capture(
        dataset="zju",
        sequence=folder.resolve().name,
        rule=rule,
        shots=shots,
        viewmats=views[0][picked],
        Ks=views[1][picked],
        lenses=views[2][picked],
        width=width,
        height=height,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        fit=_fit(folder, [number(paths[moment][camera]) for moment, camera in chosen]),
        person=_person,
    )


def number(path: str) -> int:
    """The number of a picture's moment in its name: 000012.jpg, or CoreView_313_Camera_(1)_0013_2019-08-23.jpg."""
    stem = PurePosixPath(path).stem
    found = [stem] if stem.isdigit() else NUMBER.findall(stem)
    if not found:
        raise StageError(f"the picture {path} has no number in its name", HINT)
    return int(found[0])


def _row(folder: Path, i: int, row: Any) -> list[str]:
    """The paths of one moment, one a camera, all inside the folder."""
    try:
        paths = [str(path).replace("\\", "/") for path in row["ims"]]
    except (TypeError, KeyError, IndexError) as error:
        raise StageError(f"ims[{i}] in annots.npy of {folder.name} lists no pictures", HINT, [repr(error)]) from error
    outside = [path for path in paths if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts]
    if outside:
        raise StageError(f"annots.npy of {folder.name} names a file outside the folder", HINT, [outside[0]])
    return paths


def _cameras(path: Path, cams: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """viewmats [N,4,4] in metres, Ks [N,3,3] with the first pixel's centre at (0.5, 0.5), distortion [N,5]."""
    if not isinstance(cams, dict):
        raise StageError(f"cams in {path} is not named arrays", HINT, [f"it is a {type(cams).__name__}"])
    count = len(take(cams, "K", path, HINT))

    def get(key: str, *shape: int) -> np.ndarray:
        try:
            values = np.array([np.asarray(one, np.float64) for one in take(cams, key, path, HINT)])
            values = values.reshape(len(values), *shape)
        except (ValueError, TypeError) as error:
            raise StageError(f"cams {key} in {path} has the wrong shape", HINT, [str(error)]) from error
        return checked(values, (count, *shape), f"cams {key}", path, HINT)

    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = get("R", 3, 3)
    viewmats[:, :3, 3] = get("T", 3) / 1000
    Ks = get("K", 3, 3).copy()
    Ks[:, :2, 2] += 0.5  # OpenCV counts pixel centres at whole numbers
    return viewmats, Ks, get("D", 5)


def _check_files(folder: Path, shots: tuple[Shot, ...], masks: list[str]) -> None:
    if not masks:
        raise StageError(f"{folder} has no masks", HINT, [f"looked for {' and '.join(MASKS)}"])
    gone = [shot.image for shot in shots if not shot.image.is_file()]
    gone += [shot.masks[0] for shot in shots if not any(path.is_file() for path in shot.masks)]
    if gone:
        facts = [f"of {len(shots)} pictures and their masks; first {gone[0].relative_to(folder)}"]
        raise StageError(f"{len(gone)} files that annots.npy needs are not in {folder}", HINT, facts)


def _person(shot: Shot) -> np.ndarray:
    """All masks of a picture in one: what any of them marks is the person."""
    found = [read_values(path)[0] > 0 for path in shot.masks if path.is_file()]
    if len({mask.shape for mask in found}) > 1:
        sizes = " and ".join(f"{mask.shape[1]}x{mask.shape[0]}" for mask in found)
        raise StageError(f"the masks of {shot.image} have different sizes", HINT, [sizes])
    return np.where(np.any(found, 0), 255, 0).astype(np.uint8)


def _fit(folder: Path, numbers: list[int]) -> dict[str, np.ndarray]:
    """Rh, Th, poses and betas of each shot, and whose poses they are, where they say so.

    Moments that several cameras saw are read once.
    """
    kind = next((name for name in PARAMS if (folder / name).is_dir()), None)
    if kind is None:
        raise StageError(f"{folder} has no body poses", HINT, [f"looked for {' and '.join(PARAMS)}"])
    rows: dict[int, dict[str, np.ndarray]] = {}
    for n in dict.fromkeys(numbers):
        path = folder / kind / f"{n}.npy"
        values = read_named(path, HINT)
        rows[n] = {}
        for key, size in (("Rh", 3), ("Th", 3), ("poses", 72), ("shapes", 10)):
            array = as_array(take(values, key, path, HINT), key, path, HINT)
            rows[n][key] = checked(array.reshape(-1), (size,), key, path, HINT).astype(np.float64)
    named = (("Rh", "Rh"), ("Th", "Th"), ("poses", "poses"), ("shapes", "betas"))
    told = {"body": np.asarray(values["body"])} if "body" in values else {}
    return {to: np.stack([rows[n][key] for n in numbers]) for key, to in named} | told
