"""SPZ: 3D Gaussians in about a tenth of a PLY's bytes, for the web. https://github.com/nianticlabs/spz

Versions 3 and 4 are written, 2 to 4 are read: a header of 16 bytes and one table a property, with gzip over all; in version 4
each table is packed with zstd, and a list says how long they are. Places have 24 bits, 12 of them the fraction (0.24 mm);
scales are steps of 1/16 of a logarithm; colours, opacities and harmonics have 8 bits; rotations the three smaller components in
10 bits each (version 2: x y z in 8). The axes are those of the Gaussians given; docs/exports.md says what programs take them for.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from backports import zstd

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.exchange.ply import AGAIN, CONVERT
from stages.records import Scene

MAGIC, VERSION = b"NGSP", 3
HEAD = struct.Struct("<4sIIBBBB")  # magic, version, Gaussians, degree, fraction bits, flags, reserved (4: tables)
LISTED = struct.Struct("<I12x")  # of version 4, after the head: where the list of the tables' lengths begins
ANTIALIAS, MORE = 1, 2  # flags; MORE: extensions follow the tables
FRACTION = 12  # bits
FARTHEST = 1 << (23 - FRACTION)  # m
COLOUR = 0.15  # of the range of a byte for a unit of the coefficient of degree 0
LOGS = (-10.0, 16.0)  # the least logarithm of a scale, and steps in 1
WIDEST = float(np.exp(LOGS[0] + 255 / LOGS[1]))  # m: 379
GLOSSIEST = 1.0  # of a coefficient of degree 1 and higher
STEPS = (8, 16)  # the bytes of degree 1 and of higher degrees are multiples of these
LARGEST = 2**-0.5  # of a quaternion's components that are not the largest one
CHUNK = 1 << 14  # rows made at a time
File = IO[bytes] | gzip.GzipFile
LEVEL = 5  # of gzip: 9 saves a thousandth, and takes 15 times as long for colours of degree 3
HINT = f"give an .spz of version 2 to 4, or a .ply; {CONVERT} from others"


def write_spz(path: Path, splats: Scene, version: int = VERSION) -> dict[str, int]:
    """Write Gaussians as SPZ version 3 or 4, with the flag for anti-aliasing; says what was clamped, in words, and how often.

    Degrees 0 to 3. The same Gaussians make the same bytes.
    """
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[splats.shN.shape[1]]
    far = np.abs(splats.means) >= FARTHEST
    bright = np.abs(splats.sh0) * COLOUR > 0.5
    wide = splats.scales > WIDEST
    most = np.stack([splats.shN.max((1, 2), initial=0), -splats.shN.min((1, 2), initial=0)], 1)
    flags = ANTIALIAS if splats.antialias else 0
    tables = (_places, _opacities, _colours, _scales, _turns, _higher)[: 6 if degree else 5]
    chunks = [slice(start, start + CHUNK) for start in range(0, len(splats), CHUNK)]
    head = HEAD.pack(MAGIC, version, len(splats), degree, FRACTION, flags, 0 if version == VERSION else len(tables))
    with Path(path).open("wb") as plain:
        if version == VERSION:
            with gzip.GzipFile("", "wb", LEVEL, plain, mtime=0) as file:
                file.write(head)
                for table in tables:
                    for rows in chunks:
                        file.write(table(splats, rows).tobytes())
        else:
            whole = [b"".join(table(splats, rows).tobytes() for rows in chunks) for table in tables]
            packed = [zstd.compress(data) for data in whole]
            lengths = [struct.pack("<QQ", len(small), len(data)) for small, data in zip(packed, whole, strict=True)]
            plain.write(b"".join([head, LISTED.pack(HEAD.size + LISTED.size), *lengths, *packed]))
    clamped = {
        f"beyond {FARTHEST} m": far,
        f"wider than {WIDEST:.0f} m": wide,
        "with colours out of range": bright,
        "with colours that depend too much on the view": most > GLOSSIEST,
    }
    counts = {what: int(rows.any(1).sum()) for what, rows in clamped.items()}
    return {what: count for what, count in counts.items() if count}


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _places(splats: Scene, rows: slice) -> np.ndarray:
    most = (1 << 23) - 1
    whole = np.clip(np.rint(splats.means[rows].astype(np.float64) * (1 << FRACTION)), -most - 1, most)
    return np.ascontiguousarray(whole.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3])


def _opacities(splats: Scene, rows: slice) -> np.ndarray:
    return _bytes(splats.opacities[rows] * 255)


def _colours(splats: Scene, rows: slice) -> np.ndarray:
    return _bytes((splats.sh0[rows] * COLOUR + 0.5) * 255)


def _scales(splats: Scene, rows: slice) -> np.ndarray:
    least, steps = LOGS
    return _bytes((np.log(np.maximum(splats.scales[rows], np.exp(least))) - least) * steps)


def _turns(splats: Scene, rows: slice) -> np.ndarray:
    """Two bits for the largest of x y z w, then a sign and 9 bits for each of the others, which come first the higher."""
    quats = splats.quats[rows][:, [1, 2, 3, 0]].astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(1)
    negative = np.take_along_axis(quats, largest[:, None], 1) < 0
    sizes = np.minimum(np.rint(np.abs(quats) / LARGEST * 511), 511).astype(np.uint32)
    signs = ((quats < 0) ^ negative).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for i in range(4):
        packed = np.where(largest == i, packed, packed << 10 | signs[:, i] << 9 | sizes[:, i])
    return packed.astype("<u4")


def _higher(splats: Scene, rows: slice) -> np.ndarray:
    whole = np.rint(splats.shN[rows] * 128) + 128
    for part, step in zip((whole[:, :3], whole[:, 3:]), STEPS, strict=True):
        part[:] = np.rint(part / step) * step
    return _bytes(whole)


def read_spz(path: Path) -> Scene:
    """Read an .spz of version 2 to 4; StageError for other files and versions, by name, and for one cut short."""
    try:
        with Path(path).open("rb") as plain:
            if plain.peek(len(MAGIC)).startswith(MAGIC):
                return _read(plain, path, (4,), _packed_tables)
            with gzip.GzipFile(fileobj=plain) as file:
                return _read(file, path, (2, 3), _tables)
    except OSError as error:  # gzip.BadGzipFile is one
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    except (EOFError, ValueError, struct.error, zlib.error, zstd.ZstdError) as error:
        raise StageError(f"{path} is cut short or damaged", AGAIN, [str(error)]) from error


Tables = Callable[[File, int, int, Sequence[int]], Iterator[np.ndarray]]
"""From a file after its head: the bytes [N,width] of each property, given how many tables the head names, N and the widths."""


def _read(file: File, path: Path, versions: tuple[int, ...], tables: Tables) -> Scene:
    head = file.read(HEAD.size)
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise StageError(f"{path} is no SPZ", HINT, [f"it begins with {head[:4]!r}, not {MAGIC!r}"])
    _, version, count, degree, fraction, flags, streams = HEAD.unpack(head)
    if version not in versions or degree > 3 or fraction > 23:
        facts = [f"version {version}, degree {degree}, {fraction} bits of fraction"]
        raise StageError(f"{path} is an SPZ of an unknown kind", HINT, facts)
    bases, turn = (degree + 1) ** 2 - 1, 3 if version == 2 else 4
    widths = (9, 1, 3, 3, turn, 3 * bases)[: 6 if bases else 5]
    Budget(path, Path(path).stat().st_size).spend(count * (sum(widths) + 4 * (14 + 3 * bases)), f"{count} Gaussians")
    places, opacities, colours, scales, turns, *more = tables(file, streams, count, widths)
    if not flags & MORE and file.read(1):
        raise StageError(f"{path} is longer than its header says", AGAIN, [f"{count} Gaussians of degree {degree}"])
    whole = np.zeros((count, 3, 4), np.uint8)
    whole[..., 1:] = places.reshape(count, 3, 3)
    unpack: Callable[[np.ndarray], np.ndarray] = _unpack_turns_2 if version == 2 else _unpack_turns
    least, steps = LOGS
    return Scene(
        means=(whole.view("<i4")[..., 0] / np.float64(1 << 8 + fraction)).astype(np.float32),
        quats=unpack(turns).astype(np.float32),
        scales=np.exp(scales / np.float32(steps) + np.float32(least)),
        opacities=opacities[:, 0] / np.float32(255),
        sh0=(colours / np.float32(255) - np.float32(0.5)) / np.float32(COLOUR),
        shN=((np.array(more, np.float32) - 128) / 128).reshape(count, bases, 3),
        antialias=bool(flags & ANTIALIAS),
    )


def _tables(file: File, streams: int, count: int, widths: Sequence[int]) -> Iterator[np.ndarray]:
    for width in widths:
        yield _table(file.read(count * width), count, width)


def _packed_tables(file: File, streams: int, count: int, widths: Sequence[int]) -> Iterator[np.ndarray]:
    """Of version 4, where more tables may follow."""
    (start,) = LISTED.unpack(file.read(LISTED.size))
    file.seek(start)
    lengths = [packed for packed, _ in struct.iter_unpack("<QQ", file.read(16 * streams))]
    size = os.fstat(file.fileno()).st_size
    for width, length in zip(widths, lengths):
        packed = file.read(min(length, size))
        yield _table(zstd.ZstdDecompressor().decompress(packed, count * width + 1), count, width)


def _table(data: bytes, count: int, width: int) -> np.ndarray:
    if len(data) != count * width:
        raise EOFError(f"a table of {count} x {width} bytes ends after {len(data)}")
    return np.frombuffer(data, np.uint8).reshape(count, width)


def _unpack_turns(packed: np.ndarray) -> np.ndarray:
    """Quaternions [N,4] w x y z of version 3."""
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = bits >> 30
    quats = np.zeros((len(bits), 4))
    for i in range(3, -1, -1):
        size = (bits & 511) / 511 * LARGEST
        quats[:, i] = np.where(largest == i, 0, np.where(bits >> 9 & 1, -size, size))
        bits = np.where(largest == i, bits, bits >> 10)
    rest = np.sqrt(np.maximum(0, 1 - np.square(quats).sum(1)))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), rest[:, None], 1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True))[:, [3, 0, 1, 2]]


def _unpack_turns_2(packed: np.ndarray) -> np.ndarray:
    """Quaternions [N,4] w x y z of version 2, whose w is not negative."""
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(1)))
    quats = np.concatenate([w[:, None], xyz], 1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
