"""Given masks, whichever program stored them: recognizes the layout and returns a MaskSet.

| layout                                                     | joined by                | objects                     |
|------------------------------------------------------------|--------------------------|-----------------------------|
| folder of pictures or .npy, one a frame                    | name or number           | labels, palette or colours  |
| folder of such folders, one an object (SAM 2, SA-V)        | name or number           | the folders' names          |
| .npz with an array a frame                                 | the arrays' names        | labels                      |
| .npy or .npz with a stack [N,H,W]                          | names in it, else order  | labels                      |
| COCO .json, RLE or polygons                                | file_name                | track_id, else followed     |
| video                                                      | order                    | none                        |

By order only where there are exactly as many masks as the video has frames.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.frame_names import ENDINGS, stem, without_word
from stages.formats.given_masks.coco import read_coco
from stages.formats.given_masks.mask_set import MaskSet, Values, check_one_per_frame
from stages.formats.given_masks.stacks import read_stack
from stages.formats.given_masks.values import mask_files, read_values
from stages.formats.kinds import kind_of
from stages.formats.pictures import beside_pictures, natural_order
from stages.formats.video import decode, probe

HINT = (
    "`--masks` takes a folder of masks (or of a folder for each object), a .npy or .npz stack, a COCO .json, or a video"
)


def read_mask_files(path: Path, frames: range, film: str) -> MaskSet:
    """Recognise masks of another program; `frames` is how many the video `film` can have. StageError for anything else."""
    if path.is_dir():
        return folder_of_masks(path)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return read_stack(path, frames, film)
    if suffix == ".json":
        return read_coco(path)
    if suffix in ENDINGS:
        raise StageError(f"{path} is one mask", "give the folder that holds one mask per frame", [f"a {suffix} file"])
    if (kind := kind_of(path)) and kind.what != "text":
        raise StageError(f"{path} is {kind}, and holds no masks", HINT)
    return mask_video(path, frames, film)


def folder_of_masks(folder: Path) -> MaskSet:
    """Files in a folder, or in its folders, each of which is an object; a single inner folder is looked into."""
    inner = sorted((p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")), key=natural_order)
    if any(p.suffix.lower() in ENDINGS and not p.name.startswith(".") for p in folder.iterdir()) or not inner:
        files = mask_files(folder)
        files = beside_pictures(files) or files
        names = tuple(without_word([stem(file) for file in files]))
        return MaskSet("folder of masks", names, ("",), lambda _, i: read_values(files[i]))
    if len(inner) == 1:
        return folder_of_masks(inner[0])
    found = {one.name: {stem(file): file for file in mask_files(one)} for one in inner}
    names = tuple(sorted({name for files in found.values() for name in files}))

    def read(person: str, i: int) -> Values | None:
        file = found[person].get(names[i])
        return read_values(file) if file else None

    return MaskSet(f"folder for each of {len(inner)} objects", names, tuple(found), read)


def mask_video(path: Path, frames: range, film: str) -> MaskSet:
    """A video of masks, frame by frame those of the clip; StageError if it has another number of frames."""
    info = probe(path)
    count = sum(1 for _ in decode(path)) if len(frames) == 1 else info.frames  # as exact as the clip's own is known
    check_one_per_frame(count, frames, f"{path} ({info.duration_s:.2f} s at {info.fps:.2f} frames/s)", film)
    frames_left, at, values = decode(path), -1, np.zeros((0, 0), np.uint8)

    def read(_: str, i: int) -> Values:
        nonlocal frames_left, at, values
        if i < at:
            frames_left, at = decode(path), -1
        while at < i:
            at, _time, pixels = next(frames_left)
            values = pixels.max(2)
        return values, "video"

    return MaskSet("video of masks", None, ("",), read)
