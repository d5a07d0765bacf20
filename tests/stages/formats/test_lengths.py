"""Lengths as people write them."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from stages.formats.lengths import Heights, Scale

HEIGHTS, SCALE = TypeAdapter(Heights), TypeAdapter(Scale)


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("1.85", 1.85), ("1,85", 1.85), ("1.85m", 1.85), ("1,85 m", 1.85), ("185cm", 1.85), (" 185 CM", 1.85), ("1850mm", 1.85),
        (1.85, 1.85), (2, 2.0), ("6ft1", 1.8542), ("6 ft 1 in", 1.8542), ("6'1\"", 1.8542), ("6’1”", 1.8542), ("5'11", 1.8034),
        ("5'11.5\"", 1.8161), ("6ft", 1.8288), ("6'", 1.8288), ("1.10", 1.1), ("2.10", 2.1),
    ],
)  # fmt: skip
def test_a_height_is_read_in_metres_however_it_is_written(text, metres):
    assert HEIGHTS.validate_python(text) == {1: pytest.approx(metres)}


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("0", "no length"), (0.4, "0.4 m"), ("3", "3 m"), ("nan", "no length"), (float("nan"), "no length"), ("tall", "no length"),
        ("-1.85", "no length"), ("", "no length"), (True, "no length"), ("185", "185cm"), ("6.1", "6ft"), ("1.85.0", "no length"),
        ("inf", "no length"), ("me=1.85", "numbers"), (["1.8", "1=1.7"], "person 1"), ({"0": 1.7}, "numbers"), ("1e3", "no length"),
    ],
)  # fmt: skip
def test_a_height_that_nobody_has_is_refused_with_what_is_wrong(text, fact):
    with pytest.raises(ValidationError, match=fact):
        HEIGHTS.validate_python(text)


def test_heights_are_of_people_in_order_or_by_number_and_come_through_json():
    assert HEIGHTS.validate_python(["1.85", "5'6"]) == {1: 1.85, 2: pytest.approx(1.6764)}
    assert HEIGHTS.validate_python(["2=1.70"]) == {2: 1.7}
    assert HEIGHTS.validate_json(HEIGHTS.dump_json({2: 1.7})) == {2: 1.7} and HEIGHTS.validate_python([]) is None


def test_a_scale_is_a_length_of_the_page_and_its_true_one_or_the_cameras():
    assert SCALE.validate_python("2.31=2.00") == (2.31, 2.0)
    assert SCALE.validate_python("2.31m=6ft") == (2.31, pytest.approx(1.8288))
    assert SCALE.validate_python("cameras") == "cameras"
    assert SCALE.validate_json(SCALE.dump_json((2.31, 2.0))) == (2.31, 2.0)


@pytest.mark.parametrize(
    ("text", "fact"),
    [("2.31", "write"), ("2.31=200", "200 m"), ("a=b", "no length"), ("0=1", "no length"), (3, "write")],
)
def test_a_scale_that_is_none_is_refused_with_what_is_wrong(text, fact):
    with pytest.raises(ValidationError, match=fact):
        SCALE.validate_python(text)
