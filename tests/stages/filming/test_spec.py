"""What can be asked of a film is bounded before anything is read."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from stages.commands.compose import Params, run
from stages.contract import Job, StageError

ONE = {"avatar": "nobody.npz", "motion": "wave"}


@pytest.mark.parametrize("value", [1e18, 1e300, -1e18, float("inf"), float("nan"), 10**400])
@pytest.mark.parametrize(
    "key",
    ["seconds", "moment", "fps", "size", "stills", "point", "up", "start", "at", "speed", "scale", "motion_fps", "who"],
)
def test_no_number_is_without_bounds(key, value):
    person = {"start": value, "speed": value, "scale": value, "motion_fps": value, "who": value, "at": [value, 0]}
    film = {
        "seconds": value, "moment": value, "fps": value, "size": [value, 48],
        "ground": {"point": [0, value, 0] if key == "point" else [0, 0, 0], "up": [value, 0, 0] if key == "up" else [0, 1, 0]},
        "out": {"stills": {"folder": "x", "at": [0, value]}},
    }  # fmt: skip
    top = {"point": "ground", "up": "ground", "stills": "out"}.get(key, key)
    given = {"people": [ONE | {key: person[key]}]} if key in person else {"people": [ONE], top: film[top]}
    with pytest.raises(ValidationError):
        Params(**given)


@pytest.mark.parametrize("small", ["speed", "scale", "motion_fps", "fps"])
def test_nothing_is_divided_by_next_to_nothing(small):
    given = {"people": [ONE | {small: 1e-300}]} if small != "fps" else {"people": [ONE], "fps": 1e-300}
    with pytest.raises(ValidationError):
        Params(**given)


@pytest.mark.parametrize("asked", [{"seconds": 86400, "fps": 240}, {"people": [ONE | {"start": 86400}], "fps": 60}])
def test_a_film_of_a_day_is_refused_before_anything_is_read(asked):
    with pytest.raises(StageError, match="too many pictures") as caught:
        run(Job(Path("nowhere")), Params(**{"people": [ONE], "out": {"film": "a.mp4"}} | asked))
    assert "pictures" in caught.value.facts[0]
