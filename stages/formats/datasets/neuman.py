"""A sequence of the NeuMan data set (Jiang et al., ECCV 2022) with the 4D-Humans fit that HUGS added to it.

images/00000.png ...                             pictures, already without distortion
sparse/*.txt                                     COLMAP's text model, in SfM units
4d_humans/sam_segmentations/*.png                255 = person; the i-th in natural order belongs to the i-th picture
segmentations/                                   used without those: 0 = person, joined by name
4d_humans/smpl_optimized_aligned_scale.npz       the i-th row belongs to the i-th picture: X_sfm = scale SMPL + transl
train_split.txt val_split.txt test_split.txt     names of pictures, a line each; used if the test's is there
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npz
from stages.formats.datasets.capture import Capture, Purpose, Shot, require
from stages.formats.frame_names import stem
from stages.formats.given_cameras.colmap_model import read_colmap
from stages.formats.given_cameras.record import GivenCameras, possible_errors
from stages.formats.given_masks.values import mask_files, read_values
from stages.formats.pictures import picture_files

FIT = "4d_humans/smpl_optimized_aligned_scale.npz"
SAM, DETECTED = "4d_humans/sam_segmentations", "segmentations"
FIT_KEYS = ("global_orient", "body_pose", "betas", "transl", "scale")
Row = TypeVar("Row", Path, int)
HINT = "unpack the sequence again, with the 4d_humans folder of HUGS's archive"
PAPER_RULE = "The split of HUGS: every 5th frame is held out, of these the first half is measured."
FILE_RULE = "The split of the data set's own files: test_split.txt is measured, train_split.txt trained on."


def check_folder(folder: Path) -> None:
    """StageError for what is not the folder of a sequence."""
    require(folder, ("images", "sparse", FIT), "a NeuMan sequence", "neuman")


def read_neuman(folder: Path) -> Capture:
    """Read a sequence; StageError for what is missing, and where masks or poses do not belong to the pictures."""
    check_folder(folder)
    model = read_colmap(folder / "sparse")
    files = picture_files(folder / "images")
    have = {file.name: file for file in files}
    gone = [name for name in model.files if name not in have]
    if gone:
        fact = f"first: {gone[0]}; images/ has {len(files)}"
        raise StageError(f"{len(gone)} of {len(model.files)} pictures of sparse/ are not in images/", HINT, [fact])
    masks, inverted = _masks(folder, model, files)
    split, rule = _split(folder, model.files)
    shots = tuple(
        Shot(Path(name).stem, have[name], (masks[name],), i, split[name]) for i, name in enumerate(model.files)
    )

    def person(shot: Shot) -> np.ndarray:
        values = read_values(shot.masks[0])[0]
        mask = values.astype(np.uint8) if values.dtype == np.uint8 else np.where(values > 0, 255, 0).astype(np.uint8)
        return 255 - mask if inverted else mask

    off = possible_errors(model.errors, model.lenses[0].width, model.lenses[0].height)
    error = float(off.mean()) if len(off) else None
    facts = {"reprojection_px": error, "median_triangulation_deg": model.median_triangulation_deg()}
    return Capture(
        dataset="neuman",
        sequence=folder.resolve().name,
        rule=rule,
        shots=shots,
        viewmats=model.viewmats,
        Ks=np.stack([lens.K for lens in model.lenses]),
        lenses=np.stack([np.pad(lens.distortion, (0, 5))[:5] for lens in model.lenses]),
        width=model.lenses[0].width,
        height=model.lenses[0].height,
        points=model.points,
        colors=model.colors,
        fit=_fit(folder / FIT, model, files),
        person=person,
        facts=facts,
    )


def paper_split(count: int) -> tuple[list[int], list[int]]:
    """HUGS's split of `count` frames: those that it measures, and those that it does not use."""
    stride = count // max(count // 5, 1)
    apart = list(range(count))[stride // 2 :: stride]
    return apart[: len(apart) // 2], apart[len(apart) // 2 :]


def _split(folder: Path, names: tuple[str, ...]) -> tuple[dict[str, Purpose], str]:
    """File name -> train, heldout or unused, and the rule in words."""
    if not (folder / "test_split.txt").is_file():
        test, unused = paper_split(len(names))
        apart: dict[str, Purpose] = {names[i]: "heldout" for i in test}
        apart |= {names[i]: "unused" for i in unused}
        return {name: apart.get(name, "train") for name in names}, PAPER_RULE
    by_stem = {Path(name).stem: name for name in names}
    listed = {kind: _listed(folder / f"{kind}_split.txt", by_stem) for kind in ("train", "val", "test")}
    both = sorted(set(listed["train"] or ()) & set(listed["test"] or ()))
    if both:
        facts = [f"{len(both)} pictures, first {both[0]}"]
        raise StageError(f"train_split.txt and test_split.txt in {folder} name the same pictures", HINT, facts)
    others: Purpose = "train" if listed["train"] is None else "unused"
    found = dict.fromkeys(names, others)
    goals: dict[str, Purpose] = {"train": "train", "val": "unused", "test": "heldout"}
    for kind, goal in goals.items():
        found |= dict.fromkeys(listed[kind] or (), goal)
    return found, FILE_RULE


def _listed(path: Path, by_stem: dict[str, str]) -> list[str] | None:
    """The registered pictures that a file names, or None without the file."""
    if not path.is_file():
        return None
    try:
        names = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    stems = [Path(name.strip()).stem for name in names if name.strip()]
    unknown = [name for name in stems if name not in by_stem]
    if unknown:
        facts = [f"{len(unknown)} of {len(stems)}, first {unknown[0]}"]
        raise StageError(f"{path} names pictures that sparse/ does not have", HINT, facts)
    return [by_stem[name] for name in stems]


def _masks(folder: Path, model: GivenCameras, files: list[Path]) -> tuple[dict[str, Path], bool]:
    """File name of each registered picture -> its mask file; and whether those masks mark the background."""
    if (folder / SAM).is_dir():
        found = mask_files(folder / SAM)
        return _in_order(found, model, files, f"masks in {folder / SAM}"), False
    by_stem = {stem(file): file for file in mask_files(folder / DETECTED)}
    missing = [name for name in model.files if Path(name).stem not in by_stem]
    if missing:
        facts = [f"{len(missing)} of {len(model.files)}, first {missing[0]}"]
        raise StageError(f"{folder / DETECTED} lacks masks of pictures", HINT, facts)
    return {name: by_stem[Path(name).stem] for name in model.files}, True


def _fit(path: Path, model: GivenCameras, files: list[Path]) -> dict[str, np.ndarray]:
    """The arrays of the fit, a row for each registered picture; and whose poses they are, where it says so."""
    arrays = read_npz(path, HINT)
    missing = [key for key in FIT_KEYS if key not in arrays]
    if missing:
        raise StageError(f"{path} has no {', '.join(missing)}", HINT, [f"it holds {', '.join(sorted(arrays))}"])
    count = len(np.atleast_1d(arrays["transl"]))
    rows = _in_order(list(range(count)), model, files, f"poses in {path}")
    order = [rows[name] for name in model.files]
    whole = arrays["betas"].ndim < 2 or len(arrays["betas"]) == 1 != count
    fit = {key: arrays[key] if key == "betas" and whole else arrays[key][order] for key in FIT_KEYS}
    return fit | {key: arrays[key] for key in ("body",) if key in arrays}


def _in_order(rows: list[Row], model: GivenCameras, files: list[Path], what: str) -> dict[str, Row]:
    """Registered picture -> its row, where the i-th row belongs to the i-th picture of images/, or to the i-th of sparse/."""
    for names in ([file.name for file in files], list(model.files)):
        if len(rows) == len(names):
            return dict(zip(names, rows))
    facts = [f"images/ has {len(files)}, sparse/ {len(model.files)}"]
    raise StageError(f"{len(rows)} {what} belong to no set of pictures", HINT, facts)
