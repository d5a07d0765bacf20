"""SIFT features: where they are, outside the mask, and the same in a moved picture."""

import cv2
import numpy as np
import pytest

from stages.estimators.cameras import colmap_features
from stages.estimators.cameras.features import sift
from stages.formats.images import write_image, write_mask
from tests.made.rooms import texture

GREY = cv2.cvtColor(texture(3)[:200, :300], cv2.COLOR_RGB2GRAY)
ALL = np.full(GREY.shape, 255, np.uint8)


def test_a_blob_is_found_at_its_middle_counted_from_the_corner_of_the_first_pixel():
    y, x = np.mgrid[:101, :121] + 0.5
    blob = (200 * np.exp(-((x - 60.5) ** 2 + (y - 40.25) ** 2) / (2 * 4.0**2))).astype(np.uint8)
    spots, _ = sift(blob, np.full(blob.shape, 255, np.uint8), 50)
    nearest = spots[np.argmin(abs(spots[:, 2] - 4.0 * 1.4))]
    assert np.allclose(nearest[:2], [60.5, 40.25], atol=0.15)


def test_features_keep_out_of_the_mask_and_within_the_number_the_largest_first():
    mask = ALL.copy()
    mask[:, 100:200] = 0
    spots, descriptors = sift(GREY, mask, 100)
    assert len(spots) == len(descriptors) <= 100 and descriptors.shape[1] == 128
    x = spots[:, 0].astype(int)
    assert ((x < 100) | (x >= 200)).all()
    more, _ = sift(GREY, mask, 400)
    assert len(more) > len(spots)


def test_descriptors_are_roots_of_shares_of_length_512_and_match_in_a_moved_picture():
    first, a = sift(GREY[:180, :280], ALL[:180, :280], 300)
    second, b = sift(GREY[6:186, 9:289], ALL[:180, :280], 300)
    assert np.allclose(np.linalg.norm(a.astype(float), axis=1), 512, atol=8)
    best = (a.astype(float) @ b.astype(float).T).argmax(1)
    off = first[:, :2] - second[best, :2] - [9, 6]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.2


def test_a_blank_picture_has_none():
    spots, descriptors = sift(np.full((40, 50), 7, np.uint8), np.full((40, 50), 255, np.uint8), 10)
    assert spots.shape == (0, 4) and descriptors.shape == (0, 128) and descriptors.dtype == np.uint8


@pytest.mark.slow
def test_features_are_the_same_for_any_number_of_processors(tmp_path, monkeypatch):
    files = [f"{i}.png" for i in range(6)]
    for kind in ("images", "masks"):
        (tmp_path / kind).mkdir()
    for i, file in enumerate(files):
        write_image(tmp_path / "images" / file, texture(i)[:120, :160])
        write_mask(tmp_path / "masks" / file, np.full((120, 160), 255, np.uint8))
    found = []
    for count in (1, 4):
        monkeypatch.setattr(colmap_features.os, "cpu_count", lambda count=count: count)
        done: list[int] = []
        database = tmp_path / f"{count}.db"
        colmap_features.extract(
            database, tmp_path / "images", tmp_path / "masks", files, 100, [], extracted=done.append
        )
        assert done == [1, 2, 3, 4, 5, 6]
        with colmap_features.pycolmap.Database.open(database) as store:
            ids = {image.name: image.image_id for image in store.read_all_images()}
            found.append([(store.read_keypoints(ids[f]), store.read_descriptors(ids[f]).data) for f in files])
    assert all(len(spots) > 20 for spots, _ in found[0])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
