"""PLY files of 3D Gaussians, in the layout that viewers and editors read and trainers write.

Gaussians that were learned for another drawing are read as what draws them so: with anti-aliasing where a comment says
it (Brush, PlayCanvas: `SplatRenderMode: mip`, which we write, too; Postshot: `antialiased 1`, `postshot.anti_aliasing=1`);
those of Mip-Splatting with a column filter_3D widened by it, and as much fainter as they grow; flat ones (2D Gaussians, two
scales) as thin discs, which is said.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.points import elements
from stages.formats.splats import HINT as TRAIN_AGAIN
from stages.formats.splats import impossible
from stages.records import Scene

REST = 15  # higher coefficients a channel: many viewers take degree 3 only, so lower degrees are padded with zeros
CHUNK = 1 << 14  # rows made at a time, so that ten million need no more memory than these
HEADER = 1 << 16  # bytes in which a header ends
CONVERT = "`npx @playcanvas/splat-transform FILE out.ply` writes it as a plain .ply"
HINT = "give a .ply or .spz of 3D Gaussians, as trainers and SuperSplat write them"
AGAIN = "write it again with the program that made it"
REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
THIRD = REQUIRED.index("scale_2")
OPACITY_LOGIT = 15.0  # float32 cannot hold the logits of 0 and 1
FLAT = 1e-3  # thickness of a disc, of its smaller scale
WRONG = 0.05  # share of rows that cannot be drawn, up to which the others are taken
LISTED = 10  # rows that a message names
FORMS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
MIP = "comment SplatRenderMode: mip"
TOLD = re.compile(r"comment\s+(?:splatrendermode:|antialiased|postshot\.anti_aliasing=)\s*(\w+)\s*", re.IGNORECASE)


def _names(rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * rest)]
    return [*names, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: Path, splats: Scene, padded: bool = True) -> dict[str, int]:
    """Write Gaussians as binary PLY in the layout of 3DGS; says what was clamped, in words, and how often.

    `padded` writes columns of degree 3, whatever the Gaussians have. Opacity is stored as its logit (bounded at +-15),
    scales as logarithms, rotation as w x y z, higher harmonics channel by channel. StageError for what is `impossible`.
    """
    if facts := impossible(splats):
        raise StageError("Gaussians that no file can hold", TRAIN_AGAIN, facts)
    mip = [MIP] if splats.antialias else []
    head = ["ply", "format binary_little_endian 1.0", *mip, f"element vertex {len(splats)}"]
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

    Binary in either byte order or a text, with any other elements. Quaternions are normalised; coefficients that are 0 for
    all Gaussians are left out, and so are rows that cannot be drawn, which is said, up to a share of WRONG. StageError for
    more of them, with their numbers, for a file that is no such PLY, and for one of another length than its header says.
    """
    try:
        with Path(path).open("rb") as file:
            head, there = _header(file, path), Path(path).stat().st_size
            columns = head.row.names or ()
            bases = _bases(columns, path)
            names = [*REQUIRED, *(f"f_rest_{i}" for i in range(3 * bases)), "filter_3D"]
            least = head.rows * (head.row.itemsize if head.order else 2 * len(columns))
            if there - head.start < least:
                raise _longer_or_shorter(head, path, f"{least} bytes at least, {there - head.start} follow the header")
            Budget(path, there).spend(4 * len(names) * head.rows, f"{head.rows} Gaussians")
            table = np.zeros((head.rows, len(names)), np.float32)
            for start, rows in _rows(file, head, path, there):
                with np.errstate(over="ignore"):  # a double too large for a float cannot be drawn
                    for column, name in enumerate(names):
                        if name in columns:
                            table[start : start + len(rows), column] = rows[name]
    except OSError as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    said: tuple[str, ...] = ()
    if "scale_2" not in columns:
        table[:, THIRD] = table[:, THIRD - 2 : THIRD].min(1) + np.log(FLAT)
        said = (
            f"{Path(path).name} holds 2D Gaussians (two scales): drawn as discs, {FLAT:g} of their smaller scale thick",
        )
    return _scene(table, bases, path, head.antialias, said)


class _Head(NamedTuple):
    """What a header says: where the content begins; the bytes (lines of a text) before the vertices, and those after them, None
    where lists leave that open; how many vertices, their layout, their byte order, "" of a text; and whether with anti-aliasing.
    """

    start: int
    before: int
    after: int | None
    rows: int
    row: np.dtype
    order: str
    antialias: bool


def _longer_or_shorter(head: _Head, path: Path, fact: str) -> StageError:
    return StageError(f"{path} has another length than its header says", AGAIN, [f"{head.rows} Gaussians make {fact}"])


