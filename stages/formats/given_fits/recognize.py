"""SMPL fits of other programs: recognizes the program by the content and reads its poses.

| tool              | what to give                                             | poses of  | read by          |
|-------------------|----------------------------------------------------------|-----------|------------------|
| 4D-Humans, PHALP  | results/demo_VIDEO.pkl                                   | everybody | people.py        |
| ROMP, simple-romp | video_results.npz, VIDEO_results.npz, a folder of .npz   | everybody | people.py        |
| WHAM              | wham_output.pkl                                          | everybody | video.py         |
| GVHMR             | hmr4d_results.pt                                         | one       | video.py         |
| TRAM              | the folder with camera.npy and hps/                      | everybody | video.py         |
| PromptHMR         | results.pkl                                              | everybody | video.py         |
| SAM 3D Body       | what process_one_image returned, saved by whatever means | everybody | mhr.py           |
| EasyMocap         | the folder of .json                                      | everybody | easymocap.py     |
| plain, AMASS, ... | .npz of arrays                                           | one       | npz.py           |
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.given_fits.easymocap import read_easymocap
from stages.formats.given_fits.mhr import is_mhr, read_mhr
from stages.formats.given_fits.npz import TRANSL, read_plain
from stages.formats.given_fits.people import read_phalp, read_romp
from stages.formats.given_fits.record import SmplFit, join_fits
from stages.formats.given_fits.video import read_gvhmr, read_prompthmr, read_tram, read_wham
from stages.formats.kinds import names_in
from stages.formats.tool_pickles import read_tool_file

HINT = (
    "a fit is an .npz with betas, global_orient, body_pose and transl, or what 4D-Humans, ROMP, WHAM, GVHMR, TRAM, "
    "PromptHMR, SAM 3D Body or EasyMocap wrote"
)
WHOLE = ("hmr4d_results.pt", "wham_output.pkl", "video_results.npz")
"""Files that hold all frames of a folder."""
OWN_FOCAL = ("GVHMR", "TRAM", "PromptHMR")
"""Tools that tell a focal length of their own for each clip."""


def read_smpl_fit(path: Path, size: tuple[int, int]) -> SmplFit:
    """Read any of the files above; `size` (width, height) px is that of this clip's pictures.

    Raises StageError if it is none of them, or with the key, what was found and what was wanted.
    """
    path = Path(path)
    if not path.exists():
        raise StageError(f"no file {path}", HINT)
    if path.is_dir():
        return _read_folder(path, size)
    if path.suffix == ".json":
        content = _json(path)
        return read_mhr(content, str(path), size, path.stem) if is_mhr(content) else read_easymocap([path], str(path))
    return _recognised(read_tool_file(path, HINT), path, size)


def fit_focal(path: Path, size: tuple[int, int]) -> tuple[float, str] | None:
    """Focal length in px of pictures of `size` with which a tool saw the person, and the tool; None for one that has none.

    PHALP, ROMP and WHAM take the same camera for every clip.
    """
    fit = read_smpl_fit(path, size)
    return (float(np.median(fit.focal)), fit.tool) if fit.focal is not None and fit.tool in OWN_FOCAL else None


def _read_folder(folder: Path, size: tuple[int, int]) -> SmplFit:
    if (folder / "hps").is_dir():
        return read_tram(folder, size)
    whole = [folder / name for name in WHOLE if (folder / name).is_file()]
    kinds = {suffix: sorted(folder.glob(f"*{suffix}")) for suffix in (".json", ".npz", ".npy", ".pkl")}
    if whole or len(kinds[".pkl"]) == 1:
        return read_smpl_fit((whole or kinds[".pkl"])[0], size)
    if kinds[".json"] and not is_mhr(_json(kinds[".json"][0])):
        return read_easymocap(kinds[".json"], str(folder))
    many = max(kinds.values(), key=len)
    fits = [
        _recognised(_json(file) if file.suffix == ".json" else read_tool_file(file, HINT), file, size) for file in many
    ]
    if fits and {fit.tool for fit in fits} in ({"ROMP"}, {"SAM 3D Body"}):
        return join_fits(fits, str(folder))
    raise StageError(f"{folder} holds no known SMPL fit", HINT, [f"found {names_in(folder)}"])


def _json(path: Path) -> Any:
    """What a .json holds, None where it is none: its reader says what is wrong."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def _recognised(content: Any, path: Path, size: tuple[int, int]) -> SmplFit:
    if is_mhr(content):
        return read_mhr(content, str(path), size, path.stem)
    if isinstance(content, Mapping) and content:
        first = next(iter(content.values()))
        inner = first.keys() if isinstance(first, Mapping) else ()
        if "smpl_params_incam" in content:
            return read_gvhmr(dict(content), str(path), size)
        if {"people", "camera"} <= set(content) and isinstance(content["people"], Mapping):
            return read_prompthmr(dict(content), str(path), size)
        if "results" in content:
            return read_romp(dict(content), str(path), size, path.stem)
        if "pred_rotmat" in content:
            raise StageError(f"{path} is one person of TRAM", "give the folder that holds camera.npy and hps/")
        if {"pose", "trans"} & set(inner):
            return read_wham(dict(content), str(path), size)
        if {"tid", "smpl"} & set(inner):
            return read_phalp(dict(content), str(path), size)
        if path.suffix == ".npz" or any(key in content for key in TRANSL):
            return read_plain(dict(content), str(path))
    facts = [
        f"it holds {', '.join(map(str, list(content)[:8]))}" if isinstance(content, Mapping) else "no named values"
    ]
    raise StageError(f"{path} is not a known SMPL fit", HINT, facts)
