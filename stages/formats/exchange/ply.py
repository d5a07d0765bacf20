"""PLY files of 3D Gaussians, in the layout that viewers and editors read and trainers write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.points import vertex_layout
from stages.records import Scene

REST = 15  # higher coefficients a channel: many viewers take degree 3 only, so lower degrees are padded with zeros
CHUNK = 1 << 14  # rows made at a time, so that ten million need no more memory than these
HEADER = 1 << 16  # bytes in which a header ends
CONVERT = "`npx @playcanvas/splat-transform FILE out.ply` writes it as a plain .ply"
HINT = f"give a .ply or .spz of 3D Gaussians, as trainers and SuperSplat write them; {CONVERT}"
REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
OPACITY_LOGIT = 15.0  # float32 cannot hold the logits of 0 and 1


def _names(rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * rest)]
    return [*names, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: Path, splats: Scene, padded: bool = True) -> dict[str, int]:
    """Write Gaussians as binary PLY in the layout of 3DGS; says what was clamped, in words, and how often.

    `padded` writes columns of degree 3, whatever the Gaussians have. Opacity is stored as its logit (bounded at +-15),
    scales as logarithms, rotation as w x y z, higher harmonics channel by channel. Raises StageError when a scale is not
    positive or an opacity not in 0..1.
    """
    if not ((splats.opacities >= 0) & (splats.opacities <= 1)).all():
        row = int(np.flatnonzero(~((splats.opacities >= 0) & (splats.opacities <= 1)))[0])
        raise StageError(
            "a Gaussian has an opacity that is not between 0 and 1",
            "train again: `hugs run VIDEO train --force`",
            [f"row {row}: {splats.opacities[row]}"],
        )
    if not (splats.scales > 0).all():
        row = int(np.argwhere(~(splats.scales > 0))[0, 0])
        raise StageError(
            "a Gaussian has a scale that is not positive",
            "train again: `hugs run VIDEO train --force`",
            [f"row {row}: {splats.scales[row].tolist()}"],
        )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    rest = REST if padded else splats.shN.shape[1]
    head += [f"property float {name}" for name in _names(rest)]
    bounded = 0
    with Path(path).open("wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode())
        for start in range(0, len(splats), CHUNK):
            table, more = _table(splats, slice(start, start + CHUNK), rest)
            file.write(table.tobytes())
            bounded += more
    return {"with opacities of 0 or 1, as logits of +-15": bounded} if bounded else {}


def _table(splats: Scene, rows: slice, bases: int) -> tuple[np.ndarray, int]:
    """The file's columns of some rows, float32, and how many opacities were bounded."""
    higher, opacities = splats.shN[rows], splats.opacities[rows].astype(np.float64)
    rest = np.zeros((len(opacities), 3, bases), np.float32)
    rest[:, :, : higher.shape[1]] = higher.transpose(0, 2, 1)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)
    bounded = np.clip(logits, -OPACITY_LOGIT, OPACITY_LOGIT)
    columns = [
        splats.means[rows],
        np.zeros((len(opacities), 3)),
        splats.sh0[rows],
        rest.reshape(len(opacities), -1),
        bounded[:, None],
        np.log(splats.scales[rows]),
        splats.quats[rows],
    ]
    return np.concatenate([np.asarray(c, "<f4") for c in columns], 1), int((bounded != logits).sum())


