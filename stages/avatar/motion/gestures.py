"""Movements of hands and face made by formula: they go with those of the body in `formulas`, of the same names.

Each function takes seconds and frames per second and returns hands [F,2,15,3] rad, as FINGER_NAMES, and coefficients of the face
[F,52], as FACE_NAMES.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stages.avatar.body.face import face_vector
from stages.avatar.motion.formulas import ease, times
from stages.gestures import FACE_NAMES

Gestures = tuple[np.ndarray, np.ndarray]

STRAIGHT, CLOSED = (-0.36, -0.1, -0.03), (1.1, 1.6, 1.0)
"""How far the bones of a finger bend towards the palm, rad, from the hand at rest on."""
THUMB = ((-0.1, 0.65, 0.2), (-0.1, 0.5, 0.0), (0.0, 0.8, 0.0))
"""Turns of a left thumb that lies across the palm, rad."""
APART = (-0.12, 0.0, 0.22, 0.1)
"""Turns of a left hand's spread index, middle, pinky and ring about the vertical, rad."""
MIRRORED = (1, -1, -1)  # a turn of the left hand, for the right one
ORDER = (4, 0, 1, 3, 2)  # of the fingers with which one counts: thumb, index, middle, ring, pinky
TICK = 0.12  # s that a finger takes to open
SAID = "jawOpen mouthFunnel jawOpen mouthSmileLeft+mouthSmileRight mouthPucker jawOpen mouthClose+jawOpen mouthStretchLeft".split()
"""What a mouth does, syllable by syllable."""
SYLLABLE = 0.21  # s


def fingers_at(opened: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """A left hand [F,15,3] rad whose five fingers, in SMPL-X's order, are opened [F,5] from 0, closed, to 1, and spread [F]."""
    hand = np.zeros((len(opened), 5, 3, 3))
    bends = opened[..., None] * np.array(STRAIGHT) + (1 - opened[..., None]) * np.array(CLOSED)
    hand[:, :4, :, 2] = -bends[:, :4]
    hand[:, :4, 0, 1] = spread[:, None] * np.array(APART)
    hand[:, 4] = (1 - opened[:, 4, None, None]) * np.array(THUMB)
    return hand.reshape(len(opened), 15, 3)


def fist() -> np.ndarray:
    """Both hands closed, [2,15,3] rad."""
    hand = fingers_at(np.zeros((1, 5)), np.zeros(1))[0]
    return np.stack([hand, hand * MIRRORED])


def count_to_five(seconds: float, fps: float) -> Gestures:
    """The right hand opens finger by finger, from a fist to five; the mouth says each number."""
    t = times(seconds, fps).numpy() * seconds
    raised = ease(seconds, fps, 0.8).numpy()
    begin, each = 0.8, (seconds - 1.6) / 5
    opened = np.zeros((len(t), 5))
    spoken = np.zeros(len(t))
    for number, finger in enumerate(ORDER):
        since = t - begin - number * each
        opened[:, finger] = (since / TICK).clip(0, 1)
        spoken += np.exp(-0.5 * ((since - 0.15) / 0.09) ** 2)
    relaxed = np.full(opened.shape, 0.75)
    hands = np.zeros((len(t), 2, 15, 3))
    counting = fingers_at(raised[:, None] * opened + (1 - raised[:, None]) * relaxed, raised)
    hands[:, 1] = counting * MIRRORED
    face = spoken[:, None] * face_vector({"jawOpen": 0.35, "mouthLowerDownLeft": 0.3, "mouthLowerDownRight": 0.3})
    return hands, face + _blinks(t)


def say_a_sentence(seconds: float, fps: float) -> Gestures:
    """The mouth goes through syllables, brows rise with some, eyes blink, and a smile ends it; open hands go along a little."""
    t, level = times(seconds, fps).numpy() * seconds, ease(seconds, fps, 0.5).numpy()
    face = np.zeros((len(t), len(FACE_NAMES)))
    for number in range(math.floor((seconds - 1.2) / SYLLABLE)):
        at = 0.5 + (number + 0.5) * SYLLABLE
        shapes = dict.fromkeys(SAID[number % len(SAID)].split("+"), 0.45 + 0.15 * math.sin(2.4 * number))
        face += np.exp(-0.5 * ((t - at) / (0.4 * SYLLABLE)) ** 2)[:, None] * face_vector(shapes)
    brows = 0.4 * level * np.sin(2 * np.pi * t / 1.6).clip(0)
    face += brows[:, None] * face_vector({"browInnerUp": 1, "browOuterUpLeft": 0.7, "browOuterUpRight": 0.7})
    smile = np.exp(-0.5 * ((t - seconds + 0.45) / 0.22) ** 2)
    face += smile[:, None] * face_vector({"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7})
    opened = 0.8 + 0.2 * level * np.sin(2 * np.pi * t / 1.1)
    hand = fingers_at(np.repeat(opened[:, None], 5, 1), 0.5 * level)
    return np.stack([hand, hand * MIRRORED], 1), (face + _blinks(t)).clip(0, 1)


GESTURES: dict[str, Callable[[float, float], Gestures]] = {
    "count_to_five": count_to_five,
    "say_a_sentence": say_a_sentence,
}


def _blinks(t: np.ndarray) -> np.ndarray:
    shut = np.exp(-0.5 * (((t % 2.3) - 1.2) / 0.06) ** 2)
    return shut[:, None] * face_vector({"eyeBlinkLeft": 1, "eyeBlinkRight": 1})
