"""Joins the files of the stages sfm and smpl to one clip: frames, masks, cameras and body in one world of metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.hands import hands_in, with_hands
from stages.formats.images import Kept, read_image, read_mask
from stages.formats.people import folder_of, masks_of, model_of, people_of
from stages.formats.points import read_points
from stages.formats.poses import read_poses
from stages.formats.splits import read_split
from stages.records import BodyModel, BodyPoses, Cameras, Split

FARTHEST = 1000.0  # metres from a world's origin: there a step of float32 is 0.06 mm


@dataclass(frozen=True)
class Clip:
    """C frames with their cameras and bodies, joined by name.

    `names` [C]; `viewmats` [C,4,4] float64 camera_from_world in metres, `Ks` [C,3,3] px, one `width` and `height`;
    `split` says what is trained on and what is held out; of several people `person` is the one that `body` is of;
    `points` [P,3] metres and `colors` [P,3] uint8 from SfM (P may be 0); `body` in the order of `names`.
    """

    folder: Path
    cameras: Cameras
    viewmats: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    body: BodyPoses
    body_model: BodyModel
    person: int = 1
    hand_shape: np.ndarray | None = None
    """The pose [2,15,3] rad of the fingers that the clip shows, 0 for a hand that is not read; None: none is."""
    alone: bool = False
    """Masks are of `person`, and not of everybody."""
    kept: Kept | None = None
    """Pictures for whoever asks for them again; None: each is read from its file every time."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.cameras.names

    @property
    def Ks(self) -> np.ndarray:
        return self.cameras.Ks

    @property
    def world_cameras(self) -> Cameras:
        """The cameras in metres."""
        return replace(self.cameras, viewmats=self.viewmats)

    @property
    def width(self) -> int:
        return self.cameras.width

    @property
    def height(self) -> int:
        return self.cameras.height

    @cached_property
    def split(self) -> Split:
        """split.json's split; without the file every 5th frame is held out."""
        return read_split(self.folder / "split.json", self.names)

    @property
    def training(self) -> np.ndarray:
        """bool [C]: frames to train on."""
        return self.split.training

    @property
    def heldout(self) -> np.ndarray:
        """bool [C]: frames only for measuring."""
        return self.split.heldout

    def images(self, i: int) -> np.ndarray:
        """Undistorted frame `i`, uint8 [H,W,3]."""
        return self._read(read_image, self.folder / "images", i)

    def mask(self, i: int) -> np.ndarray:
        """Its person mask, uint8 [H,W], 255 = person; of everybody where several are modelled and none is `alone`."""
        if self.alone:
            return self.own_mask(i)
        return self._read(read_mask, self.folder / "masks", i)

    def own_mask(self, i: int) -> np.ndarray:
        """The mask of `person` alone, uint8 [H,W]."""
        return self._read(read_mask, masks_of(self.folder, self.person), i)

    def shows_person(self, i: int) -> bool:
        """Whether the mask of frame `i` has `person` in it."""
        return bool((self.own_mask(i) > 127).any())

    def _read(self, read: Callable[[Path], np.ndarray], folder: Path, i: int) -> np.ndarray:
        path = folder / f"{self.names[i]}.png"
        pixels = self.kept.read(read, path) if self.kept else read(path)
        if pixels.shape[:2] != (self.height, self.width):
            raise StageError(
                f"{path.relative_to(self.folder)} does not have the size of its camera",
                "run the sfm stage again: `hugs run VIDEO sfm --force`",
                [f"picture {pixels.shape[1]}x{pixels.shape[0]}, camera {self.width}x{self.height}"],
            )
        return pixels


def load_people(sfm: Path, smpl: Path, train: Path | None = None) -> list[Clip]:
    """As `load_clip` for each person of a clip."""
    return [load_clip(sfm, smpl, train, person) for person in people_of(sfm)]


def load_clip(sfm: Path, smpl: Path, train: Path | None = None, person: int = 1) -> Clip:
    """Join the folders of the `sfm` and `smpl` stages, with the refined poses, and cameras if any, of a `train` folder.

    Of several people `person` is the one whose body it has. Raises StageError when a frame with a camera has no body, or the
    world's origin is too far for float32.
    """
    refined = train is not None and (train / "cameras.npz").exists()
    cameras = read_cameras((train if train and refined else sfm) / "cameras.npz")
    poses = read_poses(folder_of(train or smpl, person) / "body.npz")
    row = {name: i for i, name in enumerate(poses.names)}
    missing = [name for name in cameras.names if name not in row]
    if missing:
        raise StageError(
            f"{len(missing)} of {len(cameras)} frames have a camera but no body",
            "run the smpl stage again: `hugs run VIDEO smpl --force`",
            [f"first: {', '.join(missing[:5])}"],
        )
    order = [row[name] for name in cameras.names]
    ordered = BodyPoses(
        names=cameras.names,
        betas=poses.betas,
        global_orient=poses.global_orient[order],
        body_pose=poses.body_pose[order],
        transl=poses.transl[order],
        confidence=poses.confidence[order],
        world_from_sfm=poses.world_from_sfm,
        face=None if poses.face is None else poses.face[order],
    )
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] *= poses.world_from_sfm
    away = float(np.abs(cameras.centers).max() * poses.world_from_sfm)
    if away > FARTHEST:
        raise StageError(
            f"the cameras stand {away:.3g} m from the origin of their world",
            "take the place of the first camera off all cameras, points and poses before they are given",
            [f"the limit is {FARTHEST:.0f} m: beyond, float32 is too coarse for a person's skin"],
        )
    hands = hands_in(folder_of(smpl, person))
    xyz, rgb = read_points(sfm / "points.ply")
    return Clip(
        folder=sfm,
        cameras=cameras,
        viewmats=viewmats,
        points=xyz.astype(np.float64) * poses.world_from_sfm,
        colors=rgb,
        body=with_hands(ordered, hands),
        body_model=read_body_model(model_of(smpl, person)),
        person=person,
        hand_shape=None if hands is None else hands.shape,
    )
