"""Seconds of named parts."""

import pytest

from stages.estimators.cameras.parts import Parts


def test_parts_are_said_in_order_and_added_up_also_where_one_fails(monkeypatch):
    times = iter([0.0, 1.5, 2.0, 4.0, 5.0, 5.25])
    monkeypatch.setattr("stages.estimators.cameras.parts.perf_counter", lambda: next(times))
    parts = Parts()
    with parts.timed("b"):
        pass
    with pytest.raises(ValueError), parts.timed("a"):
        raise ValueError
    with parts.timed("b"):
        pass
    assert str(parts) == "b 1.8 s, a 2.0 s" and parts.seconds == {"b": 1.75, "a": 2.0}
