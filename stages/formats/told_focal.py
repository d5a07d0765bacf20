"""The focal length that a file tells: EXIF of pictures, QuickTime keys of a video."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import OpenImageIO as oiio

from stages.formats.facts import Told
from stages.formats.images import evenly
from stages.formats.pictures import picture_files
from stages.formats.video import open_video

DIAGONAL_MM = math.hypot(36, 24)
"""Of the film that "35 mm equivalent" compares with (CIPA DCG-001: by the diagonals)."""
SANE_MM = (8.0, 400.0)
PICTURE_SPREAD, VIDEO_SPREAD = 0.05, 0.15
"""Of the logarithm: whole millimetres and crops of photographs; films use less of the sensor, by 5 to 25 %."""
LOOKED_AT = 10
"""Pictures of a folder."""
QUICKTIME = ("com.apple.quicktime.camera.focal_length.35mm_equivalent", "com.apple.quicktime.camera.focal_length.35mm")
EXIF = "Exif:FocalLengthIn35mmFilm"
MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""EXIF's units of FocalPlaneXResolution in mm."""


def told_focal(path: Path, width: int, height: int) -> Told | None:
    """The focal length that a video, or every picture of a folder, tells; None without one, or if pictures differ.

    `width` and `height` are the picture's, in any unit.
    """
    to_share = math.hypot(width, height) / max(width, height) / DIAGONAL_MM
    if Path(path).is_dir():
        files = picture_files(path)
        told = {_of_picture(files[i], to_share) for i in evenly(len(files), LOOKED_AT)}
        share, what = told.pop() or (0.0, "")
        return Told(share=share, spread=PICTURE_SPREAD, words=f"EXIF, {what}") if share and not told else None
    container, stream = open_video(path)
    with container:
        tags = {**container.metadata, **stream.metadata}
    for key in QUICKTIME:
        with suppress(KeyError, ValueError):
            mm = float(tags[key])
            if SANE_MM[0] <= mm <= SANE_MM[1]:
                words = f"QuickTime, {mm:g} mm equivalent"
                return Told(share=mm * to_share, spread=VIDEO_SPREAD, words=words)
    return None


def _of_picture(file: Path, to_share: float) -> tuple[float, str] | None:
    """Focal length as a share of the longer side and where it stands; None where the picture tells none that can be."""
    source = oiio.ImageInput.open(str(file))
    if source is None:
        return None  # reading its pixels says what is wrong
    spec = source.spec()
    source.close()
    mm = spec.get_float_attribute(EXIF, 0.0)
    if SANE_MM[0] <= mm <= SANE_MM[1]:
        return mm * to_share, f"{mm:g} mm equivalent"
    mm, dense = (spec.get_float_attribute(f"Exif:{name}", 0.0) for name in ("FocalLength", "FocalPlaneXResolution"))
    whole = spec.get_int_attribute("Exif:PixelXDimension", spec.width)
    unit = MM.get(spec.get_int_attribute("Exif:FocalPlaneResolutionUnit", 2))
    if unit is None or whole <= 0 or not dense > 0:
        return None
    share = mm * dense / unit / max(whole, spec.get_int_attribute("Exif:PixelYDimension", spec.height))
    equivalent = share / to_share
    return (share, f"{mm:g} mm on its sensor") if SANE_MM[0] <= equivalent <= SANE_MM[1] else None
