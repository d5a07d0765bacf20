"""What all tests share: the folder of real clips, one thread a worker, and the list of slow tests that no mark names."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

os.environ.setdefault(
    "OMP_WAIT_POLICY", "PASSIVE"
)  # as the engine does: waiting threads that spin make torch 25x slower
if "PYTEST_XDIST_WORKER" in os.environ:  # several tests at a time: the processors are taken
    os.environ.setdefault("OMP_NUM_THREADS", "1")

CLIPS = "HUGS_CLIPS"  # the environment variable that names the folder of real clips
FIRST = (
    ("tests/test_end_to_end.py",),
    ("tests/hugs_cli/", "tests/tools/"),
    ("tests/docs/", "tests/test_", "tests/stages/filming/test_page.py"),
)
"""What is tested first, in this order: slow files, lest a worker is left alone with one at the end. The first compiles the kernels;
the next need none, and the other worker compiles nothing a second time."""

QUICK = 1.0  # s; `make quick` leaves out tests marked `slow`, which take longer
over: dict[str, float] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort by FIRST; within the same rank, files that are slow as a whole come first."""

    def place(item: pytest.Item) -> tuple[int, bool]:
        assert item.parent is not None
        file = item.path.relative_to(item.config.rootpath).as_posix()
        ranks = [rank for rank, places in enumerate(FIRST) if file.startswith(places)]
        return min(ranks, default=len(FIRST)), all(mark.name != "slow" for mark in item.parent.own_markers)

    items.sort(key=place)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Remember a test that took longer than QUICK and is not marked `slow`."""
    if report.when == "call" and report.duration > QUICK and "slow" not in report.keywords:
        over[report.nodeid] = report.duration


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name these tests; on a busy machine some are there by accident, therefore nothing fails."""
    if over:
        terminalreporter.section(f"over {QUICK:g} s and not marked slow")
    for name, seconds in sorted(over.items(), key=lambda row: -row[1]):
        terminalreporter.write_line(f"{seconds:6.1f} s  {name}")


@pytest.fixture(scope="session")
def clips() -> Path:
    """The folder of real clips; without it the test is skipped, with the reason printed."""
    folder = os.environ.get(CLIPS)
    if not folder:
        pytest.skip(f"{CLIPS} names no folder of real clips")
    if not Path(folder).is_dir():
        pytest.skip(f"{CLIPS}: there is no folder {folder}")
    return Path(folder)


@pytest.fixture
def held(record_property: Callable[[str, object], None]) -> Callable[..., None]:
    """`held(measured, bound)`: fails above the bound, and puts both into the table of hard cases."""

    def check(measured: float, bound: float, what: str = "") -> None:
        record_property("held", (float(measured), float(bound)))
        assert measured <= bound, f"{what or 'measured'} {measured:.3g} is over {bound:.3g}"

    return check


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Path:
    """The folder of small whole files of every kind that we read; a test that damages one puts it back."""
    from tests.made import corpus

    return corpus.make(tmp_path_factory.mktemp("corpus"))
