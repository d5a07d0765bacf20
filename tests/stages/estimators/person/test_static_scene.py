"""Outlines corrected by the static scene, in a drawn room."""

import cv2
import numpy as np
import pytest

from stages.estimators.person import static_scene
from stages.estimators.person.static_scene import corrected, with_outline
from tests.made import rooms

COUNT = 9


@pytest.fixture(scope="module")
def clip():
    """Pictures of a walk through a lens, the true masks, and masks with a blob and a cut."""
    images = [rooms.photograph(view) for view in rooms.walk(COUNT, 0.8)]
    patch, truth, guessed = rooms.texture(9) // 2 + np.array([120, 60, 0], np.uint8), [], []  # reddish
    for i, image in enumerate(images):
        mask, left = np.zeros((rooms.HEIGHT, rooms.WIDTH), np.uint8), 190 - 12 * i
        image[60:200, left : left + 50] = patch[100:240, 300:350]
        mask[60:200, left : left + 50] = 255
        wrong = mask.copy()
        wrong[95:135, left + 50 : left + 62] = 220  # of the room, rather sure
        wrong[60:80, left : left + 25] = 60  # a piece of the person is doubted
        truth.append(mask)
        guessed.append(cv2.GaussianBlur(wrong, (0, 0), 1.0))
    return images, truth, guessed


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return ((a > 127) & (b > 127)).sum() / ((a > 127) | (b > 127)).sum()


@pytest.mark.slow
def test_a_blob_goes_and_a_doubted_piece_comes_back(clip):
    images, truth, guessed = clip
    found = list(corrected(guessed, images))
    before = [overlap(*pair) for pair in zip(guessed, truth)]
    after = [overlap(*pair) for pair in zip(found, truth)]
    assert max(before) < 0.88 and min(after) > 0.91 and np.mean(after) > 0.94  # a part is hidden in all other frames
    assert after[3] > 0.975  # all of it is shown by others


@pytest.mark.slow
def test_somebody_tall_is_compared_in_smaller_pictures_and_outlined_in_their_own(clip, monkeypatch):
    images, truth, guessed = clip
    sizes: list[tuple[int, int]] = []
    compared = static_scene._compared
    monkeypatch.setattr(static_scene, "_compared", lambda *given: sizes.append(given[2].shape) or compared(*given))
    monkeypatch.setattr(static_scene, "TALL", 70)  # of 140 px
    found = list(corrected(guessed, images))
    assert set(sizes) == {(rooms.HEIGHT // 2, rooms.WIDTH // 2)} and found[0].shape == (rooms.HEIGHT, rooms.WIDTH)
    assert (
        min(overlap(*pair) for pair in zip(found, truth)) > max(overlap(*pair) for pair in zip(guessed, truth)) + 0.02
    )


@pytest.mark.slow
def test_a_camera_may_stand_still(clip):
    images, truth, guessed = clip
    room = images[0].copy()
    room[truth[0] > 0] = images[-1][truth[0] > 0]
    still = []
    for image, mask in zip(images, truth):
        picture = room.copy()
        picture[mask > 0] = image[mask > 0]
        still.append(picture)
    found = list(corrected(guessed, still))
    after = [overlap(*pair) for pair in zip(found, truth)]
    assert min(after) > 0.92 and np.mean(after) > 0.96


def test_what_no_other_frame_shows_stays_as_it_was(clip):
    images, _, guessed = clip
    empty = np.zeros_like(guessed[0])
    assert next(corrected(guessed[:1], images[:1])) is guessed[0]
    assert list(corrected([guessed[0], guessed[1], empty], images[:3]))[2] is empty  # nobody there
    assert list(corrected([empty] * 3, images[:3])) == [empty] * 3


def test_where_nothing_can_be_followed_masks_stay_as_they_were(clip):
    images, _, guessed = clip
    plain = [np.full_like(image, 128) for image in images]
    assert all(found is mask for found, mask in zip(corrected(guessed, plain), guessed, strict=True))


@pytest.mark.slow
def test_a_frame_in_which_the_person_is_missed_is_no_proof_that_nobody_is_there(clip):
    images, truth, _ = clip
    room = images[0].copy()
    room[truth[0] > 0] = images[-1][truth[0] > 0]
    stands, still = cv2.GaussianBlur(truth[4], (0, 0), 1.0) // 5 * 4, room.copy()
    still[truth[4] > 0] = images[4][truth[4] > 0]
    unsure = [stands] * 4 + [np.zeros_like(stands)] + [stands] * 4
    found = list(corrected(unsure, [still] * 9))
    assert min(overlap(mask, truth[4]) for i, mask in enumerate(found) if i != 4) > 0.9
    gone = [stands] * 3 + [np.zeros_like(stands)] * 8
    empty = list(corrected(gone, [still] * 3 + [room] * 8))  # and one who has left for good shows the room
    assert overlap(empty[1], truth[4]) > 0.9


def test_what_an_outline_wins_is_the_nearest_persons_and_what_it_loses_is_nobodys():
    one, other = np.zeros((2, 20, 40), np.uint8)
    one[5:15, 5:15], other[5:15, 25:35] = 200, 255
    after = np.maximum(one, other)
    after[5:15, 5:15], after[5:15, 15:17], after[5:15, 23:25], after[5:7, 5:15] = 255, 255, 90, 0
    first, second = with_outline([one, other], after)
    assert (first[7:15, 5:17] == 255).all() and not first[5:7, 5:15].any() and not first[:, 20:].any()
    assert (second[5:15, 25:35] == 255).all() and (second[5:15, 23:25] == 90).all() and not second[:, :20].any()
    assert np.array_equal(np.maximum(first, second), after)
    assert with_outline([one], after)[0] is after
