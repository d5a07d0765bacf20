"""What follows the last step is counted down part by part, by names."""

import pytest

from stages.contract import Job
from stages.training.timing import finishing
from stages.training.timing.finishing import (
    GAINS,
    HIDDEN,
    SETTLING,
    SHAPING,
    STEPS,
    WRITING,
    Finishing,
    finishing_parts,
)


@pytest.mark.parametrize(("slow", "first"), [(1.0, 1.0), (2.0, 2.0), (0.5, 1.0)])
def test_what_is_left_is_what_is_expected_or_longer_where_it_took_longer_so_far(tmp_path, monkeypatch, slow, first):
    now, events = [0.0], []
    monkeypatch.setattr(finishing.time, "perf_counter", lambda: now[0])
    parts = finishing_parts(2, effects=4)
    assert [name for name, _ in parts] == [GAINS, HIDDEN, SHAPING, SETTLING, SHAPING, SETTLING, WRITING]
    say = Finishing(Job(tmp_path, emit=events.append), parts, 1400, 0.5)
    for name, steps in parts:
        say.begins(name)
        now[0] += slow * 0.5 * steps
    whole = sum(steps for _, steps in parts)
    assert events[0]["left"] == pytest.approx(0.5 * whole) and events[0]["numbers"] == {"now": GAINS}
    assert [event["total"] for event in events] == [round(1400 + whole)] * len(parts)
    for event in events[1:]:
        assert event["left"] == pytest.approx(first * 0.5 * (whole - (event["done"] - 1400)), rel=0.01)


def test_parts_that_are_left_out_are_over(tmp_path):
    events = []
    say = Finishing(Job(tmp_path, emit=events.append), finishing_parts(1), 100, 1.0)
    say.begins(SHAPING)
    say.begins(WRITING)
    left = (SHAPING, SETTLING, WRITING)
    assert [event["left"] for event in events] == [
        pytest.approx(sum(STEPS[part] for part in left)),
        pytest.approx(4, rel=0.1),
    ]
