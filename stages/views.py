"""Pictures of the result for cameras and poses that the user gives. No pipeline names it; `hugs render` runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from stages import contract
from stages.contract import Job, StageError


class Params(contract.Params):
    only: Literal["human", "scene", "both"] = "both"
    """What to show."""


def run(job: Job, params: Params, *, train: Path, cameras: Path, poses: Path | None) -> None:
    """Write one PNG with alpha (not multiplied into color) for each camera.

    `cameras` is a cameras.npz in the clip's world (metres); `poses` a body.npz with one pose or one per camera. Without
    it a camera named as a frame of the clip gets that frame's pose, any other the middle frame's. Raises StageError when
    the counts differ, or when the scene is asked for and there is none.
    """
    import numpy as np

    from stages.avatar.drawing.draw import draw, load_learned, to_uint8
    from stages.avatar.rasterize import Camera
    from stages.formats.cameras import read_cameras
    from stages.formats.images import write_image
    from stages.formats.poses import read_poses
    from stages.formats.trained import check_scene, read_trained, read_trained_poses

    path, only = read_cameras(cameras), params.only
    learned, known = load_learned(*read_trained(train), job.device), read_trained_poses(train)
    if only != "human":
        check_scene(train)
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
    job.out.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(path.names):
        human = learned.person(chosen[i]) if only != "scene" else None
        scene = learned.shade(learned.scene, None if human is None else chosen[i]) if only != "human" else None
        image, alpha = draw(human, scene, Camera.of(path.viewmats[i], path.Ks[i], path.width, path.height))
        color = image / np.maximum(alpha, 1 / 255)[..., None]
        picture = job.out / f"{name}.png"
        picture.unlink(missing_ok=True)  # it may be a link to somebody's picture
        write_image(picture, to_uint8(np.concatenate([color, alpha[..., None]], 2)))
    job.note(f"{len(path)} picture{'' if len(path) == 1 else 's'} of {only}")
