"""The fingers of a person through a clip: read where a hand is large enough in the pictures, else those of the body at rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from stages.avatar.body.fingers import finger_joints
from stages.avatar.body.joints import WRISTS
from stages.avatar.body.smpl import Body
from stages.estimators.hands.angles import HandAngles
from stages.estimators.hands.arms import SeenPalms
from stages.estimators.hands.bending import bend
from stages.estimators.hands.network import PALM, POINTS
from stages.estimators.hands.seeing import LEAST, looked_for, places, seen_hands, sure_hands
from stages.gestures import HandPoses, HandsFace
from stages.records import BodyModel, BodyPoses, Cameras

ENOUGH = 3  # frames in which a hand must be read
MIRROR = np.array([[-1.0, 1, 1], [1, 1, 1]])  # points of the left hand as a right one's, and the right one's
TURNED = np.array([[1.0, -1, -1], [1, 1, 1]])  # and turns of the right one as the left one's
SIDES = ("left", "right")


def hands_of(
    rig: HandsFace,
    model: BodyModel,
    poses: BodyPoses,
    cameras: Cameras,
    times: np.ndarray,
    image: Callable[[int], np.ndarray],
    mask: Callable[[int], np.ndarray],
) -> tuple[HandPoses, SeenPalms]:
    """The fingers of a fitted body, whose `rig` is of its size, at `times` [F] s, and where its palms are seen.

    `image` gives a picture, uint8 [H,W,3], `mask` the person's in it, uint8 [H,W]. A hand that fewer than ENOUGH frames show keeps
    the body's fingers at rest. Raises StageError if a hand is large enough to be looked at and the network has not been fetched.
    """
    size, count = (cameras.width, cameras.height), len(poses)
    where = places(model, poses, cameras)
    found = seen_hands(image, where, looked_for(where, size) & (poses.confidence > 0)[:, None])
    read = sure_hands(found, where, size, mask)
    read &= read.sum(0) >= ENOUGH
    hand = right_hand(rig, model, poses.betas)
    turns, shape, error = np.zeros((count, 2, 15, 3)), np.zeros((2, 15, 3)), np.zeros((count, 2))
    points, facing, world = np.zeros((count, 2, POINTS, 2)), np.zeros((count, 2, 3, 3)), np.zeros((2, count, POINTS, 3))
    for i, s in zip(*np.nonzero(read)):
        world[s, i] = found[i][s].world * MIRROR[s]
        points[i, s] = found[i][s].xy
    if read.any():
        mirrored = points * MIRROR[:, None, :2]
        bent = bend(hand, world, np.swapaxes(mirrored, 0, 1), where.scales.T, read.T, times)
        read = bent.fits.T & (bent.fits.T.sum(0) >= ENOUGH)
        for s in np.flatnonzero(read.any(0)):
            middle = bent.angles[s][torch.tensor(read[:, s])].median(0).values
            turns[:, s] = hand.rotvecs(bent.angles[s]).numpy() * TURNED[s]
            shape[s] = hand.rotvecs(middle).numpy() * TURNED[s]
            error[:, s] = bent.error[s]
            facing[:, s] = MIRROR[s][:, None] * bent.turns[s] * MIRROR[s]
    hands = HandPoses(poses.names, turns, shape, read, error, where.lengths)
    return hands, SeenPalms(points[:, :, list(PALM)], facing, read, where.lengths, palms_of(rig, model, poses.betas))


def right_hand(rig: HandsFace, model: BodyModel, betas: np.ndarray) -> HandAngles:
    """The bones of the right hand of a body with `betas` [10]."""
    vertices, joints = Body(model).rest(torch.tensor(betas, dtype=torch.float32))
    fingers, tips = (part.numpy() for part in finger_joints(rig, vertices))
    return HandAngles(joints[WRISTS[1]].numpy(), fingers[15:], tips[5:])


def palms_of(rig: HandsFace, model: BodyModel, betas: np.ndarray) -> np.ndarray:
    """Both palms' points [2,5,3] m of a body at rest: the wrist, and where four fingers begin, as the network has them."""
    vertices, joints = Body(model).rest(torch.tensor(betas, dtype=torch.float32))
    roots = finger_joints(rig, vertices)[0].unflatten(0, (2, 15))[:, [0, 3, 9, 6]]
    return torch.cat([joints[list(WRISTS), None], roots], 1).numpy()


def what_is_read(hands: HandPoses) -> str:
    """In how many frames the fingers of which hand were read, and how well; else why of none."""
    read, length = hands.read.sum(0), np.median(hands.length, 0)
    if not read.any():
        small = length.max() < LEAST
        why = (
            f"a hand is {length.max():.0f} px long, of {LEAST} that are needed" if small else "no frames show one well"
        )
        return f"fingers stay as the body's are at rest: {why}"
    each = [f"{side} hand in {n} of {len(hands.names)} frames" for side, n in zip(SIDES, read, strict=True) if n]
    alone = [f"the {side} hand's stay as at rest" for side, n in zip(SIDES, read, strict=True) if not n]
    return ", ".join(
        [f"fingers read: {' and '.join(each)}, {100 * np.median(hands.error[hands.read]):.1f} cm off", *alone]
    )


def facts_of(hands: HandPoses) -> dict[str, Any]:
    """What smpl.json says of each hand; the frames in which fingers that are read in others are filled in are doubtful."""
    facts: dict[str, Any] = {}
    for s, side in enumerate(SIDES):
        read = hands.read[:, s]
        facts[side] = {"length_px": round(float(np.median(hands.length[:, s])), 1), "read_in": int(read.sum())}
        if read.any():
            facts[side]["expected_error_mm"] = round(1000 * float(np.median(hands.error[read, s])), 1)
            facts[side]["doubtful"] = [name for name, sure in zip(hands.names, read, strict=True) if not sure]
    return facts
