"""What all stages share."""

import importlib.util
import sys

import pytest

from stages import contract


@pytest.mark.parametrize(("platform", "unit"), [("darwin", 1), ("linux", 1024)])
def test_memory_is_counted_in_bytes_on_every_system(monkeypatch, platform, unit):
    """getrusage(2): ru_maxrss is bytes on macOS and kilobytes on Linux."""
    monkeypatch.setattr(sys, "platform", platform)
    spec = importlib.util.spec_from_file_location("contract_there", contract.__file__)
    there = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "contract_there", there)
    spec.loader.exec_module(there)

    class Usage:
        ru_maxrss = 3_000

    monkeypatch.setattr(there.resource, "getrusage", lambda who: Usage)
    assert there.peak_memory() == 3_000 * unit
