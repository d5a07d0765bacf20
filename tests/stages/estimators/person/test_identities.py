"""Everybody at once: two who cross keep who they are by their colours, one who leaves is gone, and a doubt is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.contract import Job
from stages.estimators.person.blazepose import Pose, Sighting
from stages.estimators.person.crops import Roi
from stages.estimators.person.identities import (
    Identity,
    around_mask,
    follow_among,
    follow_everybody,
    lasting,
    track_masked,
)
from tests.made.eyes import BLUE, FRAMES, HEIGHT, RED, SIDE, WIDTH, Eyes, filmed, pose_at
from tests.made.said import any_holds, holds

NAMED = [f"{i:06d}" for i in range(FRAMES)]


def followed(images: list[np.ndarray], starts: tuple[float, float]) -> tuple[list[list[float]], list[str]]:
    """Where each identity is seen, NaN where not, and what was said."""
    said: list[str] = []
    people = [Sighting(0, 0.9, pose_at(x).roi, pose_at(x)) for x in starts]
    tracks = follow_everybody(Job(Path(), emit=lambda event: said.append(event["text"])), Eyes(), images, NAMED, people)
    return [[np.nan if one is None else one.next_roi.x for one in track] for track in tracks], said


CROSSING = np.linspace(40, 160, FRAMES), np.linspace(160, 40, FRAMES)


def test_two_who_cross_stay_who_they_are():
    (first, second), said = followed(filmed((RED, BLUE), CROSSING), (40, 160))
    np.testing.assert_allclose(first, CROSSING[0], atol=1)
    hidden = np.isnan(second)
    assert 1 <= hidden.sum() <= 6 and hidden[FRAMES // 2], "the second is behind the first there"
    np.testing.assert_allclose(np.array(second)[~hidden], CROSSING[1][~hidden], atol=5)
    assert holds(said[0], "2 people", "000000", 1, "x 40") and len(said) == 1


def test_where_they_turn_back_behind_each_other_colours_tell_them_apart():
    back = 100 - np.abs(np.linspace(-60, 60, FRAMES)), 100 + np.abs(np.linspace(-60, 60, FRAMES))
    (first, second), _ = followed(filmed((RED, BLUE), back), (40, 160))
    assert first[-1] < 60 and second[-1] > 140, "they met and went back: going on would have exchanged them"


def test_of_two_in_the_same_clothes_the_doubt_is_said():
    back = 100 - np.abs(np.linspace(-60, 60, FRAMES)), 100 + np.abs(np.linspace(-60, 60, FRAMES))
    _, said = followed(filmed((RED, (201, 40, 40)), back), (40, 160))
    assert any_holds(said, "uncertain", "exchanged")


def test_who_fits_is_not_given_away_so_that_the_other_gets_somebody():
    """The second is suddenly on the first's other side, too far to have walked: only in each other's places would both be seen."""
    jumping = np.where(np.arange(FRAMES) < 10, 123.0, 77.0)
    (first, second), _ = followed(filmed((RED, RED), (np.full(FRAMES, 100.0), jumping)), (100, 123))
    np.testing.assert_allclose(first[:13], 100, atol=1)
    assert np.isfinite(second[:10]).all() and np.isnan(second[10:13]).all()


def test_who_is_seen_goes_on_when_in_the_other_place_is_somebody_else():
    """Another in the second's place fits nobody: the second is not seen, and that costs the first nothing."""
    still, aside = np.full(FRAMES, 60.0), np.full(FRAMES, 175.0)
    images = filmed((RED, BLUE), (still, aside - 15))[:10] + filmed((RED, (40, 200, 40)), (still, aside))[10:]
    (first, second), _ = followed(images, (60, 160))
    assert np.isfinite(first).all() and np.isfinite(second[:10]).all() and np.isnan(second[10:]).all()


def test_who_is_where_they_were_is_themselves_in_other_colours():
    """A leg that is thrown up shows what is behind it, and a cloud changes all colours."""
    still = np.full(FRAMES, 60.0), np.full(FRAMES, 160.0)
    images = filmed((RED, BLUE), still)[:10] + filmed((RED, (40, 200, 40)), still)[10:]
    (first, second), _ = followed(images, (60, 160))
    assert np.isfinite(first).all() and np.isfinite(second).all()


def test_one_who_leaves_is_gone_and_the_other_is_not_taken_for_them():
    leaving = np.where(np.arange(FRAMES) < 8, 160 + 3.0 * np.arange(FRAMES), np.nan)
    (first, second), _ = followed(filmed((RED, BLUE), (np.full(FRAMES, 60.0), leaving)), (60, 160))
    assert np.isfinite(first).all() and np.isfinite(second[:8]).all() and np.isnan(second[8:]).all()


