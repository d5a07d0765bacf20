"""A video of the person in a motion that the user gives. No pipeline names it; `hugs animate` runs it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.motion.placing import Placed, Soles
    from stages.avatar.motion.retarget import Performance
    from stages.avatar.rasterize import Camera
    from stages.formats.clip import Clip

DEFAULT_FPS = 30.0  # of a motion file that does not say


class Params(contract.Params):
    fps: float = Field(30, gt=0)
    """Frames a second of the video."""
    motion_fps: float | None = None
    """Frames a second of the motion, in place of what its file says."""
    up: Literal["y", "-y", "z", "-z"] | None = None
    """The axis that points up in the motion, in place of the direction in which its pelvis points."""
    only: Literal["human", "both"] = "both"
    """human: over white; both: in the scene."""


def run(
    job: Job, params: Params, *, motion: Path, train: Path, sfm: Path, smpl: Path, cameras: Path | None = None
) -> None:
    """Write the video `job.out` of the person performing `motion` (.bvh or .npz) where they stood in the clip.

    Seen by the camera of the clip's middle frame, or by `cameras` (npz) in the clip's world, one or one a frame. Only
    skinning poses the person, no network runs. StageError for files that cannot be used.
    """
    from stages.avatar.drawing.draw import load_learned, perform
    from stages.avatar.motion.placing import Soles
    from stages.formats.clip import load_clip
    from stages.formats.trained import check_scene, read_trained
    from stages.formats.video import write_video

    clip = load_clip(sfm, smpl, train)
    learned = load_learned(*read_trained(train), job.device)
    if params.only != "human":
        check_scene(train)
    soles = Soles(clip.body_model, clip.body.betas)
    placed = _placed(job, params, motion, soles, clip.body_model.parents)
    count = len(placed.transl)
    views = _views(clip, cameras, count)
    stand, spot = _spot(clip, soles)
    pelvis = soles.joints[0]  # about which global_orient turns
    moves = (placed.global_orient, placed.body_pose, placed.transl + pelvis)
    scene = None if params.only == "human" else learned.scene
    pictures = perform(learned, scene, moves, stand, spot - pelvis, views)
    job.out.parent.mkdir(parents=True, exist_ok=True)
    write_video(job.out, _counted(job, pictures, count), params.fps)


def _placed(job: Job, params: Params, motion: Path, soles: Soles, parents: np.ndarray) -> Placed:
    """The motion at the video's frame rate, retargeted to the body of `soles`, upright on a floor."""
    from stages.avatar.motion import placing, retarget

    performance, rate, facts = _read(motion, params.motion_fps, soles, parents)
    up = params.up or placing.which_is_up(performance)
    if up is None:
        pelvis = ", ".join(f"{x:.2f}" for x in performance.rotations[:, 0, :, 1].mean(0))
        found = [f"the pelvis points along ({pelvis}) on average"]
        raise StageError(f"cannot tell which way is up in {motion}", "say it with `--up`: y, -y, z or -z", found)
    performance = retarget.resample(placing.face_ahead(performance, up), rate, params.fps)
    placed = placing.on_floor(performance, params.fps, soles)
    facts.append(f"{up} is up")
    if placed.drift > 0.05:
        facts.append(f"its floor rose and fell by {placed.drift:.2f} m, which is taken out")
    job.note(f"{motion.name}  {'; '.join(facts)}", at_once=True)
    return placed


def _read(path: Path, fps: float | None, soles: Soles, parents: np.ndarray) -> tuple[Performance, float, list[str]]:
    """The motion for SMPL's joints, its frames a second (`fps`, if given), and facts about the file in words."""
    from stages.avatar.motion import retarget
    from stages.formats.motions import bvh, bvh_names
    from stages.formats.motions.smpl_npz import read_smpl_motion

    own_fps: float | None
    if path.suffix.lower() == ".bvh":
        found = bvh.read_bvh(path)
        body = bvh_names.map_body(found, path)
        skeleton = retarget.Skeleton(found.names, found.parents, found.places, found.rotations)
        chains = (body.limbs, body.pelvis, body.spine, body.neck)
        try:
            performance = retarget.from_skeleton(skeleton, *chains, soles.joints, parents.tolist())
        except ValueError as error:
            raise StageError(f"{path} has bones without length", bvh.HINT, [str(error)]) from error
        notes = [f"{body.used} of {body.used + len(body.unused)} joints used"]
        length, own_fps = len(found), found.fps
    elif path.suffix.lower() == ".npz":
        smpl = read_smpl_motion(path)
        performance, notes = retarget.from_smpl(smpl.rotvecs, smpl.transl, soles.joints), list(smpl.notes)
        length, own_fps = len(smpl), smpl.fps
    else:
        raise StageError(
            f"{path} is no motion", "give a .bvh, or an .npz of SMPL poses", [f"it ends in {path.suffix!r}"]
        )
    rate = fps or own_fps
    if rate is None:
        rate = DEFAULT_FPS
        notes.append(f"how fast is not said: {rate:g} frames a second taken (`--motion-fps`)")
    return performance, rate, [f"{length} frames, {(length - 1) / rate:.1f} s at {rate:.4g} fps", *notes]


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
    """Where the person stood in the middle frame: rotation [3,3] from a motion's frame, and the point [3] on the floor, m."""
    import numpy as np

    from stages.avatar.motion.formulas import upright

    body, middle, present = clip.body, len(clip.names) // 2, clip.body.confidence > 0
    stand = upright(body.global_orient[present], body.global_orient[middle])
    points, joints = soles.at(body.global_orient, body.body_pose, body.transl)
    up = stand[:, 1]
    floor = np.median((points @ up).min(1)[present])  # a jump in the middle frame does not raise it
    return stand, joints[middle, 0] + up * (floor - up @ joints[middle, 0])


def _counted(job: Job, pictures: Iterator[np.ndarray], count: int) -> Iterator[np.ndarray]:
    for done, picture in enumerate(pictures, start=1):
        yield picture
        job.progress(done, count)
