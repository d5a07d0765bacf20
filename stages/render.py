"""Videos of what was learned: held-out views, the person from all sides, in a new motion, and the empty scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.gaussians import Splats
    from stages.avatar.human import Baked

A_POSE = {2: 0.25, 5: -0.25, 47: -0.9, 50: 0.9}  # entries of body_pose, rad: a relaxed stand for the turntable


class Params(contract.Params):
    fps: int = Field(24, gt=0)
    """Frames a second of the videos."""
    turntable_frames: int = Field(72, gt=0)
    """Views around the person."""
    motion: Literal["jumping_jacks", "wave", "walk_in_place", "squats"] = "jumping_jacks"
    """The motion that is not in the clip."""
    motion_seconds: float = Field(4.0, gt=0)
    """Length of that motion."""


class Learned(NamedTuple):
    """What training left, ready to draw: the person, the scene or None, and the person's poses by frame name."""

    avatar: Baked
    scene: Splats | None
    poses: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, train: Path) -> None:
    """Render heldout.mp4, turntable.mp4, motion.mp4 and, if there is a scene, scene.mp4."""
    import numpy as np

    from stages.formats.clip import load_clip
    from stages.formats.video import write_video

    clip = load_clip(sfm, smpl)
    learned = load_learned(train, job.device)
    held = np.flatnonzero(clip.heldout)
    shots: dict[str, tuple[Iterator[np.ndarray], int, float]] = {
        "heldout": (_side_by_side(clip, learned, held), len(held), 4.0),
        "turntable": (_turntable(learned, params.turntable_frames), params.turntable_frames, params.fps),
    }
    motion = _motion(clip, learned, params)
    shots["motion"] = (motion, round(params.motion_seconds * params.fps), params.fps)
    if learned.scene is not None:
        order = range(0, len(clip.names), max(1, len(clip.names) // 80))
        shots["scene"] = (_empty(clip, learned, order), len(order), params.fps / 2)
    total, done = sum(count for _, count, _ in shots.values()), 0

    def counted(frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        nonlocal done
        for frame in frames:
            yield frame
            done += 1
            job.progress(done, total)

    for name, (frames, _, fps) in shots.items():
        write_video(job.out / f"{name}.mp4", counted(frames), fps)
    job.note(", ".join(f"{name}.mp4" for name in shots))


def load_learned(train: Path, device: str = "cpu") -> Learned:
    """Read the folder of the train stage; the tensors are on `device`."""
    from stages.avatar.human import load_avatar
    from stages.avatar.scene import load_scene
    from stages.formats.poses import read_poses
    from stages.formats.splats import read_avatar, read_scene

    body = read_poses(train / "body.npz")
    rows = zip(body.global_orient, body.body_pose, body.transl, strict=True)
    scene = load_scene(read_scene(train / "scene.npz"), device) if (train / "scene.npz").exists() else None
    return Learned(load_avatar(read_avatar(train / "avatar.npz"), device), scene, dict(zip(body.names, rows)))


def person(learned: Learned, pose: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Splats:
    """The person's Gaussians at one pose (global_orient [3], body_pose [69] rad, transl [3] m)."""
    import torch

    from stages.avatar.human import pose_avatar

    like = learned.avatar.joints
    return pose_avatar(learned.avatar, *(torch.as_tensor(part).to(like) for part in pose))


def draw(
    human: Splats | None,
    scene: Splats | None,
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    background: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W], float32, of one camera (metres, px, width x height)."""
    import torch

    from stages.avatar.compose import compose

    like = (human or scene).means
    view, intrinsics = (torch.as_tensor(m).to(like) for m in (viewmat, K))
    with torch.no_grad():
        drawn = compose(human, scene, view, intrinsics, *size, torch.full((3,), background).to(like))
    return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Colours in 0..1 as bytes, clipped and rounded."""
    import numpy as np

    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _side_by_side(clip, learned: Learned, order) -> Iterator[np.ndarray]:
    import numpy as np

    for i in order:
        drawn, _ = draw(
            person(learned, learned.poses[clip.names[i]]),
            learned.scene,
            clip.viewmats[i],
            clip.Ks[i],
            (clip.width, clip.height),
        )
        yield np.concatenate([clip.images(i), to_uint8(drawn)], 1)


def _empty(clip, learned: Learned, order) -> Iterator[np.ndarray]:
    for i in order:
        yield to_uint8(draw(None, learned.scene, clip.viewmats[i], clip.Ks[i], (clip.width, clip.height))[0])


def _turntable(learned: Learned, count: int, side: int = 640) -> Iterator[np.ndarray]:
    """The person at a relaxed stand, seen from all sides, over white; y is up in the canonical frame."""
    import numpy as np

    pose = np.zeros(69)
    pose[list(A_POSE)] = list(A_POSE.values())
    human = person(learned, (np.zeros(3), pose, np.zeros(3)))
    points = human.means.cpu().numpy()
    low, high = np.percentile(points, 0.2, axis=0), np.percentile(points, 99.8, axis=0)
    middle, tall = (low + high) / 2, max(high - low)
    focal = 2.2 * side
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        cos, sin = np.cos(angle), np.sin(angle)
        rotation = np.array([[-cos, 0, sin], [0, -1, 0], [sin, 0, cos]]) @ np.diag([-1, 1, -1])
        view = np.eye(4)
        view[:3, :3] = rotation
        view[:3, 3] = -rotation @ middle + [0, 0, 2.6 * tall]
        yield to_uint8(draw(human, None, view, K, (side, side), 1.0)[0])


def _motion(clip, learned: Learned, params: Params) -> Iterator[np.ndarray]:
    """The person doing something new where it stood in the clip, seen by the camera of the middle frame."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from stages.avatar import motion

    orient, body_pose, transl = getattr(motion, params.motion)(params.motion_seconds, params.fps)
    middle = len(clip.names) // 2
    stand = upright(np.stack([learned.poses[name][0] for name in clip.names]), learned.poses[clip.names[middle]][0])
    pelvis = learned.avatar.joints[0].cpu().numpy()
    start = pelvis + learned.poses[clip.names[middle]][2]
    for turn, pose, step in zip(orient, body_pose, transl, strict=True):
        turned = (Rotation.from_matrix(stand) * Rotation.from_rotvec(turn)).as_rotvec()
        human = person(learned, (turned, pose, start + stand @ step - pelvis))
        view = (clip.viewmats[middle], clip.Ks[middle], (clip.width, clip.height))
        yield to_uint8(draw(human, learned.scene, *view, 0.0 if learned.scene else 1.0)[0])


def upright(orients: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Rotation [3,3] from the y-up frame of motions to the world: y goes to the mean up of `orients` [F,3] (rotation
    vectors), z to the heading of `facing` [3]."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    up = Rotation.from_rotvec(orients).apply([0.0, 1.0, 0.0]).mean(0)
    up /= np.linalg.norm(up)
    front = Rotation.from_rotvec(facing).apply([0.0, 0.0, 1.0])
    front -= up * (front @ up)
    front /= np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front], 1)


def render_views(
    *,
    train: Path,
    cameras: Path,
    poses: Path | None,
    only: Literal["human", "scene", "both"],
    out: Path,
    device: str = "cpu",
) -> int:
    """Write one PNG with alpha (not multiplied into colour) per camera of `cameras` into `out`; returns how many.

    `cameras` is a cameras.npz in the clip's world (metres); `poses` a body.npz with one pose, or one per camera. Without
    it a camera named as a frame of the clip gets that frame's pose, any other the middle frame's. Raises StageError
    when the counts differ or the scene is asked for and there is none.
    """
    import numpy as np

    from stages.formats.cameras import read_cameras
    from stages.formats.images import write_image
    from stages.formats.poses import read_poses

    path, learned = read_cameras(cameras), load_learned(train, device)
    if learned.scene is None and only != "human":
        raise StageError(
            "this clip has a person only, no scene",
            "add `--only human`",
            [f"no scene.npz in {train}: its camera did not move, or the scene was switched off"],
        )
    middle = list(learned.poses.values())[len(learned.poses) // 2]
    chosen = [learned.poses.get(name, middle) for name in path.names]
    if poses is not None:
        given = read_poses(poses)
        if len(given) not in (1, len(path)):
            raise StageError(
                "poses and cameras do not belong together",
                "give one pose, or one per camera",
                [f"{len(path)} cameras in {cameras}", f"{len(given)} poses in {poses}"],
            )
        rows = list(zip(given.global_orient, given.body_pose, given.transl, strict=True))
        chosen = rows * len(path) if len(rows) == 1 else rows
    out.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(path.names):
        human = person(learned, chosen[i]) if only != "scene" else None
        scene = learned.scene if only != "human" else None
        image, alpha = draw(human, scene, path.viewmats[i], path.Ks[i], (path.width, path.height))
        colour = image / np.maximum(alpha, 1 / 255)[..., None]
        write_image(out / f"{name}.png", to_uint8(np.concatenate([colour, alpha[..., None]], 2)))
    return len(path)
