"""Masks of two objects in the layouts of SAM 2, COCO, numpy and video, from true masks bool [N,H,W]."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import av
import numpy as np

DAVIS = np.array(
    [[0, 0, 0], [128, 0, 0], [0, 128, 0], [128, 128, 0]] + [[i, i // 2, 0] for i in range(4, 256)], np.uint8
)
"""The first colours of the palette that SAM 2's vos_inference.py writes; it fills all 256."""


def png(path: Path, values: np.ndarray, table: np.ndarray | None = None) -> Path:
    """A PNG of uint8 or uint16 [H,W] grey levels, or of places in a palette."""
    height, width = values.shape
    depth, colour = values.dtype.itemsize * 8, 0 if table is None else 3

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = values.astype(values.dtype.newbyteorder(">"))
    body = b"".join(b"\0" + row.tobytes() for row in rows)
    parts = [chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))]
    parts += [chunk(b"PLTE", table.tobytes())] if table is not None else []
    parts += [chunk(b"IDAT", zlib.compress(body)), chunk(b"IEND", b"")]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def ids(person: np.ndarray, other: np.ndarray, kind: type = np.uint8, numbers: tuple[int, int] = (2, 1)) -> np.ndarray:
    """Id maps [N,H,W]: the person has the first of `numbers`."""
    return np.where(person, numbers[0], np.where(other, numbers[1], 0)).astype(kind)


def sam2_palette(folder: Path, person: np.ndarray, other: np.ndarray) -> Path:
    """vos_inference.py: OUTPUT/VIDEO/00000.png with a palette."""
    for i, values in enumerate(ids(person, other)):
        png(folder / "clip" / f"{i:05d}.png", values, DAVIS)
    return folder


def sam2_objects(folder: Path, person: np.ndarray, other: np.ndarray) -> Path:
    """vos_inference.py --per_obj_png_file: OUTPUT/VIDEO/001/00000.png with 0 and 1; objects may overlap."""
    for number, masks in ((1, other), (2, person)):
        for i, mask in enumerate(masks):
            if mask.any():
                png(folder / "clip" / f"{number:03d}" / f"{i:05d}.png", mask.astype(np.uint8), DAVIS)
    return folder


def ids_16_bit(folder: Path, person: np.ndarray, other: np.ndarray) -> Path:
    for i, values in enumerate(ids(person, other, np.uint16, (24001, 26002))):
        png(folder / f"{i:06d}.png", values)
    return folder


def coco(path: Path, person: np.ndarray, other: np.ndarray, how: str = "text", track: str | None = "track_id") -> Path:
    """Instances with a category for people and one for dogs, which lie where the person is."""
    images, annotations = [], []
    for i in range(len(person)):
        height, width = person[i].shape
        images.append({"id": 100 + i, "file_name": f"frames/{i:06d}.jpg", "height": height, "width": width})
        for number, category, mask in ((7, 1, other[i]), (9, 1, person[i]), (11, 18, ~person[i])):
            if mask.any():
                one = {"id": len(annotations), "image_id": 100 + i, "category_id": category, "iscrowd": 0}
                one |= {"segmentation": ENCODE[how](mask), "bbox": [0, 0, 1, 1]} | ({track: number} if track else {})
                annotations.append(one)
    categories = [{"id": 1, "name": "person"}, {"id": 18, "name": "dog"}]
    path.write_text(json.dumps({"images": images, "annotations": annotations[::-1], "categories": categories}))
    return path


def runs(mask: np.ndarray) -> list[int]:
    """Run lengths down the columns, the first of background."""
    line = np.concatenate([[0], mask.T.ravel().astype(int), [2]])
    edges = np.flatnonzero(np.diff(line))
    return [int(n) for n in np.diff(np.concatenate([[0], edges]))]


def text(counts: list[int]) -> str:
    """Run lengths as letters: 5 bits each, lowest first, 32 for more, differences from the fourth on."""
    letters = ""
    for i, count in enumerate(counts):
        value, more = count - (counts[i - 2] if i > 2 else 0), True
        while more:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            letters += chr(48 + bits + 32 * more)
    return letters


def rectangles(mask: np.ndarray) -> list[list[float]]:
    """A polygon round each run of each row."""
    found = []
    for y, row in enumerate(mask):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for a, b in edges.reshape(-1, 2).tolist():
            found.append([a, y, b, y, b, y + 1, a, y + 1])
    return found


ENCODE = {
    "text": lambda mask: {"size": list(mask.shape), "counts": text(runs(mask))},
    "list": lambda mask: {"size": list(mask.shape), "counts": runs(mask)},
    "polygons": rectangles,
}


def film(path: Path, masks: np.ndarray, codec: str = "ffv1", pixels: str = "gray") -> Path:
    """A video with a mask a frame, white on black."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=12)
        stream.height, stream.width, stream.pix_fmt = *masks.shape[1:], pixels
        for mask in masks:
            frame = av.VideoFrame.from_ndarray(np.where(mask, 255, 0).astype(np.uint8), format="gray")
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode(None))
    return path
