"""Pictures and masks on disk, through OpenImageIO: 8-bit sRGB, rows from the top, alpha not multiplied into colour."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
from PIL import Image, ImageCms

from stages.contract import StageError
from stages.formats.budget import Budget

SRGB = ImageCms.createProfile("sRGB")
PATCHES = np.stack(np.meshgrid(*[np.arange(0, 256, 51, dtype=np.uint8)] * 3), -1).reshape(12, 18, 3)
ROUNDING = 2  # of 255, by which all PATCHES differ at most: the profile is one of sRGB, and the picture stays as it is
KEPT = 1 << 28  # bytes of pictures that `Kept` holds
# Each byte is written as its difference to a guess from its neighbours, and only runs are packed: less than half of the
# time of zlib's search at level 3, and photos are as small.
PNG = [
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH),
]
# EXIF orientation -> quarter turns counter-clockwise that put the picture upright, and those that then are still mirrored
TURNS, MIRRORED = {3: 2, 4: 2, 5: -1, 6: -1, 7: 1, 8: 1}, (2, 4, 5, 7)


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of the rows of `count`, spread evenly, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def read_pixels(path: Path) -> np.ndarray:
    """Read any picture OpenImageIO knows as [H,W,channels] upright: uint8 or uint16 as stored, anything else float32.

    Colours are as stored: see `read_image`. Raises StageError for a missing, unknown or damaged file, and for a size that no
    phone's picture has; a file cut short is never returned with made-up rows.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[np.ndarray, bytes]:
    """The pixels, and the colour profile that the file has; empty without one."""
    if not Path(path).is_file():
        raise StageError(f"no picture at {path}", "check the path")
    if (name := os.fsencode(path).decode(errors="replace")) != str(path):
        raise StageError(f"the name of {name} is not UTF-8", "rename it, or the folder that it is in")
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise StageError(f"{path} is not a picture", "use PNG, JPEG or TIFF", [first_line(oiio.geterror())])
    spec = source.spec()
    kind = str(spec.format) if str(spec.format) in ("uint8", "uint16") else "float"
    pixel = {"uint8": 1, "uint16": 2}.get(kind, 4) * max(spec.nchannels, 3)  # grey will be three channels
    what = f"a picture of {spec.width}x{spec.height} px, {spec.nchannels} channels"
    Budget(path).spend(spec.width * spec.height * spec.depth * pixel, what)
    pixels = source.read_image(0, 0, 0, spec.nchannels, kind)
    trouble = source.geterror() or oiio.geterror()
    source.close()
    if pixels is None or trouble:
        raise StageError(f"{path} is damaged or cut short", "make or copy the file again", [first_line(trouble)])
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    stored = spec.get_int_attribute("Orientation", 1)
    upright = np.rot90(pixels, TURNS.get(stored, 0))
    profile = spec.getattribute("ICCProfile")
    packed = b"" if profile is None else np.asarray(profile).tobytes()
    return np.ascontiguousarray(upright[:, ::-1] if stored in MIRRORED else upright), packed


class Kept:
    """Pictures that are asked for again and again: the first KEPT bytes of them are read from their files once."""

    def __init__(self) -> None:
        self.room, self.pictures = KEPT, dict[Path, np.ndarray]()

    def read(self, read: Callable[[Path], np.ndarray], path: Path) -> np.ndarray:
        """What `read` makes of the file; it cannot be written to where it is kept."""
        if path in self.pictures:
            return self.pictures[path]
        pixels = read(path)
        if pixels.nbytes <= self.room:
            self.room -= pixels.nbytes
            self.pictures[path] = pixels
            pixels.flags.writeable = False
        return pixels


