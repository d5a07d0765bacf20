"""Arrays packed for a page: few bits a number, each column's bytes in planes, gzipped. `page/arrays.js` reads them."""

from __future__ import annotations

import gzip
import math
from typing import Any

import numpy as np

from stages.records import SH_C0, Scene, Slopes

HALF = 0.5**0.5
LARGEST_SLOPE = 8.0  # 1/m: no part of a slope is larger; `page/skin.js` has it, too


class Packer:
    """Gathers named arrays; `table` says where each lies in `data` and what its numbers mean."""

    def __init__(self) -> None:
        self.table: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def exact(self, name: str, values: np.ndarray) -> None:
        """Keep `values` as float32."""
        self._put(name, "f32", values.shape, np.ascontiguousarray(values, "<f4").tobytes())

    def whole(self, name: str, values: np.ndarray, bits: int = 8) -> None:
        """Keep unsigned whole numbers [N,...] below 2^`bits`, a multiple of 8."""
        rows, width = len(values), bits // 8
        columns = np.ascontiguousarray(values, "<u4").reshape(rows, math.prod(values.shape[1:])).T
        planes = np.ascontiguousarray(columns).view("u1").reshape(*columns.shape, 4)[..., :width]
        self._put(name, f"u{bits}", values.shape, planes.transpose(0, 2, 1).tobytes())

    def scaled(self, name: str, values: np.ndarray, bits: int) -> None:
        """Keep numbers [N,K] as steps of equal size between the least and the largest of each column."""
        values = np.asarray(values, np.float64)
        low, high = (part(values, axis=0, initial=start) for part, start in ((np.min, np.inf), (np.max, -np.inf)))
        low, high = (np.where(np.isfinite(end), end, 0.0) for end in (low, high))
        step = np.where(high > low, high - low, 1.0) / (2**bits - 1)
        self.whole(name, np.rint((values - low) / step), bits)
        self.table[name] |= {"low": low.tolist(), "step": step.tolist()}

    def around(self, name: str, values: np.ndarray) -> None:
        """Keep numbers [N,K] in 8 bits, as steps of equal size around 0, which stays 0; each column has its own."""
        step = np.maximum(np.abs(np.asarray(values, np.float64)).max(0, initial=0.0), np.float32(1e-9)) / 127
        self.whole(name, np.rint(values / step) + 128)
        self.table[name] |= {"low": (-128 * step).tolist(), "step": step.tolist()}

    def gaussians(self, name: str, of: Scene, bits: int) -> None:
        """Keep what a picture needs of Gaussians, centres with `bits`; colours as seen without their view dependence."""
        self.scaled(f"{name}/means", of.means, bits)
        self.scaled(f"{name}/logscales", np.log(np.maximum(of.scales, np.float32(1e-9))), 16)
        self.whole(f"{name}/quats", smallest_three(of.quats), 32)
        self.scaled(f"{name}/opacities", np.asarray(of.opacities)[:, None], 16)
        self.scaled(f"{name}/colors", np.maximum(0.5 + SH_C0 * np.asarray(of.sh0, np.float64), 0), 16)

    @property
    def data(self) -> bytes:
        """All of it, gzipped without a date."""
        return gzip.compress(b"".join(self._parts), 9, mtime=0)

    def _put(self, name: str, kind: str, shape: tuple[int, ...], data: bytes) -> None:
        self.table[name] = {"kind": kind, "shape": list(shape), "at": self._size}
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._size += len(padded)


def smallest_three(quats: np.ndarray) -> np.ndarray:
    """Quaternions [N,4], w x y z, of any length above 0, in 32 bits: which part is largest, the others at 10 bits each.

    Parts are numbered x y z w. The largest is made positive, since q and -q turn alike.
    """
    q = np.asarray(quats, np.float64)[:, [1, 2, 3, 0]]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    rows, largest = np.arange(len(q)), np.abs(q).argmax(1)
    q = q * np.where(q[rows, largest] < 0, -1, 1)[:, None]
    bits = largest.astype(np.uint32)
    for part in range(4):
        steps = np.rint((q[:, part] / HALF + 1) / 2 * 1023).clip(0, 1023).astype(np.uint32)
        bits = np.where(largest == part, bits, (bits << 10) | steps).astype(np.uint32)
    return bits


def slopes_in_words(found: Slopes) -> np.ndarray:
    """Of C Gaussians of cloth a word [C,M] for each bone: its number, then three parts of its slope with 8 bits each.

    A part is a step of LARGEST_SLOPE / 127 beside 128. A slope of no step is the word 0, which ends a row: the steepest come first.
    """
    steps = np.rint(np.asarray(found.slopes, np.float64) / LARGEST_SLOPE * 127).clip(-127, 127).astype(np.int64)
    parts = (steps + 128).astype(np.uint32)
    words = found.bones.astype(np.uint32) | parts[..., 0] << 8 | parts[..., 1] << 16 | parts[..., 2] << 24
    return np.where(steps.any(2), words, 0).astype(np.uint32)
