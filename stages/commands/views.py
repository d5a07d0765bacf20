"""Pictures of the result for cameras and poses that the user gives. No pipeline names it; `hugs render` runs it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.filming.spec import Axes

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.drawing.cast import Cast
    from stages.avatar.rasterize import Camera

    Pose = tuple[np.ndarray, np.ndarray, np.ndarray]
    """global_orient [3] and body_pose [69] in rad, transl [3] in m."""


class Params(contract.Params):
    only: Literal["human", "scene", "both"] = "both"
    """What to show."""
    who: int = Field(1, ge=1)
    """Which of the people of a run."""
    scene_axes: Axes = "y_down"
    """Of a scene from a file; y_up: turned by half a turn about x."""
    turntable: int = Field(24, gt=0)
    """Pictures around an avatar for which no cameras are given."""


def run(
    job: Job,
    params: Params,
    *,
    train: Path | None = None,
    smpl: Path | None = None,
    avatar: Path | None = None,
    scene: Path | None = None,
    cameras: Path | None = None,
    poses: Path | None = None,
) -> None:
    """Write one PNG with alpha (not multiplied into color) for each camera.

    Of what training left in `train`, on the body of `smpl`, or of the file `avatar` alone (y up, standing at the origin,
    facing z); `scene` is a file in place of the trained scene. `cameras` is a cameras.npz in the clip's world (metres), with
    `avatar` in the avatar's or the scene's; without it the avatar is seen from all sides. `poses` is a body.npz with one pose
    or one per camera. Without it a camera named as a frame of the clip gets that frame's pose, any other the middle frame's,
    and an avatar stands relaxed. Raises StageError when the counts differ, or when the scene is asked for and there is none.
    """
    import numpy as np

    from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
    from stages.avatar.drawing.cast import Cast
    from stages.avatar.drawing.turntable import around, standing
    from stages.avatar.effects.frames import load_effects
    from stages.avatar.model.scene import load_scene
    from stages.filming.clip_cast import completed
    from stages.filming.scenes import stood
    from stages.formats.body_model import read_body_model
    from stages.formats.exchange.read import lacks, read_given
    from stages.formats.ground import read_ground
    from stages.formats.people import model_of
    from stages.formats.trained import check_scene

    only = params.only
    given, room, effects = read_given(train, avatar, scene, params.who)
    if room is not None and scene is not None:
        room = stood(room, params.scene_axes, None if smpl is None else read_ground(smpl / "ground.json"))
    model = None if smpl is None else read_body_model(model_of(smpl, params.who))
    baked = load_avatar(completed(given, model), job.device)
    for fact in lacks(avatar, scene, room is not None and room.antialias):
        job.note(fact)
    for fact in room.said if room else ():
        job.warn(fact)
    if only != "human" and train is not None and scene is None:
        check_scene(train)
    if cameras is None:
        seen = around(PosedAvatar.of(baked, *standing()).splats(0).means.cpu().numpy(), params.turntable)
        views = {f"{i:03d}": view for i, view in enumerate(seen)}
    else:
        views = _views(cameras)
    chosen = _usual(list(views), train, params.who) if poses is None else _one_each(poses, len(views), cameras)
    people = [] if only == "scene" else [PosedAvatar.of(baked, *(np.stack(part) for part in zip(*chosen, strict=True)))]
    behind = None if room is None or only == "human" else load_scene(room, job.device)
    cast = Cast(people, behind, load_effects(effects).to(job.device))
    _draw(job, cast, views)
    job.note(f"{len(views)} picture{'' if len(views) == 1 else 's'} of {only}")


def _draw(job: Job, cast: Cast, views: dict[str, Camera]) -> None:
    """Write a picture of each view, with alpha."""
    from stages.avatar.drawing.pixels import cut_out
    from stages.formats.images import write_image

    job.out.mkdir(parents=True, exist_ok=True)
    for number, (name, view) in enumerate(views.items()):
        with job.writes(job.out / f"{name}.png") as picture:
            write_image(picture, cut_out(*cast.at(number).picture(view)))


def _views(cameras: Path) -> dict[str, Camera]:
    """The cameras of a file by name."""
    from stages.avatar.rasterize import Camera
    from stages.formats.cameras import read_cameras

    path = read_cameras(cameras)
    each = zip(path.names, path.viewmats, path.Ks, strict=True)
    return {name: Camera.of(viewmat, K, path.width, path.height) for name, viewmat, K in each}


def _usual(names: list[str], train: Path | None, who: int) -> list[Pose]:
    """Of cameras named as frames of a clip those frames' poses, of others the middle frame's; without a clip a relaxed one."""
    from stages.avatar.drawing.turntable import standing
    from stages.formats.poses import read_poses
    from stages.formats.trained import trained_of

    if train is None:
        return [standing()] * len(names)
    body = read_poses(trained_of(train, who) / "body.npz")
    known = dict(zip(body.names, zip(body.global_orient, body.body_pose, body.transl, strict=True), strict=True))
    middle = list(known.values())[len(known) // 2]
    return [known.get(name, middle) for name in names]


def _one_each(poses: Path, count: int, cameras: Path | None) -> list[Pose]:
    """As many poses as there are cameras, of a file that has so many, or one for all."""
    from stages.formats.poses import read_poses

    told = read_poses(poses)
    if len(told) not in (1, count):
        facts = [f"{count} cameras in {cameras}", f"{len(told)} poses in {poses}"]
        raise StageError("poses and cameras do not belong together", "give one pose, or one per camera", facts)
    rows = list(zip(told.global_orient, told.body_pose, told.transl, strict=True))
    return rows * count if len(rows) == 1 else rows
