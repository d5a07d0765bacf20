"""A fleet on a real Slurm; only where HUGS_SLURM=1 says that one may be started on this machine."""

import os

import pytest

from tests.tools import slurm


@pytest.mark.slow
def test_a_fleet_on_slurm(tmp_path):
    if not os.environ.get("HUGS_SLURM"):
        pytest.skip("HUGS_SLURM is not set: no Slurm is started")
    if why := slurm.missing():
        pytest.skip(why)
    with slurm.slurm(tmp_path / "slurm"):
        (tmp_path / "fleet").mkdir()
        slurm.rehearse(tmp_path / "fleet")
