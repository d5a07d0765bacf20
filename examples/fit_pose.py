"""Find a pose in one picture by gradients.

python examples/fit_pose.py work/dance/default found.png

The middle frame of the clip is drawn, its pose is turned by 20 degrees in each big joint, and the true one is found again from the
picture alone: a picture is differentiable in the pose. Gradients go down to the nearest minimum, from a coarse picture to a fine
one; so that a limb is not left in a wrong one, each is also tried from elsewhere.
"""

import sys
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import avg_pool2d

import hugs

CHAINS = [
    [f"{side}_{joint}" for joint in limb]
    for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
    for side in ("left", "right")
]
NEXT = {joint: below for chain in CHAINS for joint, below in zip(chain, chain[1:])}
BIG = list(NEXT)
ROWS = [hugs.JOINT_NAMES.index(name) - 1 for name in BIG]  # their rows in body_pose [23,3]
LIMBS = torch.arange(3 * len(BIG)).reshape(len(CHAINS), -1)  # which of the numbers that are looked for turn a limb
COARSE = ((4, 0.02, 10), (3, 0.01, 10))
TRIED = (2, 0.005, 6)
FINE = ((2, 0.005, 10), (1, 0.005, 10), (1, 0.003, 20), (1, 0.003, 20))
"""How often the picture is halved, how strongly the start is held, and steps: a coarse picture leads limbs from afar."""
MISS = 0.1
"""A colour that is off by more than this counts little more: shadows that no avatar has are in real pictures."""
REACH = np.radians(30)
"""How far a joint may go from the start: a left leg that looks like the right one is not taken for it."""

Misses = Callable[[Tensor, int, float], Tensor]


def fit(
    avatar: hugs.Avatar, picture: Tensor, behind: Tensor, camera: hugs.Camera, start: hugs.Pose, tries: int = 64
) -> np.ndarray:
    """The body pose [23,3] rad of a `picture` [H,W,3] of the person before what is `behind` them [H,W,3], from about `start`.

    Each limb is tried from `tries` other places. The pictures are as large as the camera's: one drawn smaller is not the same
    picture made smaller, and its best pose is another one.
    """
    pose, rows = torch.as_tensor(start.body_pose).float().reshape(23, 3), torch.tensor(ROWS)
    near, part = around(avatar.pose(pose, start.global_orient, start.transl), camera)
    picture, behind = picture[part], behind[part]

    def turned_by(free: Tensor) -> Tensor:  # free [P,24], of any length
        turns = free.reshape(-1, len(ROWS), 3)
        turns = REACH * turns / (1 + turns.square().sum(2, keepdim=True)).sqrt()
        return pose.repeat(len(free), 1, 1).index_add(1, rows, turns)

    def misses(free: Tensor, halvings: int, hold: float) -> Tensor:  # [P,M]
        person = avatar.pose(turned_by(free), start.global_orient, start.transl)
        image, alpha, _ = hugs.draw(person, near, light=avatar.light)
        seen = torch.cat(halved((image + (1 - alpha)[..., None] * behind - picture).movedim(-1, 1), halvings), 1)
        seen = seen * (1 + (seen / MISS).square()).rsqrt()
        return torch.cat([seen, hold * REACH * picture.numel() ** 0.5 * free], 1)  # what nothing shows stays as it was

    free = torch.zeros(LIMBS.numel())
    for stage in COARSE:
        free = lower(misses, free, LIMBS.flatten(), *stage)
    rng = torch.Generator().manual_seed(0)
    for limb in LIMBS:
        free = tried(misses, free, limb, 0.5 * torch.randn(tries, len(limb), generator=rng))
    for stage in FINE:
        free = lower(misses, free, LIMBS.flatten(), *stage)
    return turned_by(free[None])[0].numpy()


def tried(misses: Misses, free: Tensor, limb: Tensor, others: Tensor) -> Tensor:
    """`free` [24] with the best of a limb: from where it is, and from the best four of the `others`, a few steps each."""
    places = free.repeat(len(others), 1).index_copy(1, limb, others)
    with torch.no_grad():
        good = misses(places, *TRIED[:2]).square().sum(1).argsort()[:4]
        ends = torch.stack([lower(misses, place, limb, *TRIED) for place in (free, *places[good])])
        return ends[misses(ends, *TRIED[:2]).square().sum(1).argmin()]


