"""A trained person, with scene, cameras and motions of the clip if there is a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from hugs.gaussians import Gaussians, Person
from hugs.motion import Motion, Motions
from stages import records
from stages.avatar.body.face import face_vector
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import Baked, PosedAvatar, gloved, load_avatar, rested
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.shape import Shapes, in_shape, shapes_of
from stages.avatar.model.person import Resting
from stages.avatar.model.scene import load_scene
from stages.avatar.motion.moves import clip_move
from stages.avatar.motion.placing import Soles
from stages.avatar.rasterize import Camera
from stages.contract import StageError
from stages.filming.cast import body_of
from stages.filming.clip_cast import completed
from stages.formats.clip import load_clip
from stages.formats.exchange.read import read_any_avatar
from stages.formats.facts import Listing, read_facts
from stages.formats.ground import read_ground
from stages.formats.trained import read_trained
from stages.gestures import FACE_NAMES

LEVEL = records.Ground(np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 1.0, 0.0, 0.0, 0, "made")
"""The floor of an avatar without a clip: y is up, the avatar looks along z."""


@dataclass(frozen=True, repr=False)
class Avatar:
    """A trained person, with the scene, cameras and motion of the clip if `load` read the folder of a run.

        avatar = hugs.load("work/dance/default")
        person = avatar.pose(*avatar.motions["clip"][12])
        picture = hugs.draw(person, avatar.cameras[12], avatar.scene)

    Everything is in one world, in metres: the world of the clip, or for an exported file y up with the feet near y = -1.2.
    """

    record: records.Avatar
    """The arrays of the avatar's file."""
    baked: Baked
    """Gaussians at rest, skeleton and clothes, as tensors."""
    body: Body | None = None
    """The body without clothes; None if it is unknown."""
    model: records.BodyModel | None = None
    """The arrays of that body; None if it is unknown."""
    name: str = ""
    """The folder or file that was loaded, as text."""
    path: Path | None = None
    """The path of the folder or file that was loaded."""
    scene: Gaussians[Tensor] | None = None
    """The scene behind the person; None if there is no scene."""
    frames: tuple[str, ...] = ()
    """Names of the F frames of the clip; `cameras` and the motion "clip" have the same order."""
    cameras: tuple[Camera, ...] = ()
    """Cameras of the F frames."""
    clip: Motion | None = None
    """The motion of the clip; None for an exported file."""
    floor: records.Ground | None = None
    """The floor on which the person stood; None for an exported file."""
    light: records.Effects | None = None
    """The lamp for shadows and the light on people, learned from the clip, for `draw`; None for an exported file."""

    def __repr__(self) -> str:
        tall = np.ptp(self.rest.means[:, 1].detach().cpu().numpy())
        bones = f", {len(self.baked.clothing)} bones of clothes" if self.baked.clothing is not None else ""
        clip = f", {len(self.frames)} frames" if self.frames else ""
        scene = f", a scene of {self.scene.count:,}" if self.scene is not None else ""
        return f"<avatar {self.name}: {len(self.record):,} Gaussians, {tall:.2f} m{bones}{scene}{clip}>"

    @property
    def joints(self) -> np.ndarray:
        """Joints [24,3] m at rest, named by JOINT_NAMES."""
        return self.baked.joints.detach().cpu().numpy()

    @property
    def faces(self) -> np.ndarray:
        """Triangles [T,3] between `Person.vertices`, counter-clockwise from outside; [0,3] if the body is unknown."""
        return np.zeros((0, 3), np.int32) if self.model is None else self.model.faces

    @property
    def rest(self) -> Resting:
        """The Gaussians in the rest pose, as tensors; poses move them."""
        return self.baked.resting

    @cached_property
    def motions(self) -> Motions:
        """Motions by name: "clip" if the avatar is from a run, and generated ones such as "walk_in_place"."""
        gestured = self.record.fingers is not None and self.record.face is not None
        return Motions(Soles.of_rig(rig_of(self.record)), self.floor or LEVEL, self.clip, gestured)

    def changed(self, **parts: Tensor) -> Avatar:
        """The same person with some arrays of `rest` replaced: `means` [N,3] m, `axes` [N,3,3] m, `opacities` [N], `sh` [N,K,3].

        Pictures are differentiable in these arrays.
        """
        return replace(self, baked=rested(self.baked, self.rest._replace(**parts)))

    @overload
    def pose(
        self,
        body_pose: Tensor,
        global_orient: ArrayLike | Tensor | None = None,
        transl: ArrayLike | Tensor | None = None,
        betas: ArrayLike | Tensor | None = None,
        hands: ArrayLike | Tensor | None = None,
        face: Mapping[str, float] | ArrayLike | Tensor | None = None,
    ) -> Person[Tensor]: ...

    @overload
    def pose(
        self,
        body_pose: ArrayLike | None = None,
        global_orient: ArrayLike | None = None,
        transl: ArrayLike | None = None,
        betas: ArrayLike | None = None,
        hands: ArrayLike | None = None,
        face: Mapping[str, float] | ArrayLike | None = None,
    ) -> Person[np.ndarray]: ...

    def pose(
        self,
        body_pose: Any = None,
        global_orient: Any = None,
        transl: Any = None,
        betas: Any = None,
        hands: Any = None,
        face: Any = None,
    ) -> Person[Any]:
        """The person in one pose of SMPL, or in P poses at once; arguments left out are zero, and with all zero it is the T-pose.

        `body_pose` [69], [23,3], [P,69] or [P,23,3] and `global_orient` [3] or [P,3] are rotation vectors in radians, `transl`
        [3] or [P,3] is in metres. `betas` [10] is one body shape for all poses instead of the avatar's own; the Gaussians follow
        the skin. `hands` [2,15,3] or [P,2,15,3] in radians turn the fingers of FINGER_NAMES; 0 is the hand at rest. `face` has
        coefficients of the shapes of FACE_NAMES, by name, or as [52] or [P,52], on SMPL-X also as [62] or [P,62], with
        expression1 to expression10. Without them fingers and face are as in the clip.
        If `body_pose` is a tensor, results are tensors, differentiable in all arguments; else they are arrays. ValueError for
        other shapes and numbers that are not finite; StageError for `betas` of an unknown body, and for `hands` or a `face`
        that this avatar lacks.

            person = avatar.pose(torch.zeros(8, 69), transl=torch.randn(8, 3), face={"jawOpen": 0.4})
        """
        arrays = not isinstance(body_pose, Tensor)
        if arrays and any(isinstance(part, Tensor) for part in (global_orient, transl, betas, hands, face)):
            raise ValueError("body_pose must be a tensor if another argument is: give torch.zeros(69)")
        given = {"body_pose": (body_pose, 69), "global_orient": (global_orient, 3), "transl": (transl, 3)}
        if hands is not None:
            self._has("fingers", self.record.fingers)
            given["hands"] = (hands, 90)
        if face is not None:
            self._has("face that moves", self.record.face)
            count = 0 if self.record.face is None else len(self.record.face.moves)
            part = face_vector(face, count) if isinstance(face, Mapping) else face
            given["face"] = (part, len(FACE_NAMES) if np.shape(part)[-1:] == (len(FACE_NAMES),) else count)
        parts = {name: self._tensor(name, *part) for name, part in given.items()}
        counts = {name: len(part) for name, part in parts.items() if part.ndim == 2}
        if len(set(counts.values())) > 1:
            raise ValueError(f"the numbers of poses differ: {counts}")
        count = next(iter(counts.values()), 1)
        parts = {name: part.expand(count, -1) for name, part in parts.items()}
        shape = self._betas if betas is None else self._tensor("betas", betas, 10)
        baked = self.baked if hands is None else self._gloved
        baked = baked if betas is None else in_shape(baked, self._shapes, shape - self._betas)
        moved = {"hands": parts["hands"].unflatten(1, (2, 15, 3))} if hands is not None else {}
        moved |= {"face": parts["face"]} if face is not None else {}
        posed = PosedAvatar(baked, parts["global_orient"], parts["body_pose"], parts["transl"], **moved)
        return Person(posed, self.body, shape, bool(counts), arrays)

    def _has(self, what: str, part: object) -> None:
        if part is None:
            facts = ["old avatars and those on SMPL have neither fingers nor face, those on SMPL-H no face"]
            raise StageError(f"the avatar {self.name} has no {what}", "train it again, without --body-model", facts)

    @cached_property
    def _gloved(self) -> Baked:
        return gloved(self.baked)

    @cached_property
    def _betas(self) -> Tensor:
        return self._tensor("betas", self.record.betas, 10)

    @cached_property
    def _shapes(self) -> Shapes:
        if self.body is None:
            raise StageError(
                "the body of this avatar is unknown, so its shape cannot change",
                "load the folder of its run, which holds the body",
                ["an exported avatar holds joints and Gaussians, but no template of the body"],
            )
        return shapes_of(self.baked, self.body, self._betas)

    def _tensor(self, name: str, value: Any, size: int) -> Tensor:
        """One argument of a pose as a tensor [size] or [P,size], in the precision and on the device of the avatar."""
        joints = self.baked.joints
        part = torch.zeros(size) if value is None else torch.as_tensor(value)
        if name == "body_pose" and part.shape[-2:] == (23, 3):
            part = part.flatten(-2)
        if name == "hands" and part.shape[-3:] == (2, 15, 3):
            part = part.flatten(-3)
        few = (1,) if name == "betas" else (1, 2)
        if part.ndim not in few or part.shape[-1] != size or not part.isfinite().all():
            raise ValueError(
                f"{name} has the shape {tuple(part.shape)}, wanted are {size} finite numbers for each pose"
            )
        return part.to(joints)