def read_image(path: Path) -> np.ndarray:
    """Read a picture as uint8 [H,W,3] upright, in sRGB; grey is repeated, alpha is left out, 16 bit and float are rounded.

    Colours of another profile, as Display P3 of a phone, become sRGB; without one they are sRGB. Raises StageError as
    `read_pixels` does, for a profile that cannot be read, and for pixels that are not finite: as bytes they would be black.
    """
    pixels, profile = _read(path)
    if not np.isfinite(pixels).all():
        count = int((~np.isfinite(pixels)).any(-1).sum())
        facts = [f"{count} of {pixels.shape[0] * pixels.shape[1]} pixels"]
        raise StageError(
            f"{path} has pixels that are not finite", "make the file again, as 8 bit PNG for example", facts
        )
    if pixels.dtype != np.uint8:
        top = 65535.0 if pixels.dtype == np.uint16 else 1.0
        pixels = np.rint(pixels.clip(0, top) * (255.0 / top)).astype(np.uint8)
    if pixels.shape[2] >= 3:
        color = np.ascontiguousarray(pixels[..., :3])
        return _srgb(path, color, profile) if profile else color
    return np.ascontiguousarray(np.broadcast_to(pixels[..., :1], (*pixels.shape[:2], 3)))


def _srgb(path: Path, pixels: np.ndarray, profile: bytes) -> np.ndarray:
    """Pixels uint8 [H,W,3] of an ICC profile, in sRGB. A profile for grey or for inks is not of these pixels, and is left out."""
    try:
        known = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if known.profile.xcolor_space.strip() != "RGB":
            return pixels
        way = ImageCms.buildTransform(known, SRGB, "RGB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
        same = np.abs(_through(way, PATCHES).astype(int) - PATCHES).max() <= ROUNDING
        return pixels if same else _through(way, pixels)
    except (OSError, ImageCms.PyCMSError) as error:
        hint = "convert it to sRGB with the program that wrote it"
        raise StageError(f"the colour profile of {path} cannot be read", hint, [first_line(str(error))]) from error


def _through(way: ImageCms.ImageCmsTransform, pixels: np.ndarray) -> np.ndarray:
    return np.array(ImageCms.applyTransform(Image.fromarray(pixels), way))


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H,W,3], or [H,W,4] with alpha not multiplied into colour, in the format of the file's suffix."""
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        raise ValueError(f"a picture is uint8 [H,W,3] or [H,W,4], not {pixels.dtype} {pixels.shape}")
    write_uint8(path, pixels)


def shrink(pixels: np.ndarray, max_side: int) -> np.ndarray:
    """Resample uint8 [H,W,3] by area so that its longer side is at most `max_side` px; smaller pictures stay."""
    height, width = pixels.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def read_mask(path: Path) -> np.ndarray:
    """Read a mask that `write_mask` made: uint8 [H,W], 255 = person. Raises StageError if the file is not 8-bit grey."""
    pixels = read_pixels(path)
    if pixels.dtype != np.uint8 or pixels.shape[2] != 1:
        found = f"it has {pixels.shape[2]} channels of {pixels.dtype}"
        raise StageError(f"{path} is not an 8-bit grey mask", "give foreign masks to the masks stage", [found])
    return pixels[..., 0]


def same_shape(size: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether pictures of two sizes (width, height) can be the same picture: their width / height differs by 1 % at most."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= 0.01


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask uint8 [H,W], 255 = person, soft values between."""
    if mask.dtype != np.uint8 or mask.ndim != 2 or mask.size == 0:
        raise ValueError(f"a mask is uint8 [H,W], not {mask.dtype} {mask.shape}")
    write_uint8(path, mask[..., None])


def write_uint8(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H,W,channels]; raises StageError with the reason if the file cannot be written.

    Encoded in memory by OpenCV: OpenImageIO cuts files short on a full disk and reports success.
    """
    stored = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]] if pixels.shape[2] > 1 else pixels
    suffix = Path(path).suffix
    try:
        _, data = cv2.imencode(suffix, stored, PNG if suffix == ".png" else [])
        Path(path).write_bytes(data.tobytes())
    except (cv2.error, OSError) as error:
        raise StageError(f"cannot write {path}", "check the disk and the folder", [first_line(str(error))]) from error


def first_line(text: str) -> str:
    """The first line of a library's message, or a plain word when it gave none."""
    return text.strip().splitlines()[0] if text.strip() else "no reason given"
