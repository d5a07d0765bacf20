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
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where an avatar of a file stands: its soles, m, in the axes of the scene."""


def run(
    job: Job,
    params: Params,
    *,
    motion: Path,
    train: Path | None = None,
    sfm: Path | None = None,
    smpl: Path | None = None,
    avatar: Path | None = None,
    scene: Path | None = None,
    cameras: Path | None = None,
) -> None:
    """Write the video `job.out` of the person performing `motion` (.bvh or .npz), by skinning alone.

    Either of a clip (`train`, `sfm` and `smpl`): on its floor where they stood, seen by the camera of its middle frame. Or of
    the file `avatar`: at `params.at` of the `scene`, whose y is down, or without one at the origin of a world whose y is up,
    with the floor at 0, seen from before them. `scene` is a file in place of a clip's trained scene; `cameras` (npz) in
    the same world are one or one a frame. StageError for files that cannot be used.
    """
    import numpy as np

    from stages.avatar.drawing.draw import load_learned, perform
    from stages.avatar.drawing.rig import rig_of
    from stages.avatar.motion.placing import Soles, put
    from stages.avatar.rasterize import Camera
    from stages.avatar.splats.turn import OVER
    from stages.formats.clip import load_clip
    from stages.formats.exchange.read import lacks, read_given
    from stages.formats.ground import read_ground
    from stages.formats.trained import check_scene
    from stages.formats.video import write_video

    given = read_given(train, avatar, scene)
    for fact in lacks(avatar, scene):
        job.note(fact, at_once=True)
    learned = load_learned(*given, job.device)
    soles = Soles.of_rig(rig_of(given[0]))
    if train is None or sfm is None or smpl is None:
        stand, spot = np.eye(3) if scene is None else OVER, np.array(params.at)
        view = None
    else:
        if params.only != "human" and scene is None:
            check_scene(train)
        clip = load_clip(sfm, smpl, train)
        ground = read_ground(smpl / "ground.json")
        stand, spot = ground.turn, ground.point
        middle = len(clip.names) // 2
        view = Camera.of(clip.viewmats[middle], clip.Ks[middle], clip.width, clip.height)
    placed = _placed(job, params, motion, soles, given[0].parents)
    count = len(placed.transl)
    views = _views(cameras, count) or [view or _before(placed, soles, stand, spot)] * count
    poses = put(placed, stand, spot, soles.joints[0])
    pictures = perform(learned, None if params.only == "human" else learned.scene, poses, views, params.fps)
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


def _views(cameras: Path | None, count: int) -> list[Camera]:
    """The user's camera for each of `count` pictures; none where they gave none."""
    from stages.avatar.rasterize import Camera
    from stages.formats.cameras import read_cameras

    if cameras is None:
        return []
    path = read_cameras(cameras)
    if len(path) not in (1, count):
        facts = [f"{len(path)} cameras in {cameras}", f"{count} pictures of the motion"]
        raise StageError("cameras and motion do not belong together", "give one camera, or one per picture", facts)
    views = [Camera.of(*view, path.width, path.height) for view in zip(path.viewmats, path.Ks, strict=True)]
    return views * count if len(views) == 1 else views


def _before(placed: Placed, soles: Soles, stand: np.ndarray, spot: np.ndarray) -> Camera:
    """A camera before the person that sees them throughout the motion."""
    import numpy as np

    from stages.avatar.drawing.turntable import before
    from stages.avatar.rasterize import Camera

    _, joints = soles.at(placed.global_orient, placed.body_pose, placed.transl)
    crown = joints[:, 15] + [0, 0.25, 0]
    seen = before(np.concatenate([joints.reshape(-1, 3), crown]))
    into = np.eye(4)
    into[:3, :3], into[:3, 3] = stand, spot
    return Camera.of(seen.viewmat.numpy() @ np.linalg.inv(into), seen.K.numpy(), seen.width, seen.height)


def _counted(job: Job, pictures: Iterator[np.ndarray], count: int) -> Iterator[np.ndarray]:
    for done, picture in enumerate(pictures, start=1):
        yield picture
        job.progress(done, count)
