"""A fresh folder of clips for each test of a fleet."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugs_cli.fleet.plan import Common
from tests.made.fleet import Fleet


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Two clips."""
    return Fleet(tmp_path, 2)


@pytest.fixture
def common(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> Common:
    """The fleet's folder, with stages that this process can import."""
    monkeypatch.chdir(fleet.folder)
    monkeypatch.syspath_prepend(str(fleet.folder))
    return Common(Path("work"), Path("pipelines.yaml"))
