"""A face capture that the user gives with a clip."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.contract import Job, StageError
from stages.estimators.bodyfit.given_face import check_alone, check_face, with_face
from stages.estimators.bodyfit.reporting import Fitted
from stages.formats.body_model import read_body_model
from stages.gestures import FACE_NAMES
from stages.records import BodyPoses
from tests.made.said import holds

MODEL, TIMES = read_body_model(), np.array([0.0, 0.5, 1.0, 3.0])


@pytest.fixture
def take(tmp_path) -> Path:
    """The jaw opens in a second, and no more is told of it."""
    path = tmp_path / "take.csv"
    path.write_text("time,jawOpen\n7.0,0.2\n8.0,0.6\n")
    return path


def fitted() -> Fitted:
    still = [np.zeros((len(TIMES), n)) for n in (3, 69, 3)]
    names = tuple(f"{i:03}" for i in range(len(TIMES)))
    return Fitted(MODEL, BodyPoses(names, np.zeros(10), *still, np.ones(len(TIMES)), 1.0), None, {})


def test_it_is_read_at_the_times_of_the_frames_and_stays_as_it_was_last(take):
    said = []
    found = with_face(Job(Path(), emit=said.append), take, fitted(), TIMES)
    wanted = np.zeros((4, len(FACE_NAMES)))
    wanted[:, FACE_NAMES.index("jawOpen")] = 0.2, 0.4, 0.6, 0.6
    np.testing.assert_allclose(found.poses.face, wanted)
    words = " ".join(event.get("text", "") for event in said)
    assert holds(words, "take.csv", "1 of 52", "ends at 1.0 s", "3.0 s", "1 of 4 frames")
    said.clear()
    with_face(Job(Path(), emit=said.append), take, fitted(), TIMES[:3])
    assert "ends" not in " ".join(event.get("text", "") for event in said)


def test_it_is_of_one_person_and_of_a_body_with_a_face(take):
    with pytest.raises(StageError, match="one person") as caught:
        check_alone(take, [1, 2])
    assert "--person" in caught.value.hint
    with pytest.raises(StageError, match="SMPL has no face") as caught:
        check_face(take, replace(MODEL, name="SMPL"))
    assert "--body-model" in caught.value.hint
    check_face(take, MODEL)
    check_alone(take, [1])
