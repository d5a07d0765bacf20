"""Find a pose in one picture by gradients.

python examples/fit_pose.py work/dance/default found.png

The middle frame of the clip is drawn, its pose is turned by 20 degrees in each big joint, and the true one is found again from the
picture alone: a picture is differentiable in the pose.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial

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
STAGES = ((2, (1, 5), 80), (2, (1,), 120))
"""How much smaller the picture is, px of the blurs in which it is compared, and steps: the blurred leads limbs from afar."""
REACH = np.radians(30)
"""How far a joint may go from the start: a left leg that looks like the right one is not taken for it."""


def fit(
    avatar: hugs.Avatar,
    picture: Tensor,
    behind: Tensor,
    camera: hugs.Camera,
    start: hugs.Pose,
    stages: Sequence[tuple[int, Sequence[int], int]] = STAGES,
) -> np.ndarray:
    """The body pose [23,3] rad of a `picture` [H,W,3] of the person before what is `behind` them [H,W,3], from about `start`."""
    pose, rows = torch.as_tensor(start.body_pose).float().reshape(23, 3), torch.tensor(ROWS)
    free = torch.zeros(len(ROWS), 3, requires_grad=True)  # what is looked for, of any length

    def turned_by() -> Tensor:
        way = free / (1 + free.square().sum(1, keepdim=True)).sqrt()  # shorter than 1
        return pose.index_add(0, rows, REACH * way)

    def apart_from_picture(by: int, blurs: Sequence[int]) -> Tensor:
        person = avatar.pose(turned_by(), start.global_orient, start.transl)
        image, alpha, _ = hugs.draw(person, smaller(camera, by))
        off = image + (1 - alpha)[..., None] * shrunk(behind, by) - shrunk(picture, by)
        seen = [blur * blurred(off, blur).square().mean() for blur in blurs]
        return 1e4 * torch.stack(seen).sum() + 0.02 * free.square().sum()  # what nothing shows stays as it was

    for by, blurs, steps in stages:
        optimizer = torch.optim.LBFGS([free], max_iter=steps, history_size=20, line_search_fn="strong_wolfe")
        loss = partial(apart_from_picture, by, blurs)
        optimizer.step(partial(with_gradient, free, loss))  # type: ignore[no-untyped-call]
    return turned_by().detach().numpy()


def with_gradient(free: Tensor, loss: Callable[[], Tensor]) -> float:
    """The loss, whose gradient is in `free` then."""
    free.grad, value = None, loss()
    value.backward()  # type: ignore[no-untyped-call]
    return float(value.detach())


def smaller(camera: hugs.Camera, by: int) -> hugs.Camera:
    """The camera of a picture that is smaller by so much."""
    K = camera.K / torch.tensor([[by], [by], [1.0]])
    return hugs.Camera(camera.viewmat, K, camera.width // by, camera.height // by)


def shrunk(image: Tensor, by: int) -> Tensor:
    """A picture [H,W,3] that is smaller by so much."""
    return avg_pool2d(image.movedim(-1, 0), by).movedim(0, -1)


def blurred(image: Tensor, size: int) -> Tensor:
    """A picture [H,W,3], twice averaged over squares of `size` px, as [3,H,W]."""
    rows = image.movedim(-1, 0)
    for _ in range(2):
        rows = avg_pool2d(rows, size, 1, size // 2, count_include_pad=False)
    return rows


def drawn(avatar: hugs.Avatar, pose: hugs.Pose, camera: hugs.Camera) -> tuple[Tensor, Tensor]:
    """A picture [H,W,3] of the person before their scene, and of the scene alone."""
    person = avatar.pose(torch.as_tensor(pose.body_pose), pose.global_orient, pose.transl)
    height, width = camera.height, camera.width
    behind = torch.zeros(height, width, 3) if avatar.scene is None else hugs.draw(None, camera, avatar.scene).image
    image, alpha, _ = hugs.draw(person, camera)
    return image + (1 - alpha)[..., None] * behind, behind


def turned(avatar: hugs.Avatar, pose: hugs.Pose, degrees: float) -> hugs.Pose:
    """The pose with each big joint turned by so much about an axis by chance across the limb that it carries."""
    turns = np.array(pose.body_pose).reshape(23, 3)
    below = np.stack([avatar.joints[hugs.JOINT_NAMES.index(NEXT[name])] for name in BIG])
    limbs = below - avatar.joints[np.add(ROWS, 1)]
    axes = np.cross(limbs, np.random.default_rng(0).normal(size=limbs.shape))
    off = Rotation.from_rotvec(np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    turns[ROWS] = (Rotation.from_rotvec(turns[ROWS]) * off).as_rotvec()
    return hugs.Pose(turns.reshape(69), pose.global_orient, pose.transl)


def apart(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Degrees between two poses at each big joint."""
    one, two = (Rotation.from_rotvec(np.reshape(part, (23, 3))[ROWS]) for part in (pose, other))
    degrees: np.ndarray = np.degrees((one.inv() * two).magnitude())
    return degrees


def main(run: str, out: str) -> None:
    """Find the pose of the clip's middle frame and draw it."""
    avatar = hugs.load(run)
    middle = len(avatar.cameras) // 2
    true, camera = avatar.motions["clip"][middle], avatar.cameras[middle]
    start = turned(avatar, true, 20)
    found = fit(avatar, *drawn(avatar, true, camera), camera, start)
    for name, before, after in zip(BIG, apart(start.body_pose, true.body_pose), apart(found, true.body_pose)):
        print(f"{name:15} {before:4.1f} degrees off, then {after:4.1f}")
    hugs.write_image(out, drawn(avatar, hugs.Pose(found, true.global_orient, true.transl), camera)[0])


if __name__ == "__main__":
    main(*sys.argv[1:])
