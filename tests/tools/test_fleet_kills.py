"""A short round of `python -m tests.tools.fleet_kills`, without Snakemake: tests/hugs_cli/fleet/test_fleet.py kills that."""

import numpy as np
import pytest

from tests.made.fleet import Fleet
from tests.tools import fleet_kills


@pytest.mark.slow
def test_kills_lose_nothing(tmp_path):
    found = fleet_kills.harass(Fleet(tmp_path, 1), times=2, jobs=1, rng=np.random.default_rng(1))
    assert found["killed"] == 2 and found["finished"]
    assert not any(found[what] for what in fleet_kills.FINDINGS), found
