"""What YAML text is a number, a switch or nothing, and what is text."""

from __future__ import annotations

import math

import pytest
import yaml

from hugs_cli import pipelines
from hugs_cli.plain_yaml import read


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2),
        ("-7", -7),
        ("0", 0),
        ("0.5", 0.5),
        ("-.5e-3", -0.0005),
        ("1.5e+3", 1500.0),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("[1, a, {b: null}]", [1, "a", {"b": None}]),
        ("'010'", "010"),
        ("&a x", "x"),
        ("{a: &a {x: 1}, b: {<<: *a, y: 2}}", {"a": {"x": 1}, "b": {"x": 1, "y": 2}}),
    ],
)
def test_values_are_read(text, value):
    assert read(text) == value and type(read(text)) is type(value)


@pytest.mark.parametrize(
    "text", ["010", "1:30", "1_0", "no", "on", "yes", "0x10", "0o10", "0b1", "2024-01-01", "=", "٣"]
)
def test_what_only_old_yaml_takes_for_something_else_is_text(text):
    assert read(text) == text


def test_numbers_without_end_are_read():
    assert read("-.inf") == -math.inf and math.isnan(read(".nan"))


def test_the_own_pipelines_read_as_before():
    text = pipelines.FILE.read_text()
    assert read(text) == yaml.safe_load(text)


def test_ten_thousand_values_are_read_and_no_more():
    assert len(read(f"[{'1, ' * 9_000}]")) == 9_000
    with pytest.raises(ValueError, match=r"\b10000\b"):
        read(f"[{'1, ' * 10_000}]")
    assert len(read(f"{{a: &a [{'1, ' * 90}], b: [{'*a, ' * 90}]}}")["b"]) == 90
    with pytest.raises(ValueError, match=r"\b10000\b.*aliases"):
        read(f"{{a: &a [{'1, ' * 90}], b: [{'*a, ' * 120}]}}")


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\na: 2",
        "{a: 1, a: 2}",
        "x: [{b: 1, c: {b: 3}, b: 2}]",
        "a: &k {q: 1, 'q': 2}",
        "? a\n: 1\n? a\n: [2]",
        "'': 1\n'': 2",
    ],
)
def test_a_key_that_is_given_twice_is_an_error(text):
    with pytest.raises(ValueError, match=r"twice.* \d"):
        read(text)


def test_equal_keys_of_other_mappings_and_equal_values_are_none(tmp_path):
    assert read("{a: a, b: {a: a, b: [a, a, {a: a}]}, c: a}") == {
        "a": "a",
        "b": {"a": "a", "b": ["a", "a", {"a": "a"}]},
        "c": "a",
    }
    merged = "a: &a {x: 1, y: 2}\nb: &b {<<: *a, y: 3}\nc: {<<: *b, x: 4}\n"
    assert read(merged)["c"] == {"x": 4, "y": 3}


def test_broken_text_is_an_error():
    for text in ("[", "a: *nowhere", "a: b: c", "!!python/name:os.system x", "--- a\n--- b"):
        with pytest.raises(yaml.YAMLError):
            read(text)
