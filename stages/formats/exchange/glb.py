"""GLB, the binary file of glTF 2.0: arrays in one buffer, and the JSON that says what they mean.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.budget import Budget

MAGIC, VERSION = b"glTF", 2
CHUNKS = (b"JSON", b"BIN\0")
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
VERTICES, TRIANGLES = 34962, 34963  # glTF's targets of buffer views
HINT = "give the avatar.npz or avatar_splats.glb that the export stage wrote; avatar.glb holds a mesh"


class Arrays:
    """Collects the arrays of a GLB: `add` gives the number by which the JSON names one."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, bounds: bool = False, scaled: bool = False, target: int | None = None) -> int:
        """Store rows [N] or [N,K] of float32, uint8, uint16 or uint32.

        `bounds` writes the least and largest of each column, `scaled` says that integers stand for 0..1, `target` is
        glTF's hint what for.
        """
        rows = np.ascontiguousarray(array)
        kind = next(code for code, name in TYPES.items() if np.dtype(name) == rows.dtype.newbyteorder("<"))
        columns = 1 if rows.ndim == 1 else rows.shape[1]
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes})
        if target is not None:
            self.views[-1]["target"] = target
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": kind, "count": len(rows)}
        accessor["type"] = next(name for name, count in KINDS.items() if count == columns)
        if bounds:
            table = rows.reshape(len(rows), columns)
            accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
        if scaled:
            accessor["normalized"] = True
        self.accessors.append(accessor)
        self.data += rows.astype(rows.dtype.newbyteorder("<"), copy=False).tobytes()
        self.data += bytes(-len(self.data) % 4)
        return len(self.accessors) - 1

    def add_few(self, rows: np.ndarray, kept: np.ndarray) -> int:
        """Store rows [N,3] float32 of which all but those `kept` bool [N] are taken to be 0."""
        at = np.flatnonzero(kept)
        few = np.zeros((1, 3), np.float32) if len(at) == 0 else rows[at].astype(np.float32)
        at = at if len(at) else np.zeros(1, int)
        narrow, kind = (np.uint16, 5123) if len(rows) < 1 << 16 else (np.uint32, 5125)
        views = [self.add_bytes(part.tobytes()) for part in (at.astype(narrow), few)]
        whole = np.concatenate([few, np.zeros((int(len(rows) > len(few)), 3), np.float32)])
        sparse = {
            "count": len(at),
            "indices": {"bufferView": views[0], "componentType": kind},
            "values": {"bufferView": views[1]},
        }
        accessor = {"componentType": 5126, "count": len(rows), "type": "VEC3", "sparse": sparse}
        self.accessors.append(accessor | {"min": whole.min(0).tolist(), "max": whole.max(0).tolist()})
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes) -> int:
        """Store a file, such as a picture; the number of its buffer view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1


def write_glb(path: Path, content: dict[str, Any], arrays: Arrays) -> None:
    """Write `content` with the arrays that it names; the same content makes the same bytes. glTF knows no empty lists."""
    whole = {name: part for name, part in content.items() if part != []} | {
        "buffers": [{"byteLength": len(arrays.data)}],
        "bufferViews": arrays.views,
        "accessors": arrays.accessors,
    }
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(arrays.data)
    if length >= 1 << 32:
        raise StageError(
            f"{path} would be too large for a GLB", "leave glb out", [f"{length:,} bytes, 4 GiB are the most"]
        )
    with Path(path).open("wb") as file:
        file.write(struct.pack("<4sII", MAGIC, VERSION, length))
        for kind, chunk in zip(CHUNKS, (text, bytes(arrays.data)), strict=True):
            file.write(struct.pack("<I4s", len(chunk), kind))
            file.write(chunk)


class Glb:
    """A GLB that was read: `content`, its JSON, and its arrays."""

    def __init__(self, path: Path):
        """StageError for a file that is no GLB or of another length than its headers say."""
        self.path = path
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
        if len(data) < 20 or data[:4] != MAGIC:
            raise StageError(f"{path} is no GLB", HINT, [f"it begins with {data[:4]!r}, not {MAGIC!r}"])
        _, version, length = struct.unpack_from("<4sII", data)
        if version != VERSION or length != len(data):
            facts = [f"its header says version {version} and {length} bytes, it has {len(data)}"]
            raise StageError(f"{path} is no GLB of version {VERSION}, or cut short", HINT, facts)
        chunks: list[bytes] = []
        at = 12
        while at + 8 <= length and len(chunks) < 2:
            size, kind = struct.unpack_from("<I4s", data, at)
            if kind != CHUNKS[len(chunks)] or at + 8 + size > length:
                raise StageError(f"{path} is damaged", HINT, [f"chunk {len(chunks)} is {kind!r} of {size} bytes"])
            chunks.append(data[at + 8 : at + 8 + size])
            at += 8 + size
        if len(chunks) < 2:
            raise StageError(f"{path} holds no arrays", HINT)
        try:
            self.content: Any = json.loads(chunks[0])
        except (ValueError, RecursionError) as error:
            raise StageError(f"the JSON in {path} cannot be read", HINT, [str(error)]) from error
        self.data = chunks[1]
        self.budget = Budget(path, len(data))

    def array(self, number: object, kind: str, columns: int) -> np.ndarray:
        """The packed array that accessor `number` names, [N,columns] of type `kind`; KeyError and such for any other."""
        accessor = _at(self.content["accessors"], number)
        view = _at(self.content["bufferViews"], accessor["bufferView"])
        count, skip = int(accessor["count"]), int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        found = (TYPES[accessor["componentType"]], KINDS[accessor["type"]], view.get("byteStride"), view["buffer"])
        if found[:2] != (kind, columns) or found[2:] != (None, 0) or "sparse" in accessor:
            raise ValueError(f"accessor {number} is {found}, not a packed {kind} x {columns}")
        wanted = count * columns * np.dtype(kind).itemsize
        if min(count, skip) < 0 or skip + wanted > len(self.data) or wanted > int(view["byteLength"]):
            raise ValueError(f"accessor {number} reaches out of the file")
        self.budget.spend(wanted, f"accessor {number}")
        return np.frombuffer(self.data, kind, count * columns, skip).reshape(count, columns).copy()


def _at(rows: Any, number: object) -> Any:
    if not isinstance(number, int) or isinstance(number, bool) or number < 0:
        raise ValueError(f"{number!r} is no index")
    return rows[number]
