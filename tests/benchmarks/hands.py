"""How far fingers are off that were read from drawn hands, whose pose is known.

    python -m tests.benchmarks.hands [--sizes 110 60 40 22] [--hands 90] [--hidden]

The free body's right hand in poses from relaxed to wild, and from open to a fist, is drawn in plain shading before a blurred
background, palm or back to the camera, turned by up to 60 degrees, and shown to the hand network. No frame helps another.
Printed: which share is read, how far joints and tips are from the truth in the palm's axes, how far they would be of a hand at
rest, and how far the palm is turned otherwise. With `--hidden` also of hands in gloves, that hold something, or that something
hides. The network must have been fetched.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.fingers import bent_skin
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.kernels.mesh import fill
from stages.estimators.hands.bending import bend
from stages.estimators.hands.network import POINTS, HandNetwork
from stages.estimators.hands.seeing import SHOWN, SIDE, SURE, WINDOW, share_shown
from stages.estimators.person.crops import Roi
from tests.made.hands import MODEL, RIG, hand, waving

LONG, AWAY = 0.18, 2.5  # m: length of the hand, distance of the camera
SKIN = (215, 160, 135)
LIGHT = np.array([-0.3, -0.6, -0.7]) / np.linalg.norm([0.3, 0.6, 0.7])
UP = np.array([[0.0, 0, -1], [1, 0, 0], [0, 1, 0]]) * [
    [-1],
    [1],
    [1],
]  # fingers up in the picture, the palm to the camera
GLOVES = {"blue glove": (60, 90, 170), "black glove": (38, 38, 42), "white glove": (245, 245, 245)}
Colour = tuple[int, int, int]
Hide = Callable[[np.ndarray, Roi], np.ndarray]


def plate(first: float, last: float, wide: float, colour: Colour) -> Hide:
    """Something flat before a hand: from `first` to `last` lengths of it past the root of its fingers, so many lengths wide."""

    def hide(picture: np.ndarray, roi: Roi) -> np.ndarray:
        size, up = roi.side / WINDOW, np.array([np.sin(roi.angle), -np.cos(roi.angle)])
        ends = [np.array([roi.x, roi.y]) + size * end * up for end in (first, last)]
        aside = size * wide / 2 * np.array([-up[1], up[0]])
        corners = np.array([ends[0] - aside, ends[0] + aside, ends[1] + aside, ends[1] - aside])
        return cv2.fillConvexPoly(picture.copy(), np.rint(16 * corners).astype(np.int32), colour, cv2.LINE_AA, 4)

    return hide


HIDDEN: dict[str, Hide] = {
    "holds a stick": plate(-1.2, 1.2, 0.14, (120, 80, 40)),
    "holds a phone": plate(-0.15, 0.55, 0.42, (20, 20, 22)),
    "holds a bottle": plate(-0.9, 0.5, 0.4, (30, 90, 50)),
    "fingers behind something": plate(0.05, 1.2, 1.6, (70, 110, 160)),
    "behind the back": plate(-0.45, 1.2, 1.6, (70, 110, 160)),
    "blurred": lambda picture, roi: cv2.GaussianBlur(picture, (0, 0), 0.15 * roi.side / WINDOW),
}


class Looked(NamedTuple):
    """Of N drawn hands those `read` [N], how far joints and tips of these R are `off`, and `still` ones would be, [R,5,4] cm; how
    far they are `expected` to be off [R] cm, and how far their palms are `turned` otherwise [R] degrees.
    """

    read: np.ndarray
    off: np.ndarray
    still: np.ndarray
    expected: np.ndarray
    turned: np.ndarray

    def __str__(self) -> str:
        if not self.read.any():
            return "none read"
        off = f"joints {np.median(self.off):.2f} cm off in the median, {self.off.mean():.2f} in the mean"
        beside = f"{self.expected.mean():.2f} expected, at rest {np.median(self.still):.2f}"
        return f"{100 * self.read.mean():3.0f} % read, {off}, {beside}; palm {np.median(self.turned):.0f} degrees off"


def poses(count: int, rng: np.random.Generator) -> torch.Tensor:
    """Angles [count,21]: a third about the relaxed hand, a third wild, a third that curl from open to a fist."""
    bones, third = hand(), count // 3
    near = bones.relaxed + 0.8 * bones.spread * torch.tensor(rng.standard_normal((third, 21)), dtype=torch.float32)
    wild = waving(200)[torch.tensor(rng.choice(200, third, replace=False))]
    curled = bones.rest.repeat(count - 2 * third, 1)
    for pose in curled:
        curl = torch.tensor(rng.random() * rng.integers(2), dtype=torch.float32)
        for joint, most in ((1, 1.3), (2, 1.5), (3, 0.8)):
            pose[joint:16:4] = 0.1 + most * curl
    return torch.cat([near, wild, curled]).clamp(bones.low, bones.high)


def view(rng: np.random.Generator) -> np.ndarray:
    """A turn [3,3] of the hand at rest into camera axes."""
    about = [rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-60, 60) + 180 * rng.integers(2)]
    return Rotation.from_euler("zxy", about, degrees=True).as_matrix() @ UP


def drawn(
    angles: torch.Tensor, turn: np.ndarray, size: float, rng: np.random.Generator, colour: Colour = SKIN
) -> tuple[np.ndarray, np.ndarray, Roi]:
    """A picture of a hand `size` px long, its mask, and the crop in which it is looked for."""
    rest, joints = Body(MODEL).rest(torch.zeros(10))
    faces = MODEL.faces[(rest[:, 0] < joints[19, 0] + 0.02).numpy()[MODEL.faces].all(1)].astype(np.int64)
    turns = torch.stack([torch.zeros(15, 3), hand().rotvecs(angles)])
    skin, side = bent_skin(RIG, rest, turns), int(4 * size)
    normals = vertex_normals(skin, torch.as_tensor(faces)).numpy() @ turn.T
    there = (skin - joints[23]).numpy() @ turn.T + [0, 0, AWAY]
    there[:, 2] = there[:, 2].clip(0.3)
    K = np.array([[size * AWAY / LONG, 0, side / 2], [0, size * AWAY / LONG, side / 2], [0, 0, 1]])
    _, face, shares = fill(there, faces, K, side, side)
    picture = np.kron(rng.normal(140, 30, (8, 8, 3)), np.ones((-(-side // 8), -(-side // 8), 1)))[:side, :side]
    lit = (0.45 + 0.6 * (normals @ LIGHT).clip(0, 1))[faces[face[face >= 0]]]
    picture[face >= 0] = np.array(colour) * (lit * shares[face >= 0]).sum(1, keepdims=True)
    wrist = (joints[21] - joints[23]).numpy() @ turn.T + [0, 0, AWAY]
    dx, dy = -wrist[:2] / wrist[2]
    mask = 255 * (face >= 0).astype(np.uint8)
    return (
        picture.clip(0, 255).astype(np.uint8),
        mask,
        Roi(side / 2, side / 2, WINDOW * size, float(np.arctan2(dx, -dy))),
    )


def looked(
    size: float, count: int, network: HandNetwork, colour: Colour = SKIN, hide: Hide = lambda picture, roi: picture
) -> Looked:
    """What is read of hands `size` px long, which `hide` may hide."""
    rng = np.random.default_rng(0)
    angles, turns = poses(count, rng), [view(rng) for _ in range(count)]
    world, xy, sure = np.zeros((1, count, POINTS, 3)), np.zeros((1, count, POINTS, 2)), np.zeros((1, count), bool)
    for i, turn in enumerate(turns):
        picture, mask, roi = drawn(angles[i], turn, size, rng, colour)
        seen = network.read(hide(picture, roi), roi, False)
        world[0, i], xy[0, i], left = seen.world, seen.xy, hide(mask[..., None].repeat(3, 2), roi)[..., 0]
        shown = share_shown(seen.xy.clip(0, len(mask) - 1), size, left) >= SHOWN
        sure[0, i] = seen.presence >= SURE and seen.side >= SIDE and shown
    bent = bend(hand(), world, xy, np.full((1, count), size / LONG), sure, 5.0 * np.arange(count))
    read, truth = bent.fits[0], hand().points(angles)
    off, still = (
        100 * (hand().points(one) - truth).norm(dim=-1).numpy()[read] for one in (bent.angles[0], hand().rest)
    )
    palm = [np.degrees(Rotation.from_matrix(a @ b.T).magnitude()) for a, b in zip(bent.turns[0], turns, strict=True)]
    return Looked(read, off, still, 100 * bent.error[0][read], np.array(palm)[read])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=float, nargs="+", default=[110, 60, 40, 22])
    parser.add_argument("--hands", type=int, default=90)
    parser.add_argument("--hidden", action="store_true")
    args, network = parser.parse_args(), HandNetwork()
    for size in args.sizes:
        print(f"{size:5.0f} px: {looked(size, args.hands, network)}", flush=True)
        if args.hidden:
            kinds = {kind: looked(size, args.hands, network, colour) for kind, colour in GLOVES.items()}
            kinds |= {kind: looked(size, args.hands, network, hide=hide) for kind, hide in HIDDEN.items()}
            print("\n".join(f"  {kind}: {found}" for kind, found in kinds.items()), flush=True)


if __name__ == "__main__":
    main()
