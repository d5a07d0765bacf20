"""points.ply: the sparse points of structure from motion, position and colour.

Ours, not trimesh's: trimesh adds a comment and an alpha channel to the file and invents colours for one that has none.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.contract import StageError

FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}


def write_points(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write points `xyz` [P,3] (stored as float32) with colours `rgb` [P,3] uint8 as binary PLY; P may be 0."""
    if xyz.shape != rgb.shape or xyz.shape[1:] != (3,) or rgb.dtype != np.uint8:
        raise ValueError(f"points need xyz [P,3] and rgb [P,3] uint8, not {xyz.shape} and {rgb.shape} {rgb.dtype}")
    table = np.empty(len(xyz), dtype=FIELDS)
    for column, (name, _) in enumerate(FIELDS):
        table[name] = xyz[:, column] if column < 3 else rgb[:, column - 3]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in FIELDS]
    Path(path).write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + table.tobytes())


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a binary little-endian PLY whose first element is `vertex`: (xyz [P,3] float32, rgb [P,3] uint8).

    Raises StageError for another kind of file, for a file cut short and for points that are not finite.
    """
    hint = "points.ply is written by the sfm stage; run `hugs run VIDEO sfm --force` to make it again"
    data = Path(path).read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not mark or lines[:1] != [["ply"]] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise StageError(f"{path} is not a binary little-endian PLY", hint)
    try:
        first, *_ = [*elements(lines), Element("", 0, None)]
        if first.name != "vertex" or first.row is None:
            raise ValueError("it does not begin with vertices, or these have a property list")
    except (ValueError, IndexError) as error:
        raise StageError(f"the header of {path} cannot be read", hint, [str(error)]) from error
    dtype, count, names = first.row, first.rows, first.row.names or ()
    if not {name for name, _ in FIELDS} <= set(names):
        raise StageError(f"{path} lacks x y z red green blue", hint, [f"it has {', '.join(names)}"])
    if len(body) < count * dtype.itemsize:
        raise StageError(f"{path} is cut short", hint, [f"{len(body)} of {count * dtype.itemsize} bytes"])
    table = np.frombuffer(body, dtype, count)
    with np.errstate(over="ignore"):  # a double too large for a float is refused below
        xyz = np.stack([table[name].astype(np.float32) for name in ("x", "y", "z")], 1)
    if not np.isfinite(xyz).all():
        raise StageError(f"{path} has points that are not finite", hint, [f"{(~np.isfinite(xyz).all(1)).sum()} points"])
    return xyz, np.stack([table[name].astype(np.uint8) for name in ("red", "green", "blue")], 1)


class Element(NamedTuple):
    """One table of a PLY: its name, its number of rows and their layout, little-endian; None: lists, rows of any length."""

    name: str
    rows: int
    row: np.dtype | None


def elements(lines: list[list[str]]) -> list[Element]:
    """The tables that the lines of a header promise; ValueError or IndexError for a header that cannot be."""
    starts = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    found = []
    for start, end in zip(starts, [*starts[1:], len(lines)]):
        name, count = lines[start][1], int(lines[start][2])
        if count < 0:
            raise ValueError(f"it has {count} rows of {name}")
        columns = [line for line in lines[start:end] if line[:1] == ["property"]]
        unknown = [line for line in columns if line[1] != "list" and (len(line) != 3 or line[1] not in TYPES)]
        if unknown:
            raise ValueError(f"it has a {' '.join(unknown[0])[:40]}")
        plain = not any(line[1] == "list" for line in columns)
        row = np.dtype([(name, TYPES[kind]) for _, kind, name in columns]) if plain else None
        found.append(Element(name, count, row))
    return found
