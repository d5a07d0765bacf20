"""facts.py: files between stages are read as records, and the first place that has not the form is named."""

import json

import pytest

from stages.contract import StageError
from stages.formats.facts import Facts, FileName, NotJson, Number, SplitFacts, Whole, parse, read_facts


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
    ("change", "said"),
    [
        ({"width": 3.0}, "width is 3.0, not a whole number"),
        ({"width": True}, "width is true, not a whole number"),
        ({"width": 10**30}, "width is 1000000000000000000000000000000, not a whole number"),
        ({"time": "2"}, 'time is "2", not a number'),
        ({"time": True}, "time is true, not a number"),
        ({"time": float("nan")}, "time is NaN, not a number"),
        ({"time": float("inf")}, "time is Infinity, not a number"),
        ({"time": 10**400}, "time is 1000"),
        ({"on": 1}, "on is 1, not true or false"),
        ({"frames": {}}, "frames is {}, not a list"),
        ({"frames": [3]}, "frames[0] is 3, not named values"),
        ({"frames": [{"psnr": 1}]}, "frames[0] has no name"),
        ({"frames": [{"name": "a", "psnr": 1}, {"name": "b", "psnr": "c"}]}, 'frames[1].psnr is "c", not a number'),
        ({"frames": [{"name": "../x", "psnr": 1}]}, 'frames[0].name is "../x", not a file name'),
        ({"each": {"x": 1}}, "each.x is 1, not a text"),
        ({"each": ["x" * 50]}, 'each is ["xxx'),
        ({"by": []}, "by is [], not a text"),
        ({"by": None}, "by is null, not a text"),
    ],
)
def test_the_first_place_that_does_not_fit_is_named(change, said):
    with pytest.raises(ValueError) as error:
        parse(json.dumps(GOOD | change), Form)
    assert str(error.value).startswith(said)


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
