"""ground.json comes back as it was, and what is no floor is refused."""

import json
from dataclasses import fields

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.ground import read_ground, write_ground
from stages.records import Ground
from tests.made.said import holds

GROUND = Ground(
    np.array([0.1, 1 / 3, -2e-9]), np.array([0, -0.6, 0.8]), np.array([1.0, 0, 0]), 0.07, 0.011, 0.02, 321, "made"
)


def test_the_floor_comes_back_as_it_was(tmp_path):
    write_ground(tmp_path / "ground.json", GROUND)
    back = read_ground(tmp_path / "ground.json")
    for field in fields(Ground):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(GROUND, field.name))
    np.testing.assert_allclose(back.turn.T @ back.turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(back.turn) == pytest.approx(1)


@pytest.mark.parametrize(
    ("key", "value", "facts"),
    [
        ("up", [0, -1], ("up", 2)),
        ("up", [0, -0.6, 0.9], ("length 1",)),
        ("ahead", [0, -0.6, 0.8], ("square",)),
        ("point", [0, None, 0], ("point[1]", "null", "number")),
        ("points", 2.5, ("points", 2.5)),
        ("how", None, ("how", "null")),
    ],
)
def test_what_is_no_floor_is_refused(tmp_path, key, value, facts):
    path = tmp_path / "ground.json"
    write_ground(path, GROUND)
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(StageError, match="its stage writes") as refused:
        read_ground(path)
    assert holds(refused.value.facts[0], *facts) and "smpl --force" in refused.value.hint


def test_a_result_of_before_has_none_and_that_is_said(tmp_path):
    with pytest.raises(StageError, match="cannot read") as refused:
        read_ground(tmp_path / "ground.json")
    assert "`hugs run VIDEO smpl --force`" in refused.value.hint
