"""The trained person performs a motion file where it stood in the clip: files to pictures, skinning alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stages.contract import StageError

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.motion.placing import Placed, Soles
    from stages.avatar.motion.retarget import Performance
    from stages.avatar.rasterize import Camera
    from stages.formats.clip import Clip

UNSAID_FPS = 30.0  # of a motion file that does not say


@dataclass(frozen=True)
class Motion:
    """A motion file, and what the user says of it; `fps` and `up` (y, -y, z, -z) replace what it says or shows."""

    path: Path
    fps: float | None = None
    up: str | None = None


def animate(
    motion: Motion,
    *,
    train: Path,
    sfm: Path,
    smpl: Path,
    cameras: Path | None,
    only: Literal["human", "both"],
    out: Path,
    fps: float,
    device: str,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> int:
    """Write a video `out` of the person performing `motion`, from the folders of three stages; returns its frames.

    Seen by the camera of the clip's middle frame, or by `cameras` in the clip's world, one or one a frame. `say` gets
    a line for each fact about the motion, `progress` frames done and all. StageError for files that cannot be used.
    """
    from stages.avatar.drawing.draw import perform
    from stages.avatar.motion.placing import Soles
    from stages.formats.clip import load_clip
    from stages.formats.video import write_video
    from stages.render import check_scene, read_trained

    clip = load_clip(sfm, smpl, train)
    learned, _ = read_trained(train, device)
    if only != "human":
        check_scene(learned, train)
    soles = Soles(clip.body_model, clip.body.betas)
    placed = _placed(motion, fps, soles, clip.body_model.parents, say)
    count = len(placed.transl)
    views = _views(clip, cameras, count)
    stand, spot = _spot(clip, soles)
    pelvis = soles.joints[0]  # about which global_orient turns
    moves = (placed.global_orient, placed.body_pose, placed.transl + pelvis)
    pictures = perform(learned, None if only == "human" else learned.scene, moves, stand, spot - pelvis, views)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_video(out, _counted(pictures, count, progress), fps)
    return count


def _placed(motion: Motion, fps: float, soles: Soles, parents: np.ndarray, say: Callable[[str], None]) -> Placed:
    """The motion at `fps`, made for the body of `soles`, upright on a floor."""
    from stages.avatar.motion import placing, retarget

    performance, rate, facts = _read(motion, soles, parents)
    up = motion.up or placing.which_is_up(performance)
    if up is None:
        pelvis = ", ".join(f"{x:.2f}" for x in performance.rotations[:, 0, :, 1].mean(0))
        found = [f"the pelvis points along ({pelvis}) on average"]
        raise StageError(f"cannot tell which way is up in {motion.path}", "say it with `--up`: y, -y, z or -z", found)
    performance = retarget.resample(placing.face_ahead(performance, up), rate, fps)
    placed = placing.on_floor(performance, fps, soles)
    facts.append(f"{up} is up")
    if placed.drift > 0.05:
        facts.append(f"its floor rose and fell by {placed.drift:.2f} m, which is taken out")
    say(f"{motion.path.name}  {'; '.join(facts)}")
    return placed


def _read(motion: Motion, soles: Soles, parents: np.ndarray) -> tuple[Performance, float, list[str]]:
    """What the file has SMPL's joints do, its frames a second, and what there is to say about it."""
    from stages.avatar.motion import retarget
    from stages.formats.motions import bvh, bvh_names
    from stages.formats.motions.smpl_npz import read_smpl_motion

    path = motion.path
    if path.suffix.lower() == ".bvh":
        found = bvh.read_bvh(path)
        body = bvh_names.map_body(found, path)
        skeleton = retarget.Skeleton(found.names, found.parents, found.places, found.rotations)
        chains = (body.limbs, body.pelvis, body.spine, body.neck)
        try:
            performance = retarget.from_skeleton(skeleton, *chains, soles.joints, parents)
        except ValueError as error:
            raise StageError(f"{path} has bones without length", bvh.HINT, [str(error)]) from error
        notes = [f"{body.used} of {body.used + len(body.unused)} joints used"]
    elif path.suffix.lower() == ".npz":
        found = read_smpl_motion(path)
        performance, notes = retarget.from_smpl(found.rotvecs, found.transl, soles.joints), list(found.notes)
    else:
        raise StageError(
            f"{path} is no motion", "give a .bvh, or an .npz of SMPL poses", [f"it ends in {path.suffix!r}"]
        )
    rate = motion.fps or found.fps
    if rate is None:
        rate = UNSAID_FPS
        notes.append(f"how fast is not said: {rate:g} frames a second taken (`--motion-fps`)")
    return performance, rate, [f"{len(found)} frames, {(len(found) - 1) / rate:.1f} s at {rate:.4g} fps", *notes]


def _views(clip: Clip, cameras: Path | None, count: int) -> list[Camera]:
    """A camera for each of `count` pictures."""
    from stages.avatar.rasterize import Camera
    from stages.formats.cameras import read_cameras

    if cameras is None:
        middle = len(clip.names) // 2
        return [Camera.of(clip.viewmats[middle], clip.Ks[middle], clip.width, clip.height)] * count
    path = read_cameras(cameras)
    if len(path) not in (1, count):
        facts = [f"{len(path)} cameras in {cameras}", f"{count} pictures of the motion"]
        raise StageError("cameras and motion do not belong together", "give one camera, or one per picture", facts)
    views = [Camera.of(*view, path.width, path.height) for view in zip(path.viewmats, path.Ks, strict=True)]
    return views * count if len(views) == 1 else views


def _spot(clip: Clip, soles: Soles) -> tuple[np.ndarray, np.ndarray]:
    """Where the person of the middle frame stood: rotation from the frame of motions [3,3], point on the floor [3] m."""
    import numpy as np

    from stages.avatar.motion.formulas import upright

    body, middle, present = clip.body, len(clip.names) // 2, clip.body.confidence > 0
    stand = upright(body.global_orient[present], body.global_orient[middle])
    points, joints = soles.at(body.global_orient, body.body_pose, body.transl)
    up = stand[:, 1]
    floor = np.median((points @ up).min(1)[present])  # a jump in the middle frame does not raise it
    return stand, joints[middle, 0] + up * (floor - up @ joints[middle, 0])


def _counted(pictures: Iterator[np.ndarray], count: int, progress: Callable[[int, int], None]) -> Iterator[np.ndarray]:
    for done, picture in enumerate(pictures, start=1):
        yield picture
        progress(done, count)