@torch.enable_grad()
def lower(misses: Misses, free: Tensor, which: Tensor, halvings: int, hold: float, steps: int) -> Tensor:
    """`free` [24] after some steps of L-BFGS on `which` of its numbers, along axes in which the squared misses curve alike.

    The curvature is that of Gauss-Newton, by finite differences; the gradients come through the picture.
    """
    nudge, count = 0.003, len(which)
    with torch.no_grad():
        here = misses(free[None], halvings, hold)[0]
        slopes = (
            misses(free.repeat(count, 1).index_add(1, which, nudge * torch.eye(count)), halvings, hold) - here
        ) / nudge
    curves = (slopes @ slopes.T).double()
    curves += torch.diag(1e-3 * curves.diagonal() + 1e-6 * curves.trace())
    axes = here.norm() * torch.linalg.inv(torch.linalg.cholesky(curves)).T.float()
    along = torch.zeros(count, requires_grad=True)
    optimizer = torch.optim.LBFGS([along], max_iter=steps, history_size=20, line_search_fn="strong_wolfe")

    def loss() -> float:
        optimizer.zero_grad()
        now = free.index_add(0, which, axes @ along)
        value = misses(now[None], halvings, hold).square().sum() / here.square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return float(value.detach())

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    return free.index_add(0, which, axes @ along.detach())


def halved(images: Tensor, times: int) -> list[Tensor]:
    """Pictures [P,3,H,W] halved so often, and once less often, each smoothed and weighed as whole ones, as [P,M]."""
    seen = []
    for number in range(times + 1):
        if number >= times - 1:
            smooth = avg_pool2d(images, 3, 1, 1, count_include_pad=False) if number else images
            seen.append(2**number * smooth.flatten(1))
        images = avg_pool2d(images, 2, ceil_mode=True, count_include_pad=False)
    return seen


def around(person: hugs.Person[Tensor], camera: hugs.Camera) -> tuple[hugs.Camera, tuple[slice, slice]]:
    """The part of a camera's picture in which the person may be, as a camera and as rows and columns."""
    seen = (person.means @ camera.viewmat[:3, :3].T.float() + camera.viewmat[:3, 3].float()) @ camera.K.T.float()
    places = (seen[:, :2] / seen[:, 2:]).detach()
    low, high = places.amin(0), places.amax(0)
    margin = 0.12 * float((high - low).max())
    left, top = (int(max(0.0, float(side) - margin)) for side in low)
    right, bottom = (int(min(size, float(side) + margin)) for size, side in zip((camera.width, camera.height), high))
    K = camera.K - torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0]])
    return hugs.Camera(camera.viewmat, K, right - left, bottom - top), (slice(top, bottom), slice(left, right))


def drawn(avatar: hugs.Avatar, pose: hugs.Pose, camera: hugs.Camera) -> tuple[Tensor, Tensor]:
    """A picture [H,W,3] of the person in the clip's light before their scene, and of the scene alone."""
    person = avatar.pose(torch.as_tensor(pose.body_pose), pose.global_orient, pose.transl)
    height, width = camera.height, camera.width
    behind = torch.zeros(height, width, 3) if avatar.scene is None else hugs.draw(None, camera, avatar.scene).image
    image, alpha, _ = hugs.draw(person, camera, light=avatar.light)
    return image + (1 - alpha)[..., None] * behind, behind


def turned(avatar: hugs.Avatar, pose: hugs.Pose, degrees: float, seed: int = 0) -> hugs.Pose:
    """The pose with each big joint turned by so much about an axis by chance across the limb that it carries."""
    turns = np.array(pose.body_pose).reshape(23, 3)
    below = np.stack([avatar.joints[hugs.JOINT_NAMES.index(NEXT[name])] for name in BIG])
    limbs = below - avatar.joints[np.add(ROWS, 1)]
    axes = np.cross(limbs, np.random.default_rng(seed).normal(size=limbs.shape))
    off = Rotation.from_rotvec(np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    turns[ROWS] = (Rotation.from_rotvec(turns[ROWS]) * off).as_rotvec()
    return hugs.Pose(turns.reshape(69), pose.global_orient, pose.transl)


def apart(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Degrees between two poses at each big joint."""
    one, two = (Rotation.from_rotvec(np.reshape(part, (23, 3))[ROWS]) for part in (pose, other))
    degrees: np.ndarray = np.degrees((one.inv() * two).magnitude())
    return degrees


def main(run: str, out: str) -> None:
    """Find the pose of the clip's middle frame; draw the start and what is found beside each other."""
    avatar = hugs.load(run)
    middle = len(avatar.cameras) // 2
    true, camera = avatar.motions["clip"][middle], avatar.cameras[middle]
    start = turned(avatar, true, 20)
    found = fit(avatar, *drawn(avatar, true, camera), camera, start)
    for name, before, after in zip(BIG, apart(start.body_pose, true.body_pose), apart(found, true.body_pose)):
        print(f"{name:15} {before:4.1f} degrees off, then {after:4.1f}")
    poses = start, hugs.Pose(found, true.global_orient, true.transl)
    hugs.write_image(out, torch.cat([drawn(avatar, pose, camera)[0] for pose in poses], 1))


if __name__ == "__main__":
    main(*sys.argv[1:])
