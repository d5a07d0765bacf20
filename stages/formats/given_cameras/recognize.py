"""Camera files and folders of other programs: recognizes the program by the content and reads its cameras."""

from __future__ import annotations

from pathlib import Path

from stages.contract import StageError
from stages.formats.cameras import read_cameras
from stages.formats.given_cameras.colmap_model import is_model, read_colmap
from stages.formats.given_cameras.record import GivenCameras, checked_lens, without_points
from stages.formats.given_cameras.transforms_json import read_transforms
from stages.formats.images import same_shape
from stages.formats.kinds import names_in

HINT = "`--cameras` takes the folder of a COLMAP model (cameras, images, points3D as .bin or .txt), or transforms.json"
PLACES = ("", "*", "sparse/*", "colmap/sparse/*")
"""Where COLMAP and programs that call it put models under a folder."""


def read_camera_files(path: Path, width: int, height: int) -> GivenCameras:
    """Read a COLMAP model, a transforms.json or a cameras.npz of ours, or a folder that holds one of them.

    `width` and `height` are the clip's, for files without a picture size. Raises StageError for anything else, and for
    a folder with several.
    """
    path = _only_one(path) if path.is_dir() else path
    if path.is_dir():
        return read_colmap(path)
    if path.suffix.lower() == ".json":
        return read_transforms(path, width, height)
    if path.suffix.lower() == ".npz":
        return _ours(path)
    hint = f"give the folder {path.parent}" if is_model(path.parent) else HINT
    raise StageError(f"{path} holds no cameras that can be read", hint, [f"it is a file {path.suffix or 'of no kind'}"])


def check_shape(given: GivenCameras, width: int, height: int) -> None:
    """StageError where cameras are for pictures of another shape than the clip's."""
    own = given.lenses[0]
    if same_shape((own.width, own.height), (width, height)):
        return
    hint = "give cameras of the same pictures; their size may differ, their shape not"
    if same_shape((own.height, own.width), (width, height)):
        hint = "they are of turned pictures: let their program run on pictures that are upright, as a player shows them"
    fact = f"cameras for {own.width}x{own.height}, frames {width}x{height}"
    raise StageError("the given cameras are not for these frames", hint, [fact])


def _only_one(folder: Path) -> Path:
    """The model or the transforms.json in a folder."""
    found = [place for name in PLACES for place in ([folder] if not name else sorted(folder.glob(name)))]
    found = [place for place in found if is_model(place)]
    found += [file for file in [folder / "transforms.json"] if file.is_file()]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(str(place.relative_to(folder)) for place in found)
        raise StageError(f"{len(found)} sets of cameras in {folder}", "give one of them", [names])
    raise StageError(f"no cameras in {folder}", HINT, [f"it holds {names_in(folder)}"])


def _ours(path: Path) -> GivenCameras:
    cameras = read_cameras(path)
    lenses = [
        checked_lens(
            "PINHOLE", (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), cameras.width, cameras.height, f"{name} in {path}", HINT
        )
        for name, K in zip(cameras.names, cameras.Ks, strict=True)
    ]
    return without_points("cameras.npz", cameras.names, list(cameras.viewmats), lenses)
