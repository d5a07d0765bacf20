"""Which hands a clip shows well enough to read their fingers: crops from the fitted body, and what is no hand of that side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from stages.avatar.body.joints import HANDS, WRISTS
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.estimators.hands.network import HandNetwork, SeenHand
from stages.estimators.person.crops import Roi
from stages.records import BodyModel, BodyPoses, Cameras

LONG = 1.7  # a hand's length in distances of its wrist and the root of its middle finger
# px of a hand's length. Shrunk pictures of the kitchen clip: points move by 0.13 cm at 40 px, 0.23 at 27, 0.5 at 17; but of a
# juggler's and an athlete's hands of 28 px, soft as films are, half of those that the network is sure of are wrong to look at.
LEAST = 40
WINDOW = 1.9  # lengths of the hand: side of the first crop, around the root of the middle finger
SURE = 0.8  # probability of a hand in the crop
SIDE = 0.5  # and that it is of the right side: not the other hand, not one seen from the wrong side
ASTRAY = 0.35  # lengths that a hand's wrist may be from the body's
REACH = 0.1  # lengths: so near to the person's mask a point is the person's
# Share of a hand's points that are. The network makes up fingers behind a table or a phone and is sure of them. Of the phone
# clip's hands, true ones, the least have 0.81.
SHOWN = 0.7
SAME = 0.25  # lengths: two hands' points that are nearer to each other are one hand's


@dataclass(frozen=True)
class Places:
    """Where a clip's hands must be, left and right: `wrists` and `roots` [F,2,2] px, of the middle finger, `lengths` [F,2] px, and
    how many px a metre has there, `scales` [F,2]."""

    wrists: np.ndarray
    roots: np.ndarray
    lengths: np.ndarray
    scales: np.ndarray

    def roi(self, frame: int, side: int) -> Roi:
        """The crop in which a hand is looked for, the forearm below it."""
        dx, dy = self.roots[frame, side] - self.wrists[frame, side]
        x, y = self.roots[frame, side].tolist()
        return Roi(x, y, WINDOW * float(self.lengths[frame, side]), float(np.arctan2(dx, -dy)))


def places(model: BodyModel, poses: BodyPoses, cameras: Cameras) -> Places:
    """Where the hands of a fitted body are in the pictures; of length 0 where they are behind the camera."""
    body = Body(model)
    parts = (torch.tensor(v, dtype=torch.float32) for v in (poses.global_orient, poses.body_pose, 0 * poses.transl))
    with torch.no_grad():
        shape = torch.tensor(poses.betas, dtype=torch.float32)
        joints = body(shape, *parts)[1].double().numpy() + poses.transl[:, None]
        rest = body.rest_joints(shape).double().numpy()
    views = rescale_viewmats(cameras.viewmats, poses.world_from_sfm)
    pixels, depth = project(joints[:, [*WRISTS, *HANDS]], views, cameras.Ks)
    size = LONG * np.linalg.norm(rest[list(HANDS)] - rest[list(WRISTS)], axis=1)
    scales = cameras.Ks[:, 0, 0, None] / depth[:, :2].clip(1e-3)
    return Places(pixels[:, :2], pixels[:, 2:], scales * size * (depth[:, :2] > 1e-3), scales)


def seen_hands(image: Callable[[int], np.ndarray], where: Places, looked: np.ndarray) -> list[list[SeenHand | None]]:
    """The hands, left and right, in each of F pictures where `looked` [F,2] says so, None elsewhere; `image` gives a picture."""
    found: list[list[SeenHand | None]] = [[None, None] for _ in looked]
    if not looked.any():
        return found
    network = HandNetwork()
    for i, sides in enumerate(looked.tolist()):
        if any(sides):
            picture = image(i)
            found[i] = [network.read(picture, where.roi(i, s), s == 0) if sides[s] else None for s in (0, 1)]
    return found


def looked_for(where: Places, size: tuple[int, int]) -> np.ndarray:
    """The hands [F,2] bool that are large enough and inside a picture of `size` (width, height) px."""
    inside = ((where.roots > 0) & (where.roots < np.array(size))).all(-1)
    return inside & (where.lengths >= LEAST)


def share_shown(xy: np.ndarray, length: float, mask: np.ndarray) -> float:
    """The share of points [21,2] px, inside a picture, of a hand `length` px long that are in the person's mask uint8 [H,W], or
    within REACH of it.
    """
    columns, rows = xy.astype(int).T
    away = cv2.distanceTransform((mask <= 127).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return float((away[rows, columns] <= REACH * length).mean())


def sure_hands(
    found: list[list[SeenHand | None]], where: Places, size: tuple[int, int], mask: Callable[[int], np.ndarray]
) -> np.ndarray:
    """The hands [F,2] bool that are surely there, whole, of that side, at that wrist, and not both of one and the same; `mask`
    gives the person's mask, uint8 [H,W], of a picture.
    """
    sure = np.zeros((len(found), 2), bool)
    for i, sides in enumerate(found):
        astray = np.full(2, np.inf)
        for s, hand in enumerate(sides):
            if hand is None:
                continue
            astray[s] = np.linalg.norm(hand.xy[0] - where.wrists[i, s]) / where.lengths[i, s]
            inside = ((hand.xy > 0) & (hand.xy < np.array(size))).all()
            sure[i, s] = hand.presence >= SURE and hand.side >= SIDE and astray[s] <= ASTRAY and inside
            sure[i, s] = sure[i, s] and share_shown(hand.xy, float(where.lengths[i, s]), mask(i)) >= SHOWN
        left, right = sides
        if sure[i].all() and left is not None and right is not None:
            apart = np.median(np.linalg.norm(left.xy - right.xy, axis=1)) / where.lengths[i].mean()
            sure[i, int(astray[1] > astray[0])] &= apart > SAME
    return sure
