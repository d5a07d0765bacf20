"""SIFT features: where they are, outside the mask, and the same in a moved picture."""

import cv2
import numpy as np
import pytest

from stages.estimators.cameras import colmap_features
from stages.estimators.cameras.features import CLEAR, FAR, ROWS, nearest, neighbours, sift
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


def descriptors(count: int, seed: int) -> np.ndarray:
    """Descriptors uint8 [count,128] of length 512, as SIFT's."""
    shares = np.random.default_rng(seed).gamma(0.5, size=(count, 128))
    return np.round(512 * np.sqrt(shares / shares.sum(1, keepdims=True))).clip(0, 255).astype(np.uint8)


def disturbed(found: np.ndarray, amount: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, amount, found.shape)
    return np.round(found + noise).clip(0, 255).astype(np.uint8)


def by_definition(first: np.ndarray, second: np.ndarray) -> list[tuple[int, int]]:
    angle = np.arccos(np.minimum(first.astype(float) @ second.T.astype(float) / 512**2, 1))
    found = []
    for i, row in enumerate(angle):
        j = int(row.argmin())
        others = np.concatenate([np.delete(row, j), np.delete(angle[:, j], i)])
        if row[j] <= FAR and (row[j] < CLEAR * others).all():
            found.append((i, j))
    return found


@pytest.mark.parametrize("count", [1, ROWS, 2 * ROWS + 1])
def test_matches_are_those_of_the_definition(count):
    first = descriptors(count, 1)
    second = disturbed(np.random.default_rng(2).permutation(first), 12, 3)
    second = np.concatenate([second[: len(second) // 2 + 1], descriptors(90, 4), disturbed(first[:20], 9, 5)])
    found = nearest(first, second)
    assert found.dtype == np.uint32 and [(int(i), int(j)) for i, j in found] == by_definition(first, second)
    assert count == 1 or 0.3 * count < len(found) < 0.6 * count, "some match, the rest do not"


def test_two_that_are_as_good_do_not_match_on_either_side():
    first = descriptors(5, 1)
    twice = first[[0, 1, 2, 2]]
    assert nearest(first, twice).tolist() == [[0, 0], [1, 1]]
    assert nearest(twice, first).tolist() == [[0, 0], [1, 1]]
    assert nearest(twice, twice).tolist() == [[0, 0], [1, 1]]


def test_frames_without_features_match_nothing():
    none = np.zeros((0, 128), np.uint8)
    assert nearest(none, descriptors(3, 1)).shape == nearest(descriptors(3, 1), none).shape == (0, 2)
    assert nearest(descriptors(1, 1), descriptors(1, 2)).shape == (0, 2), "too far apart"


def test_neighbours_are_the_next_frames_or_those_at_growing_steps():
    assert neighbours(4, 2, growing=False) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    steps = {(b - a) for a, b in neighbours(80, (80).bit_length(), growing=True)}
    assert steps == {1, 2, 4, 8, 16, 32, 64} and neighbours(1, 1, growing=True) == []


@pytest.mark.slow
def test_a_database_holds_the_same_matches_for_any_number_of_processors_and_keeps_those_it_had(tmp_path, monkeypatch):
    wide, files = texture(3)[:240, :420], [f"{i}.png" for i in range(5)]
    for kind in ("images", "masks"):
        (tmp_path / kind).mkdir()
    for i, file in enumerate(files):
        write_image(tmp_path / "images" / file, np.ascontiguousarray(wide[:200, 9 * i : 9 * i + 300]))
        write_mask(tmp_path / "masks" / file, np.full((200, 300), 255, np.uint8))
    found = []
    for count in (1, 4):
        monkeypatch.setattr(colmap_features.os, "cpu_count", lambda count=count: count)
        database = tmp_path / f"{count}.db"
        colmap_features.extract(database, tmp_path / "images", tmp_path / "masks", files, 300, [])
        colmap_features.match(database, 1, growing=False, side=300)
        first, _ = colmap_features.read_pairs(database, files)
        colmap_features.match(database, 4, growing=False, side=300)
        found.append(colmap_features.read_pairs(database, files)[0])
        assert [(pair.first, pair.second) for pair in first] == neighbours(5, 1, growing=False)
        kept = {(pair.first, pair.second): pair for pair in found[-1]}
        assert all(np.array_equal(pair.a, kept[pair.first, pair.second].a) for pair in first)
    one, other = found
    assert [(pair.first, pair.second) for pair in one] == neighbours(5, 4, growing=False)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.a, b.a)
        moved = a.a - a.b - [9 * (a.second - a.first), 0]
        assert len(a.a) > 40 and np.median(np.linalg.norm(moved, axis=1)) < 0.2
