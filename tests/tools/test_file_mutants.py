"""Mistakes in one file: each is one change that compiles, and the tests that are asked are those of the file."""

import ast
from pathlib import Path

import pytest

from tests.tools import file_mutants
from tests.tools.file_mutants import guards, mistakes, seen_by
from tests.tools.mutants import ROOT

WHATS = {
    "a = b < c": ["b < c -> (b >= c)"],
    "a = not b": ["not b -> (b)"],
    "a = -b": ["-b -> (b)"],
    "a = b and c": ["b and c -> ((b) or (c))"],
    "a = b - 2": ["b - 2 -> ((b) + (2))", "2 -> (3)"],
    "a = b * 0.5": ["b * 0.5 -> ((b) / (0.5))", "0.5 -> (1.0)"],
    "a = folder / 'name'": [],
    "a = max(b, c)": ["max(b, c) -> (b)"],
    "a = np.minimum(b, c)": ["np.minimum(b, c) -> (b)"],
    "a = b.clamp_min(c)": ["b.clamp_min(c) -> (b)"],
    "a = f(b, c)": ["f(b, c) -> (f(c, b))"],
    "a = b if c else d": ["b if c else d -> (b)"],
    "a = f(b=True)": ["True -> (False)"],
    "a: Annotated[int, 3] = b": [],
    "raise ValueError(b < c)": [],
    "a = 'größer', b < c": ["b < c -> (b >= c)"],
}


@pytest.mark.parametrize("text", WHATS)
def test_every_kind_of_mistake_is_made_and_what_is_said_is_left(text):
    found = mistakes(text)
    assert sorted(one.what for one in found) == sorted(WHATS[text])
    for one in found:
        assert one.source != text and one.line == 1 and ast.dump(ast.parse(one.source)) != ast.dump(ast.parse(text))


@pytest.mark.parametrize("file", ["stages/filming/parts.py", "hugs_cli/busy.py"])
def test_mistakes_of_a_real_file_change_one_place_each(file):
    source = (ROOT / file).read_text()
    found = mistakes(source)
    assert len(found) > 5 and [one.line for one in found] == sorted(one.line for one in found)
    for one in found:
        same = sum(a == b for a, b in zip(source.splitlines(), one.source.splitlines()))
        assert same < len(source.splitlines()) and compile(one.source, file, "exec")


def test_a_file_is_guarded_by_the_tests_beside_it_and_by_those_that_import_it():
    found = guards("stages/formats/exchange/ply.py")
    assert found[0] == "tests/stages/formats/exchange/test_ply.py" and "tests/stages/test_export.py" in found
    assert guards("stages/estimators/detectors/shading.py") == ["tests/stages/estimators/test_detectors.py"]
    assert guards("stages/estimators/cameras/verdict.py") == ["tests/stages/estimators/cameras/test_ladder.py"]


@pytest.mark.parametrize(
    ("ended", "seen"), [((0, 5), ""), ((5, 0), ""), ((1,), "t.py::test_a"), ((0, 1), "t.py::test_a")]
)
def test_slow_tests_run_only_where_no_other_turns_red(monkeypatch, ended, seen):
    codes = iter(ended)
    monkeypatch.setattr(file_mutants, "ran", lambda *_: (next(codes), ["FAILED t.py::test_a - assert"]))
    assert seen_by(Path("tree"), ["t.py"]) == seen and next(codes, None) is None
