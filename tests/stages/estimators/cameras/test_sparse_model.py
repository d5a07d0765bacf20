"""The points that are kept: few of them are no plane."""

from __future__ import annotations

import numpy as np
import pytest

from stages.contract import Job
from stages.estimators.cameras.colmap import Cloud
from stages.estimators.cameras.sparse_model import Pinholes, write_points
from stages.formats.images import write_mask

K = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
NAMES = ["000000", "000001", "000002"]


def kept(folder, xyz):
    (folder / "masks").mkdir()
    for name in NAMES:
        write_mask(folder / "masks" / f"{name}.png", np.zeros((40, 60), np.uint8))
    count, said = len(xyz), []
    one = np.ones(count)
    cloud = Cloud(
        np.arange(count), xyz, np.zeros((count, 3), np.uint8), 0.5 * one, 3 * one, 2 * one, (np.arange(3),) * count
    )
    found = Pinholes("moving", NAMES, np.tile(np.eye(4), (3, 1, 1)), np.tile(K, (3, 1, 1)), {}, {}, None, cloud)
    return write_points(Job(folder, emit=said.append), found, cloud)[1], said


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_so_few_points_tell_no_plane(count, tmp_path):
    facts, said = kept(tmp_path, np.random.default_rng(0).uniform(-1, 1, (count, 3)) + [0, 0, 5])
    assert facts["points"] == count and "flatness" not in facts and not said


def test_a_plane_is_named_and_points_all_alike_are_no_error(tmp_path):
    flat = np.random.default_rng(0).uniform(-1, 1, (40, 3)) * [1, 1, 0] + [0, 0, 5]
    (tmp_path / "flat").mkdir()
    facts, said = kept(tmp_path / "flat", flat)
    assert facts["flatness"] < 0.01 and "lie on a plane" in said[0]["text"]
    (tmp_path / "alike").mkdir()
    assert kept(tmp_path / "alike", np.tile([0, 0, 5.0], (6, 1)))[0]["points"] == 6
