"""The table of mutants fits the tree: every text stands where it says, once, and every test exists."""

import pytest

from tests.tools.mutants import MUTANTS, mutated, node


@pytest.mark.parametrize("mutant", MUTANTS, ids=[m.name for m in MUTANTS])
def test_a_mutant_changes_one_place_and_names_one_test(mutant):
    assert mutant.instead != mutant.text
    compile(mutated(mutant), mutant.file, "exec")
    assert "::test_" in node(mutant.test)


def test_what_is_not_there_or_there_twice_is_refused():
    with pytest.raises(LookupError, match="found 0 times"):
        mutated(MUTANTS[0]._replace(text="nobody wrote this"))
    with pytest.raises(LookupError, match="0 tests are called nothing"):
        node("tests/tools/test_mutants.py::nothing")