def read_ply(path: Path) -> Scene:
    """Read a .ply of Gaussians, ours or another trainer's: any degree, columns in any order, more columns ignored.

    Quaternions are normalised; coefficients that are 0 for all Gaussians are left out. PLY has no flag for
    anti-aliasing. StageError for a file that is no such PLY or of another length than its header says, and for values
    that are not finite, with the row.
    """
    try:
        with Path(path).open("rb") as file:
            head = _header(file, path)
            there = Path(path).stat().st_size
    except OSError as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    wanted = head.start + head.rows * head.row.itemsize
    if there != wanted:
        facts = [f"{head.rows} Gaussians of {head.row.itemsize} bytes make {wanted} bytes, the file has {there}"]
        raise StageError(f"{path} has another length than its header says", HINT, facts)
    bases = _bases(head.row.names or (), path)
    columns = 14 + 3 * bases
    Budget(path, there).spend(4 * columns * head.rows, f"{head.rows} Gaussians")
    table = np.empty((head.rows, columns), np.float32)
    names = [*REQUIRED, *(f"f_rest_{i}" for i in range(3 * bases))]
    with Path(path).open("rb") as file:
        file.seek(head.start)
        for start in range(0, head.rows, CHUNK):
            rows = np.fromfile(file, head.row, min(CHUNK, head.rows - start))
            with np.errstate(over="ignore"):  # a double too large for a float is refused below
                for column, name in enumerate(names):
                    table[start : start + len(rows), column] = rows[name]
    return _scene(table, bases, path)


class _Head(NamedTuple):
    """Where the rows begin, how many there are, and their layout."""

    start: int
    rows: int
    row: np.dtype


def _header(file: IO[bytes], path: Path) -> _Head:
    text = file.read(HEADER)
    head, mark, _ = text.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if lines[:1] != [["ply"]] or not mark:
        raise StageError(f"{path} is no PLY", HINT, ["it does not begin with a PLY header that ends in `end_header`"])
    if ["format", "binary_little_endian", "1.0"] not in lines:
        found = next((" ".join(line[1:]) for line in lines if line[:1] == ["format"]), "none")
        raise StageError(f"{path} is not a binary little-endian PLY", HINT, [f"its format: {found}"])
    if any(line[-1:] == ["packed_position"] for line in lines):
        raise StageError(f"{path} is a compressed PLY", f"convert it: {CONVERT}", ["it has packed_position columns"])
    try:
        row, count = vertex_layout(lines)
    except (ValueError, IndexError) as error:
        raise StageError(f"the header of {path} cannot be read", HINT, [str(error)]) from error
    missing = [name for name in REQUIRED if name not in (row.names or ())]
    if missing:
        facts = [f"missing: {', '.join(missing)}", f"it has {', '.join(row.names or ())}"]
        raise StageError(f"{path} holds no 3D Gaussians", HINT, facts)
    return _Head(len(head) + len(mark), count, row)


def _bases(names: Sequence[str], path: Path) -> int:
    """Higher coefficients a channel."""
    found = sum(name.startswith("f_rest_") for name in names)
    if found not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(found)):
        facts = [f"{found} columns f_rest_0 and so on; degrees 0 to 3 have 0, 9, 24 and 45"]
        raise StageError(f"{path} has an unknown degree of spherical harmonics", HINT, facts)
    return found // 3


def _scene(table: np.ndarray, bases: int, path: Path) -> Scene:
    """The scene in the columns REQUIRED and f_rest_...; their logits, logarithms and quaternions are taken back."""
    means, sh0, logits, logs, quats, rest = np.split(table, [3, 6, 7, 10, 14], axis=1)
    with np.errstate(over="ignore"):
        scales, opacities = np.exp(logs), 1 / (1 + np.exp(-logits[:, 0]))
        lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    wrong = ~(np.isfinite(means).all(1) & np.isfinite(sh0).all(1) & np.isfinite(rest).all(1) & np.isfinite(opacities))
    wrong |= ~(np.isfinite(scales) & (scales > 0)).all(1) | ~(np.isfinite(lengths) & (lengths > 0))[:, 0]
    if wrong.any():
        row = int(wrong.argmax())
        values = ", ".join(f"{name} {value:g}" for name, value in zip(REQUIRED, table[row], strict=False))
        raise StageError(f"{path} has {wrong.sum()} Gaussians that cannot be drawn", HINT, [f"row {row}: {values}"])
    shN = rest.reshape(len(rest), 3, bases).transpose(0, 2, 1)
    used = next((end for start, end in ((8, 15), (3, 8), (0, 3)) if shN[:, start:end].any()), 0)
    return Scene(means, quats / lengths, scales, opacities, sh0, np.ascontiguousarray(shN[:, :used]))