def test_one_of_two_is_followed_and_never_the_other():
    leaving = np.where(np.arange(FRAMES) < 8, 160 + 3.0 * np.arange(FRAMES), np.nan)
    images = filmed((RED, BLUE), (np.full(FRAMES, 60.0), leaving))
    people = [Sighting(0, 0.9, pose_at(x).roi, pose_at(x)) for x in (60, 160)]
    said: list[str] = []
    job = Job(Path(), emit=lambda event: said.append(event["text"]))

    def seen(x: float, wanted: bool) -> list[int]:
        start = Sighting(3, 0.9, pose_at(x).roi, pose_at(x))
        tracks = follow_among(job, Eyes(), images, NAMED, people, start, wanted)
        return [sum(pose is not None for pose in track) for track in tracks]

    assert seen(60, True) == seen(60, False) == [FRAMES, 8] and seen(160, True) == [8, FRAMES] and not said
    assert seen(110, True) == [] and not said
    assert seen(160, False) == [FRAMES, 8], "who passes by is not who the clip is of"
    (text,) = said
    assert holds(text, "8 of 21 frames", 21, "000000", "x 60", "y 30 px", "40 px")


def test_a_small_person_beside_a_large_one_is_somebody_else():
    class Sizes(Eyes):
        """The red one is large: their crop holds the blue one."""

        def look(self, image: np.ndarray, roi: Roi) -> tuple[Pose, np.ndarray]:
            pose, outline = super().look(image, roi)
            red = tuple(image[30, min(max(round(pose.next_roi.x), 0), WIDTH - 1)]) == RED
            return replace(pose, next_roi=Roi(pose.next_roi.x, 30.0, 100.0 if red else SIDE, 0.0)), outline

    beside = np.full(FRAMES, 60.0), np.full(FRAMES, 85.0)
    images, eyes, said = filmed((RED, BLUE), beside), Sizes(), []
    people = [Sighting(0, 0.9, pose_at(x).roi, eyes.look(images[0], pose_at(x).roi)[0]) for x in (60.0, 85.0)]
    assert people[0].pose.next_roi.covers(people[1].pose.next_roi)
    job = Job(Path(), emit=lambda event: said.append(event["text"]))
    tracks = follow_everybody(job, eyes, images, NAMED, people)
    assert len(tracks) == 2 and all(pose is not None for track in tracks for pose in track)


def test_a_masked_person_is_followed_through_another_who_stands_before_them():
    images = filmed((RED, BLUE), CROSSING)
    own = [255 * (image == BLUE).all(2).astype(np.uint8) for image in images]
    others = [255 * (image == RED).all(2).astype(np.uint8) for image in images]
    found = [np.nan if one is None else one.next_roi.x for one in track_masked(Eyes(), images, own, others)]
    seen = np.isfinite(found)
    assert seen.sum() >= FRAMES - 6 and not seen[FRAMES // 2]
    np.testing.assert_allclose(np.array(found)[seen], CROSSING[1][seen], atol=5)


def test_the_crop_around_a_mask_holds_it():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:50, 90:110] = 255
    roi = around_mask(mask)
    assert (roi.x, roi.y) == (100, 30) and 40 < roi.side < 60 and roi.angle == 0


def test_who_is_hardly_seen_is_left_out_and_it_is_said(tmp_path, monkeypatch):
    often, seldom, said = [pose_at(50.0)] * FRAMES, [pose_at(90.0)] + [None] * (FRAMES - 1), []
    monkeypatch.setattr(Job, "warn", lambda job, text: said.append(text))
    assert lasting(Job(tmp_path), [often, often]) == [often, often] and said == []
    assert lasting(Job(tmp_path), [often, seldom]) == [often]
    assert "person 2 in 1;" in said[0] and f"of {FRAMES} frames" in said[0]


def test_who_is_seen_on_is_not_taken_for_another_who_was_lost_nor_for_one_of_another_size():
    colours = np.zeros(6)
    here, lost = Identity(pose_at(100).roi, colours), Identity(pose_at(104).roi, colours, unseen=2)
    there = pose_at(103)
    assert here.cost(there, colours) < lost.cost(there, colours), "though the other is nearer"
    small = Identity(Roi(102, 30.0, SIDE / 2, 0.0), colours)
    assert here.cost(there, colours) + 0.5 < small.cost(there, colours)


def test_who_is_not_where_they_were_going_is_found_beside():
    """The detector is blind, and the network sees only who is near the middle of a crop."""
    ways = np.full(FRAMES, 40.0), np.where(np.arange(FRAMES) < 4, 120.0, 140.0)

    class Blind(Eyes):
        def detect(self, image, window=None):
            return []

        def look(self, image, roi):
            pose, outline = super().look(image, roi)
            return (pose if abs(pose.next_roi.x - roi.x) < SIDE / 3 else replace(pose, presence=0.0)), outline

    people = [Sighting(0, 0.9, pose_at(x).roi, pose_at(x)) for x in (40, 120)]
    _, second = follow_everybody(Job(Path()), Blind(), filmed((RED, BLUE), ways), NAMED, people)
    assert all(one is not None for one in second) and abs(second[-1].next_roi.x - 140) < 1
