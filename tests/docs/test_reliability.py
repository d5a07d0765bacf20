"""Each promise of docs/reliability.md names its tests, and these are there."""

from __future__ import annotations

import ast
import re

import pytest

from tests.docs.documents import ROOT

ROWS = [
    [cell.strip() for cell in line.strip("| \n").split(" | ")]
    for line in (ROOT / "docs/reliability.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith("| promise")
]
NAMED = sorted({name for row in ROWS for name in re.findall(r"`(tests/[^`]+)`", row[-1])})


def test_promises_are_found_and_most_name_a_test():
    promises = [row for row in ROWS if not row[0].startswith("**")]
    assert len(promises) > 25 and sum(len(row) > 1 for row in promises) > 20


@pytest.mark.parametrize("name", NAMED)
def test_a_test_that_is_named_is_there(name):
    file, _, test = name.partition("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert test in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
