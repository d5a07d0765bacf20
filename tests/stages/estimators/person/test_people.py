"""Several people before the built-in segmenter: all are found, one is followed, another can be picked, doubts are said."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.contract import Job, StageError
from stages.estimators.person.blazepose import NAMES, BlazePose, Pose, Sighting, pick_clearest, pick_masked
from stages.estimators.person.crops import Roi
from stages.estimators.person.outline import outline
from stages.estimators.person.people import Bystanders
from stages.formats.body_model import read_body_model
from tests.made.said import holds
from tests.made.synthetic.clip import make_clip

FRAMES = [f"{3 * i:06d}" for i in range(6)]


def seen(frame: int, x: float, side: float, score: float = 0.9) -> Sighting:
    """Somebody whose hips are at x, 100."""
    roi = Roi(x, 100.0, side, 0.0)
    xy = np.full((len(NAMES), 2), [x, 100.0])
    return Sighting(frame, score, roi, Pose(xy, xy[:, 0], np.zeros((33, 3)), 1.0, roi, roi))


def bystanders(sightings: list[Sighting], person: int | str | None = None) -> tuple[Bystanders, list[str]]:
    said: list[str] = []
    return Bystanders(Job(Path(), emit=lambda event: said.append(event["text"])), FRAMES, sightings, person), said


TWO = [seen(0, 50, 80), seen(2, 52, 90), seen(2, 250, 60), seen(5, 55, 100)]


def test_the_largest_is_followed_and_the_others_are_named_with_numbers():
    one, said = bystanders(TWO)
    assert one.start is TWO[3]
    assert holds(said[0], "2 people", "000006", "1 of 3 frames", 1, "x 52", "y 100", "90 px", 2)
    assert holds(said[1], "largest", "--person")


def test_another_is_picked_by_number_and_an_unknown_one_is_refused():
    one, said = bystanders(TWO, 2)
    assert one.start is TWO[2] and holds(said[1], "person 2")
    for person in (3, 0, "bob"):
        with pytest.raises(StageError, match=f"{person!r}") as error:
            bystanders(TWO, person)
        assert holds(error.value.facts[0], 2, "000006", 1, "x 52") and "--person" in error.value.hint
    with pytest.raises(StageError, match=r"\b1\b"):
        bystanders([], 1)


def test_one_doubtful_sighting_is_no_second_person():
    alone = [seen(i, 50 + i, 80) for i in range(5)]
    one, said = bystanders([*alone, seen(3, 250, 60)])
    assert one.start in alone and len(said) == 1
    assert holds(said[0], "perhaps 2 people", "000009", "none", "4 frames", "1 at")
    assert "following the largest" in bystanders([*alone, seen(2, 240, 60), seen(3, 250, 60)])[1][1]


def test_one_person_is_not_worth_a_word():
    one, said = bystanders([seen(0, 50, 80), seen(3, 60, 80)])
    assert one.start.frame in (0, 3) and said == []
    assert bystanders([])[0].start is None


def test_an_outline_that_holds_two_and_a_jump_are_said():
    one, said = bystanders(TWO)
    mask = np.full((200, 300), 255, np.uint8)
    one.look(2, TWO[1].pose, mask)
    one.close()
    assert holds(said[-1], "covers somebody else", "1 of 1 frames", "000006")
    alone, said = bystanders(TWO)
    mask[:, 150:] = 0
    alone.look(2, TWO[1].pose, mask)
    alone.close()
    assert len(said) == 2
    poses = [TWO[0].pose, TWO[0].pose, None, TWO[2].pose, TWO[0].pose, TWO[0].pose]
    alone.warn_of_jumps(poses)
    assert holds(said[-1], "jumps", "1 of 6 frames", "000012")


def test_the_masked_person_is_followed():
    masks = [np.zeros((200, 300), np.uint8) for _ in FRAMES]
    masks[2][80:120, 230:270] = 255
    assert pick_masked(TWO, masks) is TWO[2] and pick_clearest(TWO) is TWO[3]
    assert pick_masked(TWO, [np.zeros((200, 300), np.uint8)] * 6) is TWO[3], "masks that fit nobody choose nobody"


def test_people_are_looked_for_in_a_few_frames_or_in_those_that_are_asked(monkeypatch):
    looked: list[int] = []
    monkeypatch.setattr(BlazePose, "__init__", lambda self: None)
    monkeypatch.setattr(BlazePose, "search", lambda self, image: looked.append(int(image[0, 0, 0])) or [])
    images = [np.full((4, 4, 3), i, np.uint8) for i in range(80)]
    network = BlazePose()
    for known, wanted in (({}, 9), ({"among": range(1, 6)}, 5), ({"most": 80}, 80), ({"among": []}, 0)):
        looked.clear()
        assert network.sightings(images, **known) == [] and len(looked) == wanted
        assert not known.get("among") or looked == [1, 2, 3, 4, 5]


@pytest.mark.slow
def test_two_people_side_by_side_are_found_and_either_is_followed(blazepose):
    clip = make_clip(read_body_model(), width=240, height=320, frames=3, fps=4, novel=1).frames
    images, truth = [], []
    for i in range(3):
        small = [cv2.resize(p[2 - i], (180, 240), interpolation=cv2.INTER_AREA) for p in (clip.images, clip.masks)]
        right = np.full((320, 180, 3), 90, np.uint8), np.zeros((320, 180), np.uint8)
        for whole, part in zip(right, small, strict=True):
            whole[80:] = part
        images.append(np.concatenate([clip.images[i], right[0]], 1))
        one, two = np.zeros((320, 420), bool), np.zeros((320, 420), bool)
        one[:, :240], two[:, 240:] = clip.masks[i] > 127, right[1] > 127
        truth.append((one, two))
    sightings = blazepose.sightings(images)
    assert max(sum(one.frame == i for one in sightings) for i in range(3)) == 2
    alone = blazepose.sightings(list(clip.images))
    assert len({one.frame for one in alone}) == len(alone) == 3, "one person is seen once a frame"
    for person in (None, 2):
        poses = blazepose.track(images, bystanders(sightings, person)[0].start)
        found = outline(blazepose, images[0], poses[0].next_roi) > 0.5
        wanted, other = truth[0] if person != 2 else truth[0][::-1]
        assert (found & wanted).sum() / (found | wanted).sum() > 0.75 and not (found & other).any()
    assert pick_masked(sightings, [two.astype(np.uint8) * 255 for _, two in truth]).pose.next_roi.x > 240
