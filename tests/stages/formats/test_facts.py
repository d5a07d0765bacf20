"""facts.py: files between stages are read as records, and the first place that has not the form is named."""

import json

import pytest

from stages.contract import StageError
from stages.formats.facts import Facts, FileName, NotJson, Number, SplitFacts, Whole, parse, read_facts
from tests.made.said import holds


class Row(Facts):
    name: FileName
    psnr: Number | None


class Form(Facts):
    width: Whole
    time: Number
    on: bool
    frames: tuple[Row, ...]
    each: dict[str, str]
    by: str = ""


GOOD = {"width": 3, "time": 2, "on": True, "frames": [{"name": "a", "psnr": None}], "each": {"x": "y"}, "more": []}


def test_what_fits_is_read(tmp_path):
    (tmp_path / "frames.json").write_text(json.dumps(GOOD))
    found = read_facts(tmp_path / "frames.json", Form)
    assert found == Form(width=3, time=2, on=True, frames=(Row(name="a", psnr=None),), each={"x": "y"})
    assert type(found.time) is int and found.by == ""  # as it was written


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"width": 3.0}, ("width", "3.0", "whole number")),
        ({"width": True}, ("width", "true", "whole number")),
        ({"width": 10**30}, ("width", 10**30, "whole number")),
        ({"time": "2"}, ("time", '"2"', "number")),
        ({"time": True}, ("time", "true", "number")),
        ({"time": float("nan")}, ("time", "NaN", "number")),
        ({"time": float("inf")}, ("time", "Infinity", "number")),
        ({"time": 10**400}, ("time",)),
        ({"on": 1}, ("on", 1, "true or false")),
        ({"frames": {}}, ("frames", "{}", "list")),
        ({"frames": [3]}, ("frames[0]", 3, "named values")),
        ({"frames": [{"psnr": 1}]}, ("frames[0]", "no name")),
        ({"frames": [{"name": "a", "psnr": 1}, {"name": "b", "psnr": "c"}]}, ("frames[1].psnr", '"c"', "number")),
        ({"frames": [{"name": "../x", "psnr": 1}]}, ("frames[0].name", '"../x"', "file name")),
        ({"each": {"x": 1}}, ("each.x", 1, "text")),
        ({"each": ["x" * 50]}, ("each",)),
        ({"by": []}, ("by", "[]", "text")),
        ({"by": None}, ("by", "null", "text")),
    ],
)
def test_the_first_place_that_does_not_fit_is_named(change, facts):
    with pytest.raises(ValueError) as error:
        parse(json.dumps(GOOD | change), Form)
    assert holds(str(error.value), *facts)


def test_numbers_come_back_bit_by_bit():
    for number in (0.1, 1 / 3, 1e-310, 1.7976931348623157e308, 5e-324, 123456789.123456789):
        assert parse(json.dumps(GOOD | {"time": number}), Form).time == number


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[" * 100_000, b"[1]"])
def test_broken_files_are_refused_with_the_stage_to_run_again(tmp_path, data):
    (tmp_path / "split.json").write_bytes(data)
    with pytest.raises(StageError) as error:
        read_facts(tmp_path / "split.json", SplitFacts)
    assert "split.json" in error.value.problem and "`hugs run VIDEO sfm --force`" in error.value.hint
    assert ("cannot read" in error.value.problem) == (data != b"[1]")
    with pytest.raises(StageError, match="cannot read"):
        read_facts(tmp_path / "nothing.json", SplitFacts)
    with pytest.raises(NotJson):
        parse("{", SplitFacts)
