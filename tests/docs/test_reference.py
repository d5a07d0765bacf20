"""docs/reference.md is what the docstrings of `hugs` are now, and these have all that somebody needs to call it."""

import inspect
import re

import pytest

import hugs
from tests.tools import reference

NAMES = sorted(hugs.__all__)
FUNCTIONS = [name for name in NAMES if inspect.isfunction(getattr(hugs, name))]


def test_the_reference_is_made_of_the_docstrings():
    assert reference.FILE.read_text("utf-8") == reference.page(), "python -m tests.tools.reference"
    assert all(f"## hugs.{name}\n" in reference.page() for name in NAMES)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_names_what_it_takes_what_it_raises_and_an_example(name):
    function = getattr(hugs, name)
    text = inspect.getdoc(function) or ""
    missing = [one for one in inspect.signature(function).parameters if not re.search(rf"\b{one}\b", text)]
    assert not missing and "Error" in text and "\n    " in text, (
        f"hugs.{name}: errors, an indented example, and {missing}"
    )


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isclass(getattr(hugs, name))])
def test_each_part_of_a_class_is_described(name):
    """By a text of its own, or in that of the class."""
    kind = getattr(hugs, name)
    whole = inspect.getdoc(kind) or ""
    silent = [title for title, text, _ in reference.members(kind) if not text]
    unknown = [title for title in silent if re.split(r"\W", title)[0] not in re.split(r"\W", whole)]
    assert whole and not unknown, unknown
