"""A fresh folder of clips for each test of a fleet."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.made.fleet import Fleet


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Two clips."""
    return Fleet(tmp_path, 2)
