"""Shared by all tests: where the real clips lie, and the markers."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

os.environ.setdefault(
    "OMP_WAIT_POLICY", "PASSIVE"
)  # as the engine does: waiting threads that spin make torch 25x slower

DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_configure(config: pytest.Config) -> None:
    """`slow` sorts tests of more than 5 s; it leaves none out."""
    config.addinivalue_line("markers", "slow: takes more than 5 s")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real clips; the test is skipped, with the reason printed, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"no real clips at {DATA}")
    return DATA


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
