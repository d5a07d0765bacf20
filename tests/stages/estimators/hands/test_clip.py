"""Hands of a whole clip, with made looks in place of the network's."""

import numpy as np

from stages.estimators.hands import clip
from stages.estimators.hands.seeing import Places
from stages.formats.hands import read_hands, write_hands
from stages.records import BodyPoses, Cameras
from tests.made.hands import MODEL, RIG, hand, points, seen, waving

FRAMES = 12
NAMES = tuple(f"{i:03}" for i in range(FRAMES))
POSES = BodyPoses(
    NAMES, np.zeros(10), np.zeros((FRAMES, 3)), np.zeros((FRAMES, 69)), np.zeros((FRAMES, 3)), np.ones(FRAMES)
)
CAMERAS = Cameras(NAMES, np.tile(np.eye(4), (FRAMES, 1, 1)), np.tile(np.eye(3), (FRAMES, 1, 1)), 400, 300)
TIMES = np.arange(FRAMES) / 15
WHOLE = np.full((300, 400), 255, np.uint8)


def looks(monkeypatch, left, right, length=60.0):
    """Let hands be at fixed places in the pictures, with points [F,21,3] of right hands, None where nothing is seen."""
    wrists = np.tile([[100.0, 200], [300, 200]], (FRAMES, 1, 1))
    where = Places(wrists, wrists - [0, 35], np.full((FRAMES, 2), length), np.full((FRAMES, 2), 300.0))
    found = [
        [
            None if world is None else seen_with(x, world[i] * flip)
            for x, world, flip in zip((100, 300), (left, right), clip.MIRROR)
        ]
        for i in range(FRAMES)
    ]
    monkeypatch.setattr(clip, "places", lambda *_: where)
    monkeypatch.setattr(
        clip, "seen_hands", lambda image, where, looked: found if looked.all() else [[None, None]] * FRAMES
    )


def seen_with(x, world):
    one = seen(x, 200)
    xy = [x, 200] + 300 * (world - world[0])[:, :2]
    return type(one)(xy, world, one.presence, one.side, one.roi)


def found():
    return clip.hands_of(
        RIG, MODEL, POSES, CAMERAS, TIMES, lambda i: np.zeros((300, 400, 3), np.uint8), lambda i: WHOLE
    )[0]


def test_a_left_hand_is_the_mirror_image_of_a_right_one(monkeypatch):
    angles = waving(FRAMES)
    looks(monkeypatch, points(angles), points(angles))
    hands = found()
    assert hands.read.all() and np.abs(hands.turns[:, 1]).max() > 0.5
    assert np.allclose(hands.turns[:, 0], hands.turns[:, 1] * [1, -1, -1], atol=0.05)
    truth = hand().rotvecs(angles).numpy()
    assert np.median(np.linalg.norm(hands.turns[:, 1] - truth, axis=-1)) < 0.2
    assert "left hand in 12 of 12 frames and right hand in 12" in clip.what_is_read(hands)


def test_one_hand_alone_bends_alone(monkeypatch):
    looks(monkeypatch, None, points(hand().relaxed.expand(FRAMES, 21)))
    hands = found()
    assert not hands.turns[:, 0].any() and not hands.shape[0].any() and not hands.error[:, 0].any()
    assert np.allclose(hands.shape[1], hand().rotvecs(hand().relaxed).numpy(), atol=0.05)
    facts = clip.facts_of(hands)
    assert facts["left"] == {"length_px": 60.0, "read_in": 0} and facts["right"]["read_in"] == FRAMES


def test_small_hands_need_no_network_and_stay_at_rest(monkeypatch, tmp_path):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    hands = found()  # the camera stands in the body: nothing is in the picture
    assert (
        not hands.turns.any() and not hands.read.any() and "stay as the body's are at rest" in clip.what_is_read(hands)
    )
    write_hands(tmp_path / "hands.npz", hands)
    again = read_hands(tmp_path / "hands.npz")
    assert (
        again.names == NAMES and np.array_equal(again.length, hands.length) and again.turns.shape == (FRAMES, 2, 15, 3)
    )


def test_a_hand_that_hardly_a_frame_shows_is_not_read(monkeypatch):
    world = points(hand().relaxed.expand(FRAMES, 21))
    looks(monkeypatch, world, world)
    monkeypatch.setattr(clip, "ENOUGH", FRAMES + 1)
    hands = found()
    assert not hands.read.any() and not hands.turns.any() and "no frames show one well" in clip.what_is_read(hands)
