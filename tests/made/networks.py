"""Trained networks, which a test may need."""

from __future__ import annotations

import pytest

from stages.contract import StageError
from stages.estimators import assets


def fetched(*names: str) -> None:
    """Fetch them if need be; the test is skipped, with the reason printed, where that fails."""
    try:
        for name in names:
            assets.fetch(name)
    except StageError as error:
        pytest.skip(f"{error}: {' '.join(error.facts)}")
