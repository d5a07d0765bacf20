"""Damage to the bytes of a file, decided by a random generator: what a bad disk, a broken writer or a forger leaves."""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Random = np.random.Generator
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
TOKEN = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*|-?\d[\d.eE+-]*")
LIES = [b"-1", b"0", b"1", b"3", b"255", b"65536", b"2147483648", b"4294967295", b"99999999999", b"18446744073709551616",
        b"1e999", b"-1e30", b"nan", b"inf", b"0x10", b"", b"null", b"true", b"[]", b"{}", b'"a"', b"../../x", b"/x"]  # fmt: skip


def flipped(data: bytes, rng: Random) -> bytes:
    """A few bytes with other values, near each other or anywhere."""
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2, 4, 16]))):
        out[at(out, rng)] ^= int(rng.choice([1, 2, 4, 8, 16, 32, 64, 128, 255]))
    return bytes(out)


def truncated(data: bytes, rng: Random) -> bytes:
    """The first part only."""
    return data[: at(data, rng)]


def cut(data: bytes, rng: Random) -> bytes:
    """A part left out."""
    start, end = part(data, rng)
    return data[:start] + data[end:]


def doubled(data: bytes, rng: Random) -> bytes:
    """A part twice."""
    start, end = part(data, rng)
    return data[:end] + data[start:end] + data[end:]


def moved(data: bytes, rng: Random) -> bytes:
    """A part over another place."""
    start, end = part(data, rng)
    to = at(data, rng)
    return (data[:to] + data[start:end] + data[to + end - start :])[: len(data)]


def zeroed(data: bytes, rng: Random) -> bytes:
    """A part that the disk lost."""
    start, end = part(data, rng)
    return data[:start] + bytes(end - start) + data[end:]


def huge(data: bytes, rng: Random) -> bytes:
    """A binary number (a size, a count, an offset, a float) with an extreme value."""
    form = one_of(["<H", ">H", "<I", ">I", "<Q", ">Q"], rng)
    size = struct.calcsize(form)
    bits = 8 * size
    value = one_of([0, 1, 1 << bits - 1, (1 << bits - 1) - 1, (1 << bits) - 1, 1 << bits // 2, 1 << 3 * bits // 4], rng)
    place = at(data, rng)
    return data[:place] + struct.pack(form, value) + data[place + size :]


def lied(data: bytes, rng: Random) -> bytes:
    """A written number replaced by an extreme one; what follows stays in its place where blanks leave room for it."""
    found = [match.span() for match in NUMBER.finditer(data)]
    if not found:
        return flipped(data, rng)
    start, end = found[int(rng.integers(min(len(found), int(rng.choice([8, len(found)])))))]
    lie = one_of(LIES, rng)
    rest, longer = data[end:], len(lie) - (end - start)
    blanks = rest.find(b" " * longer) if longer > 0 else -1
    if 0 <= blanks < 200:
        rest = rest[:blanks] + rest[blanks + longer :]
    return data[:start] + lie + rest


def swapped(data: bytes, rng: Random) -> bytes:
    """Two words exchanged."""
    found = [match.span() for match in TOKEN.finditer(data)]
    if len(found) < 2:
        return flipped(data, rng)
    first, second = sorted(rng.choice(len(found), 2, replace=False))
    (a, b), (c, d) = found[first], found[second]
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def lines(data: bytes, rng: Random) -> bytes:
    """A line left out, twice, or in another's place."""
    rows = data.split(b"\n")
    first, second = (int(i) for i in rng.integers(len(rows), size=2))
    how = int(rng.integers(3))
    if how == 0:
        del rows[first]
    elif how == 1:
        rows.insert(second, rows[first])
    else:
        rows[first], rows[second] = rows[second], rows[first]
    return b"\n".join(rows)


def one_of(choices: Sequence[Any], rng: Random) -> Any:
    """One of them, each as likely."""
    return choices[int(rng.integers(len(choices)))]


def at(data: bytes | bytearray, rng: Random) -> int:
    """A place in the file; headers, at the beginning, are twice as likely."""
    return int(rng.integers(min(len(data), 64) if rng.random() < 0.5 else len(data))) if data else 0


def part(data: bytes, rng: Random) -> tuple[int, int]:
    """Beginning and end of a part of the file, mostly a short one."""
    start = at(data, rng)
    return start, min(len(data), start + int(rng.choice([1, 2, 4, 16, 64, 1024])))


DAMAGE: list[Callable[[bytes, Random], bytes]] = [
    flipped, truncated, cut, doubled, moved, zeroed, huge, lied, lied, swapped, lines,
]  # fmt: skip


def mutated(data: bytes, rng: Random) -> bytes:
    """One to three kinds of damage; half of the archives and PNGs are damaged inside, their checksums made right again."""
    inside = rng.random() < 0.5
    if inside and data[:2] == b"PK":
        return in_archive(data, rng)
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        data = one_of(DAMAGE, rng)(data, rng) if data else data
    return with_checksums(data) if inside and data[:4] == b"\x89PNG" else data


def in_archive(data: bytes, rng: Random) -> bytes:
    """A zip archive with one damaged, renamed, missing or doubled member."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    chosen = int(rng.integers(len(members)))
    name, content = members[chosen]
    how = rng.random()
    if how < 0.8:
        members[chosen] = (name, mutated(content, rng))
    elif how < 0.9:
        members[chosen] = (one_of(["../../x.npy", "/x.npy", "x", *(n for n, _ in members)], rng), content)
    else:
        del members[chosen]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if how < 0.4 else zipfile.ZIP_STORED) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


def with_checksums(data: bytes) -> bytes:
    """A PNG whose chunks, as far as they can be followed, have the checksums of what is in them."""
    out, place = bytearray(data), 8
    while place + 12 <= len(out):
        end = place + 8 + int.from_bytes(out[place : place + 4], "big")
        if end + 4 > len(out):
            break
        out[end : end + 4] = zlib.crc32(out[place + 4 : end]).to_bytes(4, "big")
        place = end + 4
    return bytes(out)