def _header(file: IO[bytes], path: Path) -> _Head:
    found = re.match(rb"ply[ \t]*(\r\n|\n|\r)(.*?\1)??end_header[ \t]*\1", file.read(HEADER), re.DOTALL)
    if found is None:
        raise StageError(f"{path} is no PLY", HINT, ["it does not begin with a PLY header that ends in `end_header`"])
    text = found[0].decode("ascii", "replace").splitlines()
    lines = [line.split() for line in text]
    form = next((" ".join(line[1:]) for line in lines if line[:1] == ["format"]), "none").removesuffix(" 1.0")
    if form not in FORMS:
        raise StageError(f"{path} is a PLY of an unknown form", HINT, [f"its format: {form[:60]}"])
    if any(line[-1:] == ["packed_position"] for line in lines):
        raise StageError(f"{path} is a compressed PLY", f"convert it: {CONVERT}", ["it has packed_position columns"])
    try:
        tables = elements(lines)
        place = [one.name for one in tables].index("vertex")
        (_, count, row), order = tables[place], FORMS[form]
        if row is None or (order and any(one.row is None for one in tables[:place])):
            raise ValueError("it has lists among its vertices or before them")
    except (ValueError, IndexError) as error:
        raise StageError(f"the header of {path} cannot be read", HINT, [str(error)]) from error
    missing = [name for name in REQUIRED if name not in (row.names or ()) and name != "scale_2"]
    if missing:
        facts = [f"missing: {', '.join(missing)}", f"it has {', '.join(row.names or ())[:400]}"]
        raise StageError(f"{path} holds no 3D Gaussians", HINT, facts)
    sizes = [one.rows * (one.row.itemsize if order and one.row else 1) for one in tables]
    after = None if any(one.row is None for one in tables) else sum(sizes[place + 1 :])
    told = [said for line in text if (said := TOLD.fullmatch(line))]
    antialias = "filter_3D" in (row.names or ()) or bool(told and told[-1][1].lower() in ("mip", "1"))
    return _Head(
        found.end(), sum(sizes[:place]), after, count, row.newbyteorder(">") if order == ">" else row, order, antialias
    )


def _rows(file: IO[bytes], head: _Head, path: Path, there: int) -> Iterator[tuple[int, np.ndarray]]:
    """The vertices part by part, and which row each begins with; StageError where the file holds fewer or more than it says."""
    file.seek(head.start + (head.before if head.order else 0))
    if head.order:
        wanted = head.start + head.before + head.rows * head.row.itemsize + (head.after or 0)
        if there < wanted or (there > wanted and head.after is not None):
            raise _longer_or_shorter(head, path, f"{wanted} bytes, with all else in it; the file has {there}")
    elif any(not file.readline() for _ in range(head.before)):
        raise _longer_or_shorter(head, path, "no file that ends before them")
    width = len(head.row.names or ())
    for start in range(0, head.rows, CHUNK):
        count = min(CHUNK, head.rows - start)
        if head.order:
            yield start, np.fromfile(file, head.row, count)
            continue
        values = np.zeros(0)
        with suppress(ValueError), warnings.catch_warnings():  # of what is no number, where older numpy only stops
            warnings.simplefilter("ignore", DeprecationWarning)
            values = np.fromfile(file, np.float64, count * width, sep=" ")
        if len(values) < count * width:
            raise _longer_or_shorter(head, path, f"{head.rows} lines of {width} numbers, and one after {start} is none")
        yield start, values.view([(name, np.float64) for name in head.row.names or ()])
    if not head.order and head.after == 0 and file.read(CHUNK).strip():
        raise _longer_or_shorter(head, path, f"{head.rows} lines, and more follow")


def _bases(names: Sequence[str], path: Path) -> int:
    """Higher coefficients a channel."""
    found = sum(name.startswith("f_rest_") for name in names)
    if found not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(found)):
        facts = [f"{found} columns f_rest_0 and so on; degrees 0 to 3 have 0, 9, 24 and 45"]
        raise StageError(f"{path} has an unknown degree of spherical harmonics", HINT, facts)
    return found // 3


def _scene(table: np.ndarray, bases: int, path: Path, antialias: bool, said: tuple[str, ...]) -> Scene:
    """The scene in the columns REQUIRED, f_rest_... and filter_3D; logits, logarithms and quaternions are taken back."""
    means, sh0, logits, logs, quats, rest, filters = np.split(table, [3, 6, 7, 10, 14, 14 + 3 * bases], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        opacities, scales = _widened(1 / (1 + np.exp(-logits[:, 0])), np.exp(logs), filters)
        lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    drawn = np.isfinite(means).all(1) & np.isfinite(sh0).all(1) & np.isfinite(rest).all(1) & np.isfinite(opacities)
    drawn &= (np.isfinite(scales) & (scales > 0)).all(1) & (np.isfinite(lengths) & (lengths > 0))[:, 0]
    wrong = np.flatnonzero(~drawn)
    if len(wrong):
        named = ", ".join(map(str, wrong[:LISTED])) + (" ..." if len(wrong) > LISTED else "")
        if len(wrong) > WRONG * len(drawn):
            values = ", ".join(f"{name} {value:g}" for name, value in zip(REQUIRED, table[wrong[0]], strict=False))
            facts = [f"row {wrong[0]}: {values}", f"rows {named}", f"up to {WRONG:.0%} of all would be left out"]
            problem = f"{path} has {len(wrong)} Gaussians of {len(drawn)} that cannot be drawn"
            raise StageError(problem, AGAIN, facts)
        said += (
            f"{Path(path).name}: {len(wrong)} of {len(drawn)} Gaussians cannot be drawn and are left out: rows {named}",
        )
        means, sh0, rest, quats, lengths = (part[drawn] for part in (means, sh0, rest, quats, lengths))
        opacities, scales = opacities[drawn], scales[drawn]
    shN = rest.reshape(len(rest), 3, bases).transpose(0, 2, 1)
    used = next((end for start, end in ((8, 15), (3, 8), (0, 3)) if shN[:, start:end].any()), 0)
    higher = np.ascontiguousarray(shN[:, :used])
    return Scene(means, quats / lengths, scales, opacities, sh0, higher, antialias=antialias, said=said)


def _widened(opacities: np.ndarray, scales: np.ndarray, filters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacities [N] and scales [N,3] of Gaussians smoothed by `filters` [N,1], a standard deviation: as much fainter as larger."""
    if not filters.any():
        return opacities, scales
    wide = np.hypot(scales, filters)
    return opacities * (scales / wide).prod(1), wide
