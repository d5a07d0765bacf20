"""Videos of the result: held-out frames, the person from all sides, a new motion, and the empty scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field, ValidationInfo, field_validator

from stages import contract
from stages.contract import Job
from stages.formats.facts import Trained, read_facts
from stages.formats.people import folder_of, people_of

if TYPE_CHECKING:
    import numpy as np

    from stages.avatar.drawing.avatar import PosedAvatar
    from stages.avatar.drawing.cast import Cast
    from stages.avatar.motion.placing import Soles
    from stages.formats.clip import Clip
    from stages.records import Ground

LOADS = contract.TORCH


class Params(contract.Params):
    fps: int = Field(24, gt=0, le=240)
    """Frames a second of the videos."""
    turntable_frames: int = Field(72, gt=0, le=10_000)
    """Pictures around the person."""
    motion: Literal["jumping_jacks", "wave", "walk_in_place", "squats"] = "jumping_jacks"
    """The new motion in motion.mp4."""
    motion_seconds: float = Field(4.0, gt=0, le=3600)
    """Length of that motion in s."""

    @field_validator("motion_seconds")
    @classmethod
    def _has_two_pictures(cls, seconds: float, known: ValidationInfo) -> float:
        if round(seconds * known.data.get("fps", 24)) < 2:
            raise ValueError("less than two pictures at so many frames a second")
        return seconds


SHORTER = {"turntable_frames": 36, "motion_seconds": 2.0}
PICTURE = 0.3
"""Training steps of full size that it takes to draw one picture of a film.
The kitchen clip, a short training, 2 cores, November 2026."""


def cost(params: Params, folders: Mapping[str, Path]) -> float:
    """See `contract.StageModule`."""
    from stages.formats.clip import load_clip

    clip = load_clip(folders["sfm"], folders["smpl"])
    heldout, frames = int(clip.heldout.sum()), len(clip.names)
    of_each = len(people_of(folders["sfm"])) * (params.turntable_frames + params.motion_seconds * params.fps)
    return PICTURE * (of_each + heldout + frames)


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, train: Path) -> None:
    """Render turntable.mp4, motion.mp4, heldout.mp4 if a frame is held out, and scene.mp4 if there is a scene.

    The first two of each further person are in people/2 and so on.
    """
    import numpy as np

    from stages.avatar.drawing.rig import rig_of
    from stages.avatar.motion.placing import Soles
    from stages.filming.clip_cast import floor_under, load_cast
    from stages.formats.ground import read_ground
    from stages.formats.splats import read_avatar
    from stages.formats.video import write_video

    ground, (clips, cast), fps = (
        read_ground(smpl / "ground.json"),
        load_cast(sfm, smpl, train, job.device),
        float(params.fps),
    )
    clip, shots = clips[0], dict[str, tuple[Iterator[np.ndarray], float]]()
    for one, who in zip(clips, cast.people, strict=True):
        place = folder_of(Path(), one.person)
        (job.out / place).mkdir(parents=True, exist_ok=True)
        rig = rig_of(read_avatar(folder_of(train, one.person) / "avatar.npz"))
        motion = _motion(one, who, cast, floor_under(one, rig, ground), Soles.of_rig(rig), params)
        shots[str(place / "turntable")] = (_turntable(who, params.turntable_frames), fps)
        shots[str(place / "motion")] = (motion, fps)
    shown = [cast.scene is not None or any(one.shows_person(i) for one in clips) for i in range(len(clip.names))]
    held = [int(i) for i in np.flatnonzero(clip.heldout & shown)]
    if held:
        gains = read_facts(train / "train.json", Trained).exposure
        shots["heldout"] = (_beside_truth(clip, cast, held, gains), 4.0)
    if cast.scene is not None:
        shots["scene"] = (_empty(clip, cast), fps / 2)
    for done, (name, (pictures, rate)) in enumerate(shots.items()):
        job.progress(done, len(shots))
        write_video(job.out / f"{name}.mp4", pictures, rate)
    job.note(", ".join(f"{name}.mp4" for name in shots))


def _beside_truth(clip: Clip, cast: Cast, order: list[int], gains: dict[str, list[float]]) -> Iterator[np.ndarray]:
    """The clip on the left; on the right ours, as the same camera, its shutter and its exposure (`gains` by frame) take it.

    Without a scene it is over white. Frames that show nobody are drawn without the person.
    """
    import numpy as np

    from stages.avatar.drawing.pixels import exposed, to_uint8
    from stages.avatar.rasterize import Camera

    for i in order:
        camera, white = Camera.of(clip.viewmats[i], clip.Ks[i], clip.width, clip.height), 0.0 if cast.scene else 1.0
        gain = np.array(gains.get(clip.names[i], [1.0, 1.0, 1.0]), np.float32)
        drawn = cast.at(i).picture(camera, white)
        yield np.concatenate([clip.images(i), to_uint8(exposed(*drawn, white, gain))], 1)


def _empty(clip: Clip, cast: Cast) -> Iterator[np.ndarray]:
    from stages.avatar.drawing.cast import Moment
    from stages.avatar.drawing.pixels import to_uint8
    from stages.avatar.rasterize import Camera

    for viewmat, K in zip(clip.viewmats, clip.Ks, strict=True):
        yield to_uint8(Moment((), cast.scene).picture(Camera.of(viewmat, K, clip.width, clip.height))[0])


def _turntable(who: PosedAvatar, count: int) -> Iterator[np.ndarray]:
    """The person, standing relaxed, from all sides over white, in even light."""
    from stages.avatar.drawing.avatar import PosedAvatar
    from stages.avatar.drawing.cast import Moment
    from stages.avatar.drawing.pixels import to_uint8
    from stages.avatar.drawing.turntable import around, standing

    human = PosedAvatar.of(who.avatar, *standing()).splats(0)
    for camera in around(human.means.cpu().numpy(), count):
        yield to_uint8(Moment([human]).picture(camera, 1.0)[0])


def _motion(
    clip: Clip, who: PosedAvatar, cast: Cast, ground: Ground, soles: Soles, params: Params
) -> Iterator[np.ndarray]:
    """The person in a new motion on the floor where they stood in the clip, seen by the camera of the middle frame."""
    from stages.avatar.drawing.avatar import PosedAvatar
    from stages.avatar.drawing.pixels import to_uint8
    from stages.avatar.motion.moves import made_move
    from stages.avatar.rasterize import Camera, Kept

    move = made_move(params.motion, ground, soles, params.motion_seconds, params.fps)
    middle = len(clip.names) // 2
    camera = Camera.of(clip.viewmats[middle], clip.Ks[middle], clip.width, clip.height)
    moving = PosedAvatar.of(who.avatar, move.rotvecs[:, :3], move.rotvecs[:, 3:], move.steps)
    scene, kept = cast._replace(people=[moving], speeds=None), Kept()
    for number in range(len(move.steps)):
        yield to_uint8(scene.at(number).picture(camera, 0.0 if cast.scene else 1.0, kept)[0])
