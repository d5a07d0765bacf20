"""JSON facts between stages: read as records, refused at the first place that does not fit."""

import json

import pytest

from stages.contract import StageError
from stages.formats.facts import NAME, mismatch, read_facts

FORM = {
    "width": int,
    "time": float,
    "on": bool,
    "frames": [{"name": NAME, "psnr": (float, None)}],
    "each": {str: str},
    "by?": str,
}
GOOD = {"width": 3, "time": 2, "on": True, "frames": [{"name": "a", "psnr": None}], "each": {"x": "y"}, "more": []}


def test_what_fits_is_read_with_all_its_keys(tmp_path):
    (tmp_path / "frames.json").write_text(json.dumps(GOOD))
    assert read_facts(tmp_path / "frames.json", FORM) == GOOD


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": 3.0}, "width is 3.0, not a whole number"),
        ({"width": True}, "width is true, not a whole number"),
        ({"width": 10**30}, "width is 1000000000000000000000000000000, not a whole number"),
        ({"time": "2"}, 'time is "2", not a number'),
        ({"time": float("nan")}, "time is NaN, not a number"),
        ({"on": 1}, "on is 1, not true or false"),
        ({"frames": {}}, "frames is {}, not a list"),
        ({"frames": [{"psnr": 1}]}, "frames[0] has no name"),
        ({"frames": [{"name": "a", "psnr": 1}, {"name": "b", "psnr": "c"}]}, 'frames[1].psnr is "c", not null'),
        ({"frames": [{"name": "../x", "psnr": 1}]}, 'frames[0].name is "../x", not a file name'),
        ({"each": {"x": 1}}, "each.x is 1, not a text"),
        ({"each": ["x" * 50]}, "each is"),
        ({"by": []}, "by is [], not a text"),
    ],
)
def test_the_first_place_that_does_not_fit_is_named(change, said):
    assert mismatch(GOOD | change, FORM, "").startswith(said)


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[" * 100_000, b"[1]"])
def test_broken_files_are_refused_with_the_stage_to_run_again(tmp_path, data):
    (tmp_path / "split.json").write_bytes(data)
    with pytest.raises(StageError) as error:
        read_facts(tmp_path / "split.json", {"rule": str})
    assert "split.json" in error.value.problem and "`hugs run VIDEO sfm --force`" in error.value.hint
    with pytest.raises(StageError, match="cannot read"):
        read_facts(tmp_path / "nothing.json", {})
