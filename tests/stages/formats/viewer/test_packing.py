"""Packed arrays, read back as the page reads them."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.formats.viewer.packing import HALF, LARGEST_SLOPE, Packer, slopes_in_words, smallest_three
from stages.records import Slopes

WIDTHS = {"u8": 1, "u16": 2, "u24": 3, "u32": 4}


def unpack(packer: Packer, name: str) -> np.ndarray:
    """As page/arrays.js does."""
    entry, data = packer.table[name], gzip.decompress(packer.data)
    rows, size = entry["shape"][0], int(np.prod(entry["shape"]))
    if entry["kind"] == "f32":
        return np.frombuffer(data[entry["at"] : entry["at"] + 4 * size], "<f4").reshape(entry["shape"])
    width, columns = WIDTHS[entry["kind"]], int(np.prod(entry["shape"][1:]))
    planes = np.frombuffer(data[entry["at"] : entry["at"] + size * width], "u1").reshape(columns, width, rows)
    whole = (planes.astype(np.int64) << (8 * np.arange(width))[:, None]).sum(1).T
    found = whole * entry["step"] + entry["low"] if "step" in entry else whole
    return found.reshape(entry["shape"])


def quaternions(bits: np.ndarray) -> np.ndarray:
    """w x y z, as page/arrays.js reads them."""
    found = np.zeros((len(bits), 4))
    for i, word in enumerate(bits.tolist()):
        largest, shift = word >> 30, 20
        for part in range(4):
            if part != largest:
                found[i, part] = ((word >> shift & 1023) / 1023 * 2 - 1) * HALF
                shift -= 10
        found[i, largest] = np.sqrt(1 - (found[i] ** 2).sum())
    return found[:, [3, 0, 1, 2]]


@pytest.mark.parametrize("bits", [8, 16, 24])
def test_numbers_are_off_by_half_a_step_at_most(bits):
    values = np.random.default_rng(1).normal(size=(50, 3)) * [1, 10, 1000]
    packer = Packer()
    packer.whole("first", np.arange(7))  # nothing stands where it is easy
    packer.scaled("values", values, bits)
    step = np.ptp(values, axis=0) / (2**bits - 1)
    assert (np.abs(unpack(packer, "values") - values) <= 0.501 * step).all()


def test_whole_and_exact_numbers_stay():
    packer, whole = Packer(), np.array([[0, 255], [256, 2**32 - 1]])
    packer.whole("whole", whole, 32)
    packer.exact("exact", np.array([[1.5, -2.0]]))
    packer.scaled("same", np.full((3, 1), 7.25), 16)
    np.testing.assert_array_equal(unpack(packer, "whole"), whole)
    np.testing.assert_array_equal(unpack(packer, "exact"), [[1.5, -2.0]])
    np.testing.assert_array_equal(unpack(packer, "same"), np.full((3, 1), 7.25))


def test_none_is_packed_too():
    packer = Packer()
    packer.scaled("none", np.zeros((0, 3)), 16)
    assert unpack(packer, "none").shape == (0, 3)


def test_rotations_are_off_by_a_quarter_of_a_degree_at_most():
    quats = np.random.default_rng(2).normal(size=(400, 4)) * 3
    quats = np.concatenate([quats, np.eye(4), -np.eye(4), np.full((1, 4), 0.5)])
    found = quaternions(smallest_three(quats))
    true, read = (Rotation.from_quat(q, scalar_first=True) for q in (quats, found))
    assert np.degrees((true.inv() * read).magnitude()).max() < 0.25


def test_slopes_come_back_within_a_step_and_flat_ones_end_a_row():
    rng, step = np.random.default_rng(3), LARGEST_SLOPE / 127
    slopes = rng.uniform(-LARGEST_SLOPE, LARGEST_SLOPE, (40, 5, 3))
    slopes[:, 3:] = 0.4 * step
    slopes[0, 0] = [LARGEST_SLOPE, -LARGEST_SLOPE, 0]
    packer = Packer()
    packer.whole(
        "slopes", slopes_in_words(Slopes(np.arange(40), rng.integers(0, 48, (40, 5)).astype(np.uint8), slopes)), 32
    )
    words = unpack(packer, "slopes")
    assert (words[:, 3:] == 0).all() and (words[:, :3] != 0).all()
    back = np.stack([(words >> shift & 255) - 128 for shift in (8, 16, 24)], 2) * step
    np.testing.assert_allclose(back[:, :3], slopes[:, :3], atol=0.5 * step + 1e-9)
    assert (words[:, :3] & 255 < 48).all()
