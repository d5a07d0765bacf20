"""The hard cases: which there are, which tests hold them, and how far each stays from its bound.

    python -m tests.tools.hard_cases          runs the tests that name a case and prints the table (`make hard`)
    python -m tests.tools.hard_cases --list   prints what is covered, without running

A test covers the cases its name starts with: `test_a05_a16_what_must_hold` covers A05 and A16. It states its bounds through
the fixture `held` (tests/conftest.py): `held(measured, bound)`. `hard_cases.txt` names all cases: number, severity
(S0 poisons everything in silence or kills the process, S1 a wrong result in silence, S2 a visible local fault, S3 a poor message),
title; `hard_cases_left.txt` names those without a test, with the reason.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TESTS = HERE.parent
NAMED = re.compile(r"test_((?:[a-l]\d\d_)+)")


def catalogue() -> dict[str, tuple[str, str]]:
    """Every case: number -> severity and title."""
    rows = (line.split(" ", 2) for line in (HERE / "hard_cases.txt").read_text().splitlines())
    return {number: (severity, title) for number, severity, title in rows}


def left() -> dict[str, str]:
    """The cases without a test: number -> why."""
    rows = (line.split(" ", 1) for line in (HERE / "hard_cases_left.txt").read_text().splitlines())
    return dict(rows)


def cases_of(name: str) -> list[str]:
    """The numbers that a test's name starts with: 'test_a05_a16_scales' -> ['A05', 'A16']."""
    found = NAMED.match(name)
    return found[1].upper().strip("_").split("_") if found else []


class Table:
    """A pytest plugin that keeps only tests of hard cases, and what they measured."""

    def __init__(self) -> None:
        self.tests: dict[str, list[str]] = {}
        self.margins: dict[str, tuple[float, float]] = {}
        self.failed: set[str] = set()

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out every other test."""
        for item in items:
            for case in cases_of(item.name):
                self.tests.setdefault(case, []).append(item.nodeid.removeprefix("tests/"))
        config.hook.pytest_deselected(items=[item for item in items if not cases_of(item.name)])
        items[:] = [item for item in items if cases_of(item.name)]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember the narrowest margin of each case, and what failed."""
        for case in cases_of(report.nodeid.rpartition("::")[2]):
            if report.failed:
                self.failed.add(case)
            for name, (measured, bound) in report.user_properties if report.when == "call" else ():
                known = self.margins.get(case, (0.0, 1.0))
                if name == "held" and measured / bound >= known[0] / known[1]:
                    self.margins[case] = (measured, bound)

    def lines(self) -> list[str]:
        """The table: case, severity, number of tests, measured, bound, margin, the first test or the reason for none."""
        out = [f"{'case':5}{'':3}{'tests':>6}  {'measured':>9}  {'bound':>9}  {'margin':>7}  where"]
        reasons = left()
        for case, (severity, title) in catalogue().items():
            tests = self.tests.get(case, [])
            numbers = f"{'':9}  {'':9}  {'':7}"
            if case in self.margins:
                measured, bound = self.margins[case]
                times = f"{bound / measured:.3g}x" if measured else "exact"
                numbers = f"{measured:9.2g}  {bound:9.2g}  {times:>7}"
            where = tests[0].partition("[")[0] if tests else f"{title}: {reasons.get(case, 'NO TEST')}"
            mark = "  FAILED" if case in self.failed else ""
            out.append(f"{case:5}{severity:3}{len(tests) or '-':>6}  {numbers}  {where}{mark}")
        heavy = [case for case, (severity, _) in catalogue().items() if severity in ("S0", "S1")]
        covered = sum(case in self.tests for case in heavy)
        total = f"{len(self.tests)} of {len(catalogue())} cases have a test"
        return [*out, "", f"{total}; of S0 and S1 {covered} of {len(heavy)}; {len(self.failed)} failed"]


def main() -> int:
    """Run or list the tests of hard cases, and print the table."""
    table = Table()
    options = ["--collect-only", "-qq"] if "--list" in sys.argv else []
    code = pytest.main(["-q", str(TESTS), *options], plugins=[table])
    print("\n".join(table.lines()))
    return int(code)


if __name__ == "__main__":
    raise SystemExit(main())
