"""Landmarks on disk."""

from __future__ import annotations

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.landmarks import read_landmarks, write_landmarks
from stages.records import SeenLandmarks

RNG = np.random.default_rng(0)
SEEN = SeenLandmarks(RNG.standard_normal((33, 2)), RNG.random(33), RNG.standard_normal((33, 3)))


def test_landmarks_come_back_by_the_names_of_their_frames(tmp_path):
    write_landmarks(tmp_path / "landmarks.npz", ["000000", "000003"], [None, SEEN])
    found = read_landmarks(tmp_path / "landmarks.npz")
    assert list(found) == ["000000", "000003"] and found["000000"] is None
    for part in ("xy", "visibility", "world"):
        np.testing.assert_array_equal(getattr(found["000003"], part), getattr(SEEN, part))


def test_landmarks_of_another_count_are_refused(tmp_path):
    arrays = {"xy": np.ones((1, 17, 2)), "visibility": np.ones((1, 17)), "world": np.ones((1, 17, 3))}
    np.savez(tmp_path / "landmarks.npz", names=["a"], **arrays)
    with pytest.raises(StageError, match=r"\bxy\b.*landmarks\.npz"):
        read_landmarks(tmp_path / "landmarks.npz")
