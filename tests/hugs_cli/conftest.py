"""A fresh small pipeline for each test of the command line."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.made.flow import Flow
from tests.made.studies import add_tiny


@pytest.fixture
def flow(tmp_path: Path) -> Flow:
    """A fresh clip and package."""
    return Flow(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Flow:
    """A clip and package after `hugs run`; to be copied."""
    flow = Flow(tmp_path_factory.mktemp("finished"))
    flow.hugs()
    return flow


@pytest.fixture
def made(finished: Flow, tmp_path: Path) -> Flow:
    """A fresh clip and package after `hugs run`."""
    return finished.copied(tmp_path)


@pytest.fixture
def clip(flow: Flow) -> Flow:
    """The flow with the pipelines `tiny` and `quick`, see tests/made/studies.py."""
    return add_tiny(flow)


@pytest.fixture(autouse=True)
def _flow_is_this_tests() -> Iterator[None]:
    """Forget the package `flow` after each test: the next one's lies in another folder."""
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "flow"]:
        del sys.modules[name]


@pytest.fixture
def importable(flow: Flow, monkeypatch: pytest.MonkeyPatch) -> Flow:
    """A fresh clip and package that this process can import."""
    monkeypatch.syspath_prepend(str(flow.folder))
    return flow
