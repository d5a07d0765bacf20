"""A fleet that lost its place to another call, and one that finds what an earlier call left."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.history import History
from hugs_cli.fleet.plan import Common
from hugs_cli.fleet.run import Fleet
from stages.contract import StageError


@pytest.fixture
def call(tmp_path) -> Fleet:
    """One call, with nothing to do."""
    found = Fleet("fleet", Common(tmp_path / "work"), [], History({}, {}), False, 1, None)
    found.folder.mkdir(parents=True)
    return found


def test_a_fleet_that_another_call_took_the_place_of_ends(call):
    me = leases.identity()
    path = call.folder / leases.NAME
    assert leases.take(path, me)
    jobs, press = SimpleNamespace(going=lambda: True), SimpleNamespace(print_if_due=lambda: None)
    call.wait(jobs, press, leases.Lease(path, me), longest=0.3)
    leases.remove(path, me)
    with pytest.raises(StageError, match="the fleet fleet has lost its lease"):
        call.wait(jobs, press, leases.Lease(path, me), longest=30)


def test_what_earlier_calls_left_is_taken_away(call):
    """Also what jobs still write, which is no longer heard."""
    call.lay_out(call.folder / "01d01d01d01d", {}, [])
    (call.folder / "notes").mkdir()  # of somebody
    (call.folder / "01d01d01d01d" / "logs" / "a.log").touch()
    with leases.lease(call.folder / leases.NAME, pytest.fail):
        call.lay_out(call.folder / "new", {}, [])
        assert sorted(path.name for path in call.folder.iterdir()) == [leases.NAME, "new", "notes"]