def load(path: str | PathLike[str], who: int = 1, device: str = "cpu") -> Avatar:
    """Load, to `device`, the avatar of a finished run with its clip and scene (`path` is a folder such as work/dance/default), or
    an avatar alone (`path` is an avatar.npz or avatar_splats.glb).

    `who` is the number of the person in a run, from 1 on. StageError, with facts and a hint, for any other path and for a
    number without a person.

        avatar = hugs.load("work/dance/default")
    """
    place = Path(path)
    if not place.is_dir():
        if who != 1:
            raise StageError(f"{place} holds one person: there is no person {who}", "leave out `who`")
        record = read_any_avatar(place)
        return _avatar(record, body_of(None, record), device, name=place.name, path=place)
    train, sfm, smpl = (place / stage for stage in ("train", "sfm", "smpl"))
    if not (train / "avatar.npz").is_file():
        facts = [f"no {train / 'avatar.npz'}"]
        raise StageError(f"{place} is no finished run", "give the folder of a run, such as work/dance/default", facts)
    record, scene, effects = read_trained(train, who)
    clip = load_clip(sfm, smpl, train, who)
    times = np.array(read_facts(place / "frames" / "frames.json", Listing).times(clip.names))
    views = zip(clip.viewmats, clip.Ks, strict=True)
    body = clip.body if record.fingers is not None else replace(clip.body, hands=None)
    return _avatar(
        record,
        clip.body_model,
        device,
        name=f"{place}" if who == 1 else f"{place}, person {who}",
        path=place,
        scene=None if scene is None else Gaussians([load_scene(scene, device)]),
        frames=clip.names,
        cameras=tuple(Camera.of(viewmat, K, clip.width, clip.height) for viewmat, K in views),
        clip=Motion.of(clip_move(body, times), clip.body.confidence > 0),
        floor=read_ground(smpl / "ground.json"),
        light=replace(effects, shutter=None, readout=None),
    )


def _avatar(record: records.Avatar, model: records.BodyModel | None, device: str, **clip: Any) -> Avatar:
    baked = load_avatar(completed(record, model), device)
    body = None if model is None else Body(model).to(device)
    return Avatar(record, baked, body, model, **clip)
