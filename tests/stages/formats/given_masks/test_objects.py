"""Which object `--person` picks."""

from __future__ import annotations

import pytest

from stages.contract import StageError
from stages.formats.given_masks.objects import Object, pick

NAMES = ("10", "010", "008", "2", "²", "no", "1:30", "000")
OBJECTS = [Object(name, 10, 0.1, {}, lambda row: None) for name in NAMES]


@pytest.mark.parametrize("name", ["10", "010", "008", "2", "²", "no", "1:30"])
def test_an_object_is_picked_by_its_own_name(name):
    assert pick(OBJECTS, name).id == name


def test_numbers_find_names_with_other_zeros():
    assert [pick(OBJECTS, name).id for name in ("8", "0010", "02", "0")] == ["008", "10", "2", "000"]


@pytest.mark.parametrize("name", ["3", "9" * 5000, "³", "~", ""])
def test_what_no_object_is_called_is_refused(name):
    with pytest.raises(StageError, match="no person"):
        pick(OBJECTS, name)
