"""What training looks at: the pictures of a clip, the fitted body in them, and the window around the person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras.pinhole import onto
from stages.avatar.drawing.attach import FaceSkin, HandSkin
from stages.avatar.drawing.avatar import Gloves, Mien, turned_fingers
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.shadow import Casters, casters
from stages.avatar.effects.speeds import Speeds
from stages.avatar.model.person import Resting, Surfels, bone_transforms, pose
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import spread_evenly
from stages.records import JOINTS

CROP = 12  # pixels left around the person in the person-only render
LOOKS = 32  # training frames, at most, that finishing looks at
NEAR = 0.05  # metres: points of the person nearer to the camera do not widen the window


class Views(NamedTuple):
    """Pictures: images uint8[F,H,W,3], masks uint8[F,H,W] (255 = person), viewmats[F,4,4] (metres), Ks[F,3,3] px.

    moments int64[F], not falling: when each was taken, in frames; None: one after the other. gains [F,3]: exposure of drawn
    colours; None where it is learned.
    """

    images: Tensor
    masks: Tensor
    viewmats: Tensor
    Ks: Tensor
    moments: Tensor | None = None
    gains: Tensor | None = None

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        height, width = self.masks.shape[1:]
        return Camera(self.viewmats[frame], self.Ks[frame], width, height)

    def half(self) -> Views:
        """The same at half the resolution, by area."""
        images, masks, Ks = halved(self.images), halved(self.masks[..., None])[..., 0], self.Ks.clone()
        Ks[:, 0] *= masks.shape[2] / self.masks.shape[2]
        Ks[:, 1] *= masks.shape[1] / self.masks.shape[1]
        return self._replace(images=images, masks=masks, Ks=Ks)


def halved(pictures: Tensor) -> Tensor:
    """Pictures uint8 [F,H,W,C] at half the resolution, by area: in floats one at a time, whatever the clip's length."""
    half = max(1, pictures.shape[1] // 2), max(1, pictures.shape[2] // 2)
    small = [F.adaptive_avg_pool2d(one.permute(2, 0, 1).float(), half).round().to(torch.uint8) for one in pictures]
    return torch.stack([one.permute(1, 2, 0) for one in small])


class Poses(NamedTuple):
    """global_orient [...,3] and body_pose [...,69] rad, transl [...,3] m; coefficients `face` [...,K], None: it stays still."""

    global_orient: Tensor
    body_pose: Tensor
    transl: Tensor
    face: Tensor | None = None

    def at(self, frame: int) -> Poses:
        """Those of one of F frames."""
        return Poses(*(part[frame] for part in self if part is not None))


class FittedHands(NamedTuple):
    """The fingers of all frames: `turns` [F,2,15,3] rad, on joints[30,3] m at rest; and the pose `shape` [2,15,3] in which hands
    learn, with their `skin` in it.
    """

    joints: Tensor
    shape: Tensor
    turns: Tensor
    skin: HandSkin

    def gloves(self, means: Tensor, weights: Tensor) -> Gloves:
        """What Gaussians at rest at means[N,3] m, with weights[N,J] without fingers, have of them."""
        return Gloves(self.joints, self.shape, *self.skin.shares(means, weights))


class FittedBody(NamedTuple):
    """The fitted body of all frames, and what the canonical pose needs.

    global_orient[F,3], body_pose[F,69], transl[F,3], confidence[F] from 0 (no fit worth learning from) to 1, joints[24,3]
    at rest, parents, canonical_pose[69], template vertices[V,3] at the canonical pose with weights[V,J], faces[T,3],
    J: the bones of skeleton and clothes. `clothing`: the bones of clothes, or None; `cloth`: their Gaussians at the canonical
    pose. `antialias`: how to draw. `hands`: fingers, where the clip shows them. `face`: where it is learned, or given,
    with coefficients `expressions` [F,K] where these are known.
    """

    global_orient: Tensor
    body_pose: Tensor
    transl: Tensor
    confidence: Tensor
    joints: Tensor
    parents: list[int]
    canonical_pose: Tensor
    vertices: Tensor
    weights: Tensor
    faces: Tensor
    clothing: Clothing | None = None
    antialias: bool = False
    cloth: Surfels | None = None
    hands: FittedHands | None = None
    face: FaceSkin | None = None
    expressions: Tensor | None = None

    @property
    def poses(self) -> Poses:
        """Those of all frames, as they were fitted."""
        return Poses(self.global_orient, self.body_pose, self.transl, self.expressions)

    @property
    def learns_face(self) -> bool:
        """Whether training finds how the face moves: it does, and nobody says how."""
        return self.face is not None and self.expressions is None

    @property
    def own_bones(self) -> int:
        """How many bones the clothes have."""
        return 0 if self.clothing is None else len(self.clothing)

    def surface(self) -> tuple[Tensor, Tensor, Tensor]:
        """Points [S,3] m of skin and cloth at the canonical pose, unit normals [S,3] and skinning weights [S,J]."""
        skin = self.vertices, vertex_normals(self.vertices, self.faces), self.weights
        if self.cloth is None:
            return skin
        cloth = self.cloth.means, self.cloth.rotations[..., 2], self.cloth.weights
        points, normals, weights = (torch.cat(pair) for pair in zip(skin, cloth, strict=True))
        return points, normals, weights

    def canonical_bones(self) -> Tensor:
        """Transforms [J,4,4] of all bones from rest to the canonical pose, in which clothes follow the skeleton."""
        bones = bone_transforms(self.joints, self.parents, torch.zeros_like(self.joints[0]), self.canonical_pose)
        return bones if self.clothing is None else self.clothing.hang(bones)

    def casters(self) -> Casters:
        """What of them casts a shadow, at rest."""
        bones = self.canonical_bones()[:JOINTS]
        return casters(self.vertices, self.weights[:, :JOINTS]).posed(torch.linalg.inv(bones))

    def bones(self, frame: int) -> Tensor:
        """Transforms [J,4,4] of all bones from rest to the pose of a frame; `transl` is not in them."""
        bones = bone_transforms(self.joints, self.parents, self.global_orient[frame], self.body_pose[frame])
        return bones if self.clothing is None else self.clothing.hang(bones, self.clothing.swing(self.body_pose[frame]))

    def posed(self, resting: Resting, frame: int) -> Splats:
        """Someone at rest with this body and these clothes, as they stand in a frame."""
        if (mien := self.mien(resting)) is not None and self.expressions is not None:
            resting = resting._replace(means=mien.moved(resting.means, self.expressions[frame]))
        return self.placed(resting, self.bones(frame), self.transl[frame], frame)._replace(antialias=self.antialias)

    def mien(self, resting: Resting) -> Mien | None:
        """What of someone at rest moves with the face; None where none is learned."""
        return None if self.face is None else self.face.at(resting.means.detach(), resting.weights.detach())

    def placed(self, resting: Resting, bones: Tensor, transl: Tensor, frame: int) -> Splats:
        """Someone at rest, moved by `bones` [J,4,4] and `transl` [3] m, with the fingers of a frame."""
        if (hands := self.hands) is not None:
            bones = torch.cat([bones, turned_fingers(hands.joints, hands.shape, hands.turns[frame], bones)])
        return pose(self.gloved(resting), bones, transl)

    def gloved(self, resting: Resting) -> Resting:
        """Someone at rest with weights for fingers, if the clip shows these; who has them already stays as they are."""
        if self.hands is None or resting.weights.shape[1] > len(self.joints) + self.own_bones:
            return resting
        gloves = self.hands.gloves(resting.means, resting.weights)
        return resting._replace(weights=gloves.weights(resting.weights))


def person_frames(body: FittedBody, views: Views, frames: list[int]) -> list[int]:
    """At most LOOKS of those `frames` that show the person, spread evenly."""
    return spread_evenly([i for i in frames if body.confidence[i] > 0 and views.masks[i].max() > 0], LOOKS)


def frame_speeds(views: Views) -> Speeds:
    """How the camera moves at each frame."""
    moments = np.arange(len(views.images)) if views.moments is None else views.moments.cpu().numpy()
    return Speeds(views.viewmats.cpu().numpy(), views.Ks, views.images.shape[1], moments)


def person_box(mask: Tensor, points: Tensor, viewmat: Tensor, K: Tensor) -> tuple[int, int, int, int]:
    """Window (left, top, right, bottom) px of the picture around the person's mask[H,W] and points[N,3] in the world."""
    height, width = mask.shape
    marked, found = mask > 0.5, []
    rows, columns = marked.any(1).nonzero()[:, 0], marked.any(0).nonzero()[:, 0]
    if len(rows):
        found.append(torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).to(points))
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    local = local[local[:, 2] > NEAR]
    if len(local):
        at = onto(local, K)
        found.append(torch.cat([at.amin(0).floor(), at.amax(0).ceil()]))
    if not found:
        return 0, 0, width, height
    boxes = list(zip(*torch.stack(found).tolist()))
    left, top = (int(min(size - 1, max(0, min(box) - CROP))) for box, size in zip(boxes[:2], (width, height)))
    right, bottom = (int(min(size, max(1, max(box) + CROP))) for box, size in zip(boxes[2:], (width, height)))
    return left, top, max(right, left + 1), max(bottom, top + 1)
