"""SPZ: 3D Gaussians in about a tenth of a PLY's bytes, for the web. https://github.com/nianticlabs/spz

Version 3 is written, 2 and 3 are read: gzip over a header of 16 bytes and one table a property. Places have 24 bits, 12
of them the fraction (0.24 mm); scales are steps of 1/16 of a logarithm; colours, opacities and harmonics have 8 bits;
rotations the three smaller components in 10 bits each (version 2: x y z in 8). The axes are those of a PLY.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.exchange.ply import AGAIN, CONVERT
from stages.records import Scene

MAGIC, VERSION = b"NGSP", 3
HEAD = struct.Struct("<4sIIBBBB")  # magic, version, Gaussians, degree, fraction bits, flags, reserved
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
LEVEL = 5  # of gzip: 9 saves a thousandth, and takes 15 times as long for colours of degree 3
HINT = f"give an .spz of version 2 or 3, or a .ply; {CONVERT} from others"


def write_spz(path: Path, splats: Scene) -> dict[str, int]:
    """Write Gaussians as SPZ version 3, with the flag for anti-aliasing; says what was clamped, in words, and how often.

    Degrees 0 to 3. The same Gaussians make the same bytes.
    """
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[splats.shN.shape[1]]
    far = np.abs(splats.means) >= FARTHEST
    bright = np.abs(splats.sh0) * COLOUR > 0.5
    wide = splats.scales > WIDEST
    most = np.stack([splats.shN.max((1, 2), initial=0), -splats.shN.min((1, 2), initial=0)], 1)
    flags = ANTIALIAS if splats.antialias else 0
    with Path(path).open("wb") as plain, gzip.GzipFile("", "wb", LEVEL, plain, mtime=0) as file:
        file.write(HEAD.pack(MAGIC, VERSION, len(splats), degree, FRACTION, flags, 0))
        for table in (_places, _opacities, _colours, _scales, _turns, _higher):
            for start in range(0, len(splats), CHUNK):
                file.write(table(splats, slice(start, start + CHUNK)).tobytes())
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
    """Read an .spz of version 2 or 3; StageError for other files and versions, by name, and for one cut short."""
    try:
        with Path(path).open("rb") as plain, gzip.GzipFile(fileobj=plain) as file:
            return _read(file, path)
    except OSError as error:  # gzip.BadGzipFile is one
        with_zstd = "version 4 is not packed with gzip" if _starts(path, MAGIC) else str(error)
        raise StageError(f"cannot read {path}", HINT, [with_zstd]) from error
    except (EOFError, zlib.error) as error:
        raise StageError(f"{path} is cut short or damaged", AGAIN, [str(error)]) from error


def _starts(path: Path, mark: bytes) -> bool:
    return Path(path).is_file() and Path(path).open("rb").read(len(mark)) == mark


def _read(file: gzip.GzipFile, path: Path) -> Scene:
    head = file.read(HEAD.size)
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise StageError(f"{path} is no SPZ", HINT, [f"it begins with {head[:4]!r}, not {MAGIC!r}"])
    _, version, count, degree, fraction, flags, _ = HEAD.unpack(head)
    if version not in (2, VERSION) or degree > 3 or fraction > 23:
        facts = [f"version {version}, degree {degree}, {fraction} bits of fraction"]
        raise StageError(f"{path} is an SPZ of an unknown kind", HINT, facts)
    bases, turn = (degree + 1) ** 2 - 1, 4 if version == VERSION else 3
    widths = (9, 1, 3, 3, turn, 3 * bases)
    Budget(path, Path(path).stat().st_size).spend(count * (sum(widths) + 4 * (14 + 3 * bases)), f"{count} Gaussians")
    places, opacities, colours, scales, turns, higher = _tables(file, count, widths)
    if not flags & MORE and file.read(1):
        raise StageError(f"{path} is longer than its header says", AGAIN, [f"{count} Gaussians of degree {degree}"])
    whole = np.zeros((count, 3, 4), np.uint8)
    whole[..., 1:] = places.reshape(count, 3, 3)
    unpack: Callable[[np.ndarray], np.ndarray] = _unpack_turns if version == VERSION else _unpack_turns_2
    least, steps = LOGS
    return Scene(
        means=(whole.view("<i4")[..., 0] / np.float64(1 << 8 + fraction)).astype(np.float32),
        quats=unpack(turns).astype(np.float32),
        scales=np.exp(scales / np.float32(steps) + np.float32(least)),
        opacities=opacities[:, 0] / np.float32(255),
        sh0=(colours / np.float32(255) - np.float32(0.5)) / np.float32(COLOUR),
        shN=((higher.astype(np.float32) - 128) / 128).reshape(count, bases, 3),
        antialias=bool(flags & ANTIALIAS),
    )


def _tables(file: gzip.GzipFile, count: int, widths: tuple[int, ...]) -> Iterator[np.ndarray]:
    for width in widths:
        data = file.read(count * width)
        if len(data) != count * width:
            raise EOFError(f"a table of {count} x {width} bytes ends after {len(data)}")
        yield np.frombuffer(data, np.uint8).reshape(count, width)


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
