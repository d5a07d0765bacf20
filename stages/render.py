"""Videos of the result: held-out frames, the person from all sides, a new motion, and the empty scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.drawing.draw import Learned
    from stages.avatar.motion.placing import Soles
    from stages.formats.clip import Clip
    from stages.records import Ground


class Params(contract.Params):
    fps: int = Field(24, gt=0)
    """Frames a second of the videos."""
    turntable_frames: int = Field(72, gt=0)
    """Pictures around the person."""
    motion: Literal["jumping_jacks", "wave", "walk_in_place", "squats"] = "jumping_jacks"
    """The motion that is not in the clip."""
    motion_seconds: float = Field(4.0, gt=0)
    """Length of that motion."""


SHORTER = {"turntable_frames": 36, "motion_seconds": 2.0}
PICTURE = 0.3
"""Training steps of full size that it takes to draw one picture of a film.
The kitchen clip, a short training, 2 cores, November 2026."""


def cost(params: Params, folders: Mapping[str, Path]) -> float:
    """See `contract.StageModule`."""
    from stages.formats.clip import load_clip

    clip = load_clip(folders["sfm"], folders["smpl"])
    heldout, frames = int(clip.heldout.sum()), len(clip.names)
    return PICTURE * (params.turntable_frames + params.motion_seconds * params.fps + heldout + frames)


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, train: Path) -> None:
    """Render turntable.mp4, motion.mp4, heldout.mp4 if a frame is held out, and scene.mp4 if there is a scene."""
    import numpy as np

    from stages.avatar.drawing.draw import load_learned
    from stages.avatar.drawing.rig import rig_of
    from stages.avatar.motion.placing import Soles
    from stages.formats.clip import load_clip
    from stages.formats.ground import read_ground
    from stages.formats.trained import read_trained
    from stages.formats.video import write_video

    clip, ground, trained = load_clip(sfm, smpl, train), read_ground(smpl / "ground.json"), read_trained(train)
    learned, fps = load_learned(*trained, job.device), float(params.fps)
    shots: dict[str, tuple[Iterator[np.ndarray], float]] = {
        "turntable": (_turntable(learned, params.turntable_frames), fps),
        "motion": (_motion(clip, learned, ground, Soles.of_rig(rig_of(trained[0])), params), fps),
    }
    held = [int(i) for i in np.flatnonzero(clip.heldout) if learned.scene is not None or clip.shows_person(int(i))]
    if held:
        shots["heldout"] = (_beside_truth(clip, learned, held), 4.0)
    if learned.scene is not None:
        shots["scene"] = (_empty(clip, learned), fps / 2)
    for done, (name, (pictures, rate)) in enumerate(shots.items()):
        job.progress(done, len(shots))
        write_video(job.out / f"{name}.mp4", pictures, rate)
    job.note(", ".join(f"{name}.mp4" for name in shots))


def _beside_truth(clip: Clip, learned: Learned, order: list[int]) -> Iterator[np.ndarray]:
    """The clip on the left; on the right ours, as the same camera and its shutter take it.

    Without a scene it is over white. Frames that show nobody are drawn without the person.
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


def _turntable(learned: Learned, count: int) -> Iterator[np.ndarray]:
    """The person, standing relaxed, from all sides over white, in even light."""
    from stages.avatar.drawing.draw import draw, to_uint8
    from stages.avatar.drawing.turntable import around, standing
    from stages.avatar.effects.frames import FrameEffects

    human = learned._replace(effects=FrameEffects()).person(standing())
    for camera in around(human.means.cpu().numpy(), count):
        yield to_uint8(draw(human, None, camera, 1.0)[0])


def _motion(clip: Clip, learned: Learned, ground: Ground, soles: Soles, params: Params) -> Iterator[np.ndarray]:
    """The person in a new motion on the floor where they stood in the clip, seen by the camera of the middle frame."""
    from stages.avatar.drawing.draw import perform
    from stages.avatar.motion.moves import made_move
    from stages.avatar.rasterize import Camera

    move = made_move(params.motion, ground, soles, params.motion_seconds, params.fps)
    middle = len(clip.names) // 2
    camera = Camera.of(clip.viewmats[middle], clip.Ks[middle], clip.width, clip.height)
    poses = (move.rotvecs[:, :3], move.rotvecs[:, 3:], move.steps)
    yield from perform(learned, learned.scene, poses, [camera] * len(move.steps))
