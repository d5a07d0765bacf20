"""Videos of what was learned: held-out views, the person from all sides, in a new motion, and the empty scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.drawing.draw import Learned, Pose
    from stages.formats.clip import Clip

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


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, train: Path) -> None:
    """Render turntable.mp4, motion.mp4, heldout.mp4 if a frame is held out, and scene.mp4 if there is a scene."""
    import numpy as np

    from stages.formats.clip import load_clip
    from stages.formats.video import write_video

    clip = load_clip(sfm, smpl, train)
    learned, poses = read_trained(train, job.device)
    fps = float(params.fps)
    shots: dict[str, tuple[Iterator[np.ndarray], float]] = {
        "turntable": (_turntable(learned, params.turntable_frames), fps),
        "motion": (_motion(clip, learned, poses, params), fps),
    }
    held = [int(i) for i in np.flatnonzero(clip.heldout) if learned.scene is not None or clip.shows_person(i)]
    if held:
        shots["heldout"] = (_beside_truth(clip, learned, held), 4.0)
    if learned.scene is not None:
        shots["scene"] = (_empty(clip, learned), fps / 2)
    for done, (name, (pictures, rate)) in enumerate(shots.items()):
        job.progress(done, len(shots))
        write_video(job.out / f"{name}.mp4", pictures, rate)
    job.note(", ".join(f"{name}.mp4" for name in shots))


def read_trained(train: Path, device: str) -> tuple[Learned, dict[str, Pose]]:
    """What training left, and the person's poses by frame name."""
    from stages.avatar.drawing.draw import load_learned
    from stages.formats.effects import read_effects
    from stages.formats.poses import read_poses
    from stages.formats.splats import read_avatar, read_scene

    scene = read_scene(train / "scene.npz") if (train / "scene.npz").exists() else None
    body = read_poses(train / "body.npz")
    poses = dict(zip(body.names, zip(body.global_orient, body.body_pose, body.transl, strict=True), strict=True))
    return load_learned(read_avatar(train / "avatar.npz"), scene, read_effects(train / "effects.npz"), device), poses


def check_scene(learned: Learned, train: Path) -> None:
    """StageError where only the person was trained."""
    if learned.scene is None:
        raise StageError(
            "this clip has a person only, no scene",
            "add `--only human`",
            [f"no scene.npz in {train}: the camera did not move, or the scene was switched off"],
        )


def _beside_truth(clip: Clip, learned: Learned, order: list[int]) -> Iterator[np.ndarray]:
    """The clip on the left, ours on the right as the same camera takes it, its shutter included.

    Over white without a scene, without the person where there is none.
    """
    import numpy as np

    from stages.avatar.drawing.draw import draw, motion_at, pose_of, to_uint8
    from stages.avatar.rasterize import Camera

    for i in order:
        pose = pose_of(clip.body, i) if clip.shows_person(i) else None
        human = None if pose is None else learned.person(pose)
        scene = learned.shade(learned.scene, pose)
        motion = motion_at(learned, clip.world_cameras, clip.split.moments, clip.body, i, human is not None)
        camera = Camera.of(clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
        drawn, _ = draw(human, scene, camera, 0.0 if learned.scene else 1.0, learned.effects, motion)
        yield np.concatenate([clip.images(i), to_uint8(drawn)], 1)


def _empty(clip: Clip, learned: Learned) -> Iterator[np.ndarray]:
    from stages.avatar.drawing.draw import draw, to_uint8
    from stages.avatar.rasterize import Camera

    for viewmat, K in zip(clip.viewmats, clip.Ks, strict=True):
        yield to_uint8(draw(None, learned.scene, Camera.of(viewmat, K, clip.width, clip.height))[0])


def _turntable(learned: Learned, count: int, side: int = 640) -> Iterator[np.ndarray]:
    """The person at a relaxed stand, seen from all sides over white; the canonical frame has y up and looks along z."""
    import numpy as np

    from stages.avatar.drawing.draw import draw, to_uint8
    from stages.avatar.rasterize import Camera

    stand = np.zeros(69)
    stand[list(A_POSE)] = list(A_POSE.values())
    human = learned.person((np.zeros(3), stand, np.zeros(3)))
    points = human.means.cpu().numpy()
    low, high = np.percentile(points, 1, axis=0), np.percentile(points, 99, axis=0)
    focal, away = 2.2 * side, 2.7 * max(high - low)
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        cos, sin = np.cos(angle), np.sin(angle)
        view = np.eye(4)
        view[:3, :3] = np.diag([1.0, -1, -1]) @ [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        view[:3, 3] = [0, 0, away] - view[:3, :3] @ ((low + high) / 2)
        yield to_uint8(draw(human, None, Camera.of(view, K, side, side), 1.0)[0])


def _motion(clip: Clip, learned: Learned, poses: dict[str, Pose], params: Params) -> Iterator[np.ndarray]:
    """The person doing something new where it stood in the clip, seen by the camera of the middle frame."""
    import numpy as np

    from stages.avatar.drawing.draw import perform
    from stages.avatar.motion import formulas as motion
    from stages.avatar.rasterize import Camera

    moves = tuple(t.numpy() for t in motion.MOTIONS[params.motion](params.motion_seconds, params.fps))
    middle = len(clip.names) // 2
    orient, _, transl = poses[clip.names[middle]]
    stand = motion.upright(np.stack([poses[name][0] for name in clip.names]), orient)
    camera = Camera.of(clip.viewmats[middle], clip.Ks[middle], clip.width, clip.height)
    yield from perform(learned, learned.scene, moves, stand, transl, [camera] * len(moves[0]))


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

    `cameras` is a cameras.npz in the clip's world (metres); `poses` a body.npz with one pose or one per camera.
    Without it a camera named as a frame of the clip gets that frame's pose, any other the middle frame's.
    Raises StageError when the counts differ, or when the scene is asked for and there is none.
    """
    import numpy as np

    from stages.avatar.drawing.draw import draw, to_uint8
    from stages.avatar.rasterize import Camera
    from stages.formats.cameras import read_cameras
    from stages.formats.images import write_image
    from stages.formats.poses import read_poses

    path = read_cameras(cameras)
    learned, known = read_trained(train, device)
    if only != "human":
        check_scene(learned, train)
    middle = list(known.values())[len(known) // 2]
    chosen = [known.get(name, middle) for name in path.names]
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
        human = learned.person(chosen[i]) if only != "scene" else None
        scene = learned.shade(learned.scene, None if human is None else chosen[i]) if only != "human" else None
        image, alpha = draw(human, scene, Camera.of(path.viewmats[i], path.Ks[i], path.width, path.height))
        colour = image / np.maximum(alpha, 1 / 255)[..., None]
        write_image(out / f"{name}.png", to_uint8(np.concatenate([colour, alpha[..., None]], 2)))
    return len(path)
