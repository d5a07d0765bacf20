"""Lengths that files claim, of every kind: refused, or no more work than they are worth, before memory is taken."""

import json
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.budget import MOST, check_count
from stages.formats.exchange.glb import Arrays, write_glb
from stages.formats.given_cameras.record import widest_angles
from stages.formats.given_masks.coco import read_coco


@pytest.mark.parametrize("kind", MOST)
def test_as_many_as_there_may_be_and_not_one_more(kind):
    check_count(MOST[kind], kind, "x")
    for count in (MOST[kind] + 1, 1e30, float("inf"), float("nan")):
        with pytest.raises(StageError, match=rf"\bx\b.*{kind}"):
            check_count(count, kind, "x")


def test_a_point_that_is_seen_as_often_as_a_file_says_makes_no_table_of_that_size():
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(40, 3))
    points = 10 * rng.normal(size=(3, 3))
    tracks = [np.arange(40), rng.integers(0, 40, 200_000), np.zeros(200_000, int)]
    tracemalloc.start()
    began = time.perf_counter()
    found = widest_angles(points, tracks, centers)
    assert tracemalloc.get_traced_memory()[1] < 50e6 and time.perf_counter() - began < 5
    tracemalloc.stop()
    rays = [center - points[0] for center in centers]
    wide = max(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)) for a in rays for b in rays)
    np.testing.assert_allclose(
        found, [np.degrees(wide), widest_angles(points[1:2], [np.arange(40)], centers)[0], 0], atol=1e-6
    )
    many = rng.normal(size=(20_000, 3))
    assert widest_angles(np.zeros((1, 3)), [np.arange(20_000)], many)[0] == pytest.approx(180, abs=15)


def test_masks_of_thousands_of_tracks_are_refused(tmp_path):
    size = {"height": 4, "width": 4}
    images = [{"id": i, "file_name": f"{i:06d}.png", **size} for i in range(10)]
    parts = [
        {"id": i, "image_id": i % 10, "category_id": 1, "track_id": i, "segmentation": [[0, 0, 1, 0, 1, 1]]}
        for i in range(MOST["tracks"] + 1)
    ]
    (tmp_path / "a.json").write_text(json.dumps({"images": images, "annotations": parts}))
    with pytest.raises(StageError, match="has too many tracks"):
        read_coco(tmp_path / "a.json")


def test_a_glb_holds_no_more_than_its_header_can_say(tmp_path):
    class Huge(bytearray):
        def __len__(self) -> int:
            return 1 << 32

    arrays = Arrays()
    arrays.data = Huge()
    with pytest.raises(StageError, match=r"a\.glb.*large"):
        write_glb(tmp_path / "a.glb", {}, arrays)
    assert not Path(tmp_path / "a.glb").exists()


def test_an_error_is_no_longer_than_one_reads():
    error = StageError("x" * 10_000_000, "hint", ["y" * 5000, "short"])
    assert len(str(error)) < 4200 and "10,000,000 letters" in error.problem
    assert len(error.facts[0]) < 2100 and error.facts[1] == "short"
