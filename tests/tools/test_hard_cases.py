"""The catalogue of hard cases is whole: each has a test or a reason, those of weight a test, and no number is made up."""

import re

from tests.tools.hard_cases import TESTS, cases_of, catalogue, left


def named() -> set[str]:
    """The cases that some test of this tree covers."""
    tests = re.compile(r"^\s*def (test_\w+)", re.M)
    files = (path.read_text() for path in TESTS.rglob("test_*.py"))
    return {case for text in files for name in tests.findall(text) for case in cases_of(name)}


def test_numbers_are_read_from_names():
    assert cases_of("test_a05_scales") == ["A05"]
    assert cases_of("test_a05_l10_scales[1]") == ["A05", "L10"]
    assert cases_of("test_a_scale") == cases_of("test_scales_a05") == []


def test_every_number_is_in_the_catalogue():
    assert named() | set(left()) <= set(catalogue())


def test_every_case_has_a_test_or_a_reason_and_those_that_matter_a_test():
    assert not set(catalogue()) - named() - set(left()), "neither tested nor explained"
    assert not named() & set(left()), "tested, and yet explained away"
    heavy = {case for case, (severity, _) in catalogue().items() if severity in ("S0", "S1")}
    assert not heavy - named()
