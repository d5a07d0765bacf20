"""A short round of `python -m tests.tools.fleet_kills`."""

import pytest

from tests.tools import fleet_kills


@pytest.mark.slow
def test_kills_lose_nothing(tmp_path):
    found = fleet_kills.run(2, 1, tmp_path, clips=1)
    assert found["killed"] == 2 and found["finished"]
    assert not any(found[what] for what in fleet_kills.FINDINGS), found
