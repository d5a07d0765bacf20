"""COCO's polygons and run lengths: the same pixels as drawn one by one, in time and memory that follow their size."""

from __future__ import annotations

import json
import time
import tracemalloc

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.given_masks.coco import LARGEST, LETTERS, WORK, decode, polygons, read_coco, run_lengths
from tests.made import mask_files as files
from tests.made.said import holds


def one_by_one(parts, height, width):
    """A pixel is in a polygon if a ray from its centre to the right crosses an odd number of sides."""
    mask = np.zeros((height, width), bool)
    for part in parts:
        corners = np.reshape(part, (-1, 2)).astype(float)
        inside = np.zeros((height, width), bool)
        y, x = np.mgrid[:height, :width] + 0.5
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
            if y0 != y1:
                spans = (y >= min(y0, y1)) & (y < max(y0, y1))
                inside ^= spans & (x >= x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        mask |= inside
    return mask


@pytest.mark.parametrize("seed", range(20))
def test_polygons_are_filled_by_the_even_odd_rule_and_joined(seed):
    rng = np.random.default_rng(seed)
    parts = [rng.uniform(-20, 60, 2 * rng.integers(3, 9)).tolist() for _ in range(rng.integers(1, 5))]
    parts += [rng.integers(0, 40, 12).astype(float).tolist()]  # sides through corners and along rows
    np.testing.assert_array_equal(polygons(parts, 30, 40, "x"), one_by_one(parts, 30, 40))


def test_no_polygon_marks_nothing():
    assert not polygons([], 4, 5, "x").any() and polygons([], 4, 5, "x").shape == (4, 5)


@pytest.mark.parametrize("far", [1e300, 2e6, float("inf")])
def test_corners_far_from_any_picture_are_refused(far):
    with pytest.raises(StageError, match="invalid polygon"):
        polygons([[0, 0, far, 0, 5, 5]], 9, 10, "annotation 1")


def test_a_short_polygon_of_a_large_picture_takes_little_memory():
    side = 4096
    tracemalloc.start()
    mask = polygons([[0, 0, side, 0, 0, side]], side, side, "x")
    assert tracemalloc.get_traced_memory()[1] < 1.2 * mask.size
    tracemalloc.stop()
    assert mask.mean() == pytest.approx(0.5, abs=1e-3)


def test_a_polygon_of_many_sides_is_refused_before_it_takes_memory(monkeypatch):
    monkeypatch.setattr(Budget.__init__, "__defaults__", (0, 1 << 20))
    zigzag = [[x, 1000 * (x % 2)] for x in range(40)]
    tracemalloc.start()
    with pytest.raises(StageError, match=r"\bannotation 7\b.*memory") as caught:
        polygons([np.ravel(zigzag).tolist()], 1000, 1000, "annotation 7")
    assert tracemalloc.get_traced_memory()[1] < 1 << 18 and holds(caught.value.facts[0], "40 corners")
    tracemalloc.stop()


def test_run_lengths_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    for top in (3, 40, 1 << 28):
        counts = rng.integers(0, top, 300).tolist()
        assert run_lengths(files.text(counts), "x") == counts
    assert run_lengths("", "x") == [] and max(len(files.text([n])) for n in (LARGEST**2, 0)) == LETTERS


def test_a_run_length_of_many_letters_is_refused_at_once():
    start = time.process_time()
    with pytest.raises(StageError, match="not run lengths") as caught:
        run_lengths("o" * 300_000 + "0", "annotation 3")
    assert "300001 letters" in caught.value.facts[0] and time.process_time() - start < 5
    with pytest.raises(StageError, match="not COCO's text"):
        run_lengths("00\ud800", "annotation 3")


def test_long_run_lengths_take_a_time_that_follows_their_length():
    counts = np.random.default_rng(0).integers(0, 2, 600_000).tolist()
    counts[-1] += 1024 * 1024 - sum(counts)
    text = files.text(counts)
    start = time.process_time()
    mask = decode({"size": [1024, 1024], "counts": text}, 1024, 1024, "x")
    assert time.process_time() - start < 20 and mask.sum() == sum(counts[1::2])


def instances(path, side, count, **image):
    full = {"size": [side, side], "counts": [side * side]}
    images = [{"id": i, "file_name": f"{i:06d}.jpg", "height": side, "width": side} | image for i in range(count)]
    shown = [{"image_id": i, "category_id": 1, "track_id": 1, "segmentation": full} for i in range(count)]
    path.write_text(json.dumps({"images": images, "annotations": shown}))
    return path


def test_masks_together_larger_than_any_clip_are_refused(tmp_path):
    assert WORK > 10 * 60 * 30 * 1920 * 1080
    fits = WORK // LARGEST**2
    read_coco(instances(tmp_path / "a.json", LARGEST, fits))
    with pytest.raises(StageError, match="too much memory") as caught:
        read_coco(instances(tmp_path / "a.json", LARGEST, fits + 1))
    assert f"annotation {fits}," in caught.value.facts[0]


def test_a_name_of_thousands_of_digits_is_a_name(tmp_path):
    found = read_coco(instances(tmp_path / "a.json", 4, 1, file_name=f"{'7' * 5000}.jpg"))
    assert found.names == ("7" * 5000,) and found.read("1", 0)[0].shape == (4, 4)


def test_parts_of_one_object_are_joined(tmp_path):
    path = instances(tmp_path / "a.json", 6, 1)
    content = json.loads(path.read_text())
    first, second = ({"image_id": 0, "track_id": 4, "segmentation": [part]} for part in (
        [0, 0, 2, 0, 2, 2, 0, 2], [4, 4, 6, 4, 6, 6, 4, 6]))  # fmt: skip
    path.write_text(json.dumps(content | {"annotations": [first, second]}))
    mask, kind = read_coco(path).read("4", 0)
    want = np.zeros((6, 6), np.uint8)
    want[:2, :2] = want[4:, 4:] = 1
    np.testing.assert_array_equal(mask, want)
    assert kind == "COCO" and mask.dtype == np.uint8
