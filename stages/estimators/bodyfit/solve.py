"""One optimisation over all frames of a clip: landmarks, outlines, joints, motion, feet and scale at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.joints import ANKLES, HEAD, HIPS
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import Body, Landmarks, vertex_normals
from stages.avatar.splats.neighbours import farthest_points
from stages.estimators.bodyfit import terms
from stages.estimators.bodyfit.balance import balance_cost
from stages.estimators.bodyfit.contact import floor_cost, loosen, slide_cost, sole_vertices, stance
from stages.estimators.bodyfit.evidence import LandmarkEvidence, joint_trust
from stages.estimators.bodyfit.skin import Bones, Skin
from stages.estimators.bodyfit.snug import snugness
from stages.estimators.bodyfit.surface_motion import SurfaceMotion
from stages.records import JOINT_NAMES

# Standard deviations; lengths in the picture are shares of the person's height there.
LANDMARK, OUTLINE = 0.010, 0.008
# Error in rad of a part's direction by BlazePose, by the landmark at its end; measured on the synthetic clip. Feet have
# none: BlazePose points toes at the camera, whatever they do (median 28 degrees off, one in ten 130).
DIRECTION = {
    "shoulder": 0.18, "elbow": 0.2, "wrist": 0.3, "hand": 0.35, "hip": 0.12, "knee": 0.17, "ankle": 0.17, "ear": 0.18,
    "eye": 0.22,
}  # fmt: skip
CLOTH = (0.01, 0.02)  # m that clothes, hair and shoes stand off the skin at each joint: mean and spread
BIAS = (0.15, 0.15)  # spreads: the landmarks' lean, m a metre of height, and the logarithm of their flatness
# Outlines pull each frame its own way: with spreads 2.5 times as wide, people jitter, and joints are 0.4 cm worse.
ACCELERATION = {"pelvis": 1.6, "spine": 2.0, "hip": 2.0, "neck": 2.0, "collar": 2.4, "head": 2.4, "shoulder": 2.4}
ACCELERATION_REST = 4.2  # m/s^2, limbs
TURNING = 18.0  # rad/s^2, of each joint's rotation vector
TURN_SPEED = 3.0  # rad/s; keeps a limb that goes out of sight from swinging on until the clip ends
BETAS = 0.4  # weight of one squared beta against one frame's evidence: at 0.12 clothes make odd bodies
# Shares of the whole: 160 contour points are not 160 independent observations. With outlines at 100, joints of courtyard are
# 4.1 cm off in place of 4.4, but the twelve clips for setting stand 1 cm nearer: clothes pull. At 300 and without room for
# clothes 14.4.
OUTLINE_SHARE, OUTSIDE_SHARE, DIRECTION_SHARE, PRIOR_SHARE = 60.0, 100.0, 0.5, 0.5
NEAREST = 0.05  # m before the camera, to which what is nearer or behind it is brought
# Vertices: that flow moves and the floor holds, that masks hold, that outlines choose from
MARKS, COARSE, DENSE = 300, 300, 2500
SEGMENTS = (
    *((f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (("shoulder", "elbow"),
    ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"), ("shoulder", "hip"), ("ear", "eye"), ("wrist", "hand"))),
    ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder"), ("left_ear", "right_ear"),
)  # fmt: skip
LOOSE = {"hip": 0.4, "shoulder": 0.7, "heel": 0.6, "big_toe": 0.6, "foot": 0.4, "hand": 0.4, "ear": 0.25}
"""Trust in landmarks that BlazePose and the body model do not put at quite the same spot; 1 for the others."""


@dataclass
class State:
    """The unknowns of F frames: root rotation [F,3,3] and place [F,3] m (camera from body), pose [F,69], shape, scale.

    The clip shares the landmarks' `bias` [2]: how far their depths lean toward the camera (m a metre of height), and the
    logarithm of how much too flat they are; and `cloth` [24] m: how far clothes, hair and shoes stand off the skin at
    each joint.
    """

    root: Tensor
    place: Tensor
    pose: Tensor
    betas: Tensor
    bias: Tensor = field(default_factory=lambda: torch.zeros(2))
    cloth: Tensor = field(default_factory=lambda: torch.full((24,), CLOTH[0]))
    scale: float = 1.0


@dataclass(frozen=True)
class World:
    """The world of the camera frames: rotations [F,3,3] camera_from_world, centres [F,3] SfM units, times [F] s.

    `up` [3], against gravity, is known to `up_spread` rad, metres per SfM unit to `scale_spread` of itself before the last
    steps. `floor` is the floor's normal [3], which is `up` unless it slopes, and its offset (None: no floor known). `moving`
    False: one camera, its frame is the world. `size` [2] px of the pictures; `motion` of the surface in them, if there are
    pictures.
    """

    turn: Tensor
    center: Tensor
    times: Tensor
    moving: bool
    up: Tensor
    up_spread: float
    size: Tensor
    motion: SurfaceMotion | None = None
    floor: tuple[Tensor, float] | None = None
    scale_spread: float = 1.0


class Solver:
    """The costs of a clip's frames, ready to be minimised."""

    def __init__(
        self, body: Body, regressor: Tensor, faces: Tensor, evidence: LandmarkEvidence, Ks: np.ndarray, world: World
    ):
        self.body, self.evidence, self.world = body, evidence, world
        self.landmarks = Landmarks(body, regressor)
        f32 = torch.float32
        self.K, self.xy, self.height = (torch.tensor(a, dtype=f32) for a in (Ks, evidence.xy, evidence.height))
        trust = [LOOSE.get(name.partition("_")[2], 1.0) * evidence.trusted(name) for name in evidence.names]
        # what BlazePose calls 30 % visible is a guess: an arm behind the body is 10 to 30 % of the height off
        self.weight = torch.tensor(evidence.weight, dtype=f32).square() * torch.tensor(trust)
        names = evidence.names
        pairs = [(names.index(a), names.index(b)) for a, b in SEGMENTS if a in names and b in names]
        self.tail, self.head = (list(ends) for ends in zip(*pairs, strict=True))
        guessed = torch.tensor(evidence.world, dtype=f32)
        self.guessed = guessed[:, self.head] - guessed[:, self.tail]
        self.sight = terms.sight_turns(torch.tensor(evidence.middle, dtype=f32), self.K)
        limbs = torch.tensor(evidence.limbs(self.head, self.tail), dtype=f32)
        self.segment_weight = (self.weight[:, self.head] * self.weight[:, self.tail]).sqrt() * limbs
        self.segment_spread = torch.tensor([DIRECTION[names[end].partition("_")[2]] for end in self.head])
        self.spread = terms.joint_spreads()
        parts = [name.removeprefix("left_").removeprefix("right_").rstrip("123") for name in JOINT_NAMES]
        self.steady = torch.tensor([ACCELERATION.get(part, ACCELERATION_REST) for part in parts])
        apart = farthest_points(body.v_template, DENSE)
        self.dense, self.coarse = Skin.of(body, apart), Skin.of(body, apart[:COARSE])
        self.soles = sole_vertices(body)
        self.marks = Skin.of(body, torch.cat([self.soles.flatten(), apart[:MARKS]]))
        self.normals = vertex_normals(body.v_template, faces)
        self.rim = Skin.of(body, torch.zeros(len(evidence.seen), 0, dtype=torch.long))  # until `match_outlines`
        self.snug = torch.ones(len(apart))  # until `look_for_wide_clothes`
        self.stands = torch.zeros(len(evidence.seen), 2)  # until `_world_costs` looks
        self.mark_trust = torch.tensor(joint_trust(evidence), dtype=f32) @ self.marks.weights.T

    def bones(self, state: State) -> Bones:
        """The skeleton of the state, its root not turned."""
        local = state.pose.unflatten(-1, (23, 3))
        turns = matrix_from_rotvec(torch.cat([local.new_zeros(len(local), 1, 3), local], 1))
        return Bones.of(self.body, state.betas, turns)

    def pose(self, state: State, bones: Bones | None = None) -> tuple[Tensor, Tensor]:
        """Landmarks [F,K,3] and joints [F,24,3] in camera axes, metres."""
        bones = bones or self.bones(state)
        points, joints = self.landmarks.placed(bones.betas, bones.joints, bones.turns, bones.transforms)
        return self._to_camera(state, bones, points), self._to_camera(state, bones, joints)

    def _to_camera(self, state: State, bones: Bones, points: Tensor) -> Tensor:
        return (points - bones.joints[0]) @ state.root.mT + state.place[:, None]

    def surface(self, state: State, skin: Skin, bones: Bones | None = None) -> tuple[Tensor, Tensor]:
        """The vertices of a `skin` as points [F,M,3] in camera axes, and its blended bones [F,M,3,4] for `facing`."""
        bones = bones or self.bones(state)
        points, blend = skin.posed(bones)
        return self._to_camera(state, bones, points), blend

    def facing(self, state: State, skin: Skin, blend: Tensor) -> Tensor:
        """Where the vertices of a `skin` face [F,M,3] in camera axes; without a gradient. `blend` as of `surface`."""
        normals = self.normals[skin.vertices][..., None]
        return (blend[..., :3].detach() @ normals)[..., 0] @ state.root.detach().mT

    def pixels(self, points: Tensor) -> Tensor:
        """Project camera-axes points [F,M,3]; what is nearer is brought to NEAREST."""
        z = points[..., 2:].clamp(min=NEAREST)
        return (points / z) @ self.K[:, :2].mT

    def to_world(self, state: State, points: Tensor, scale: Tensor | float) -> Tensor:
        """Camera-axes points [F,M,3] in metres in the world."""
        return points @ self.world.turn + scale * self.world.center[:, None]

    def match_outlines(self, state: State, outlines: terms.Outlines) -> None:
        """Give every contour point the vertex that lies nearest and faces the same way; kept until the next call."""
        with torch.no_grad():
            points, blend = self.surface(state, self.dense)
            normals, pixels = self.facing(state, self.dense, blend), self.pixels(points)
            rim = torch.zeros(outlines.weight.shape, dtype=torch.long)
            for i in torch.nonzero(outlines.known).flatten().tolist():
                away = torch.cdist(outlines.points[i], pixels[i]) / (0.03 * self.height[i])
                facing = outlines.normals[i] @ normals[i, :, :2].T
                rim[i] = (away.square() + 2 * (1 - facing)).argmin(1)
            self.rim, self.rim_snug = Skin.of(self.body, self.dense.vertices[rim]), self.snug[rim]

    @torch.no_grad()
    def look_for_wide_clothes(self, state: State, outlines: terms.Outlines) -> None:
        """See from a `state` that no outline has pulled where clothes stand wide of the legs; outlines tell less there.

        Of the trunk they tell on: of somebody who bends, landmarks alone place it as far inside the outline as a coat would.
        """
        self.match_outlines(state, outlines)
        off = outlines.points - self.pixels(self.surface(state, self.rim)[0])
        gaps = (off * outlines.normals).sum(-1) / self.height[:, None]
        used = (outlines.weight > 0) & outlines.known[:, None]
        snug = snugness(self.dense.template, self.rim.template[used], gaps[used])
        hips = self.body.joint_template[list(HIPS), 1].min()
        self.snug = torch.where(self.dense.template[:, 1] < hips, snug, 1.0)

    def bodies(self, state: State) -> np.ndarray:
        """All vertices [F,V,3] m float64 in camera axes."""
        with torch.no_grad():
            return self.surface(state, Skin.of(self.body, torch.arange(len(self.body.v_template))))[0].double().numpy()

    def directions(self, bias: Tensor) -> Tensor:
        """Unit directions [F,S,3] of the limbs in camera axes, as BlazePose guessed them less the `bias` of its depths.

        It sees a crop as if the camera looked straight at the person, so its axes are turned sideways to the line of sight.
        """
        x, y, z = self.guessed.unbind(-1)
        unbiased = torch.stack([x, y, z * bias[1].exp() + y * bias[0]], -1)
        return torch.nn.functional.normalize(unbiased @ self.sight.mT, dim=-1)

    def picture_cost(self, state: State, points: Tensor) -> Tensor:
        """Cost [F] of landmarks and limbs."""
        off = (self.pixels(points) - self.xy).norm(dim=-1) / (LANDMARK * self.height[:, None])
        cost = (self.weight * terms.geman_mcclure(off.square(), 5.0)).sum(1)
        along = torch.nn.functional.normalize(points[:, self.head] - points[:, self.tail], dim=-1)
        turned = (along - self.directions(state.bias)).square().sum(-1) / self.segment_spread**2
        return cost + DIRECTION_SHARE * (self.segment_weight * terms.geman_mcclure(turned, 3.0)).sum(1)

    def outline_cost(self, state: State, outlines: terms.Outlines, bones: Bones) -> Tensor:
        """Cost [F]: contour points off their vertices along the normal, vertices off the mask."""
        (rim, blend), count = self.surface(state, self.rim, bones), self.rim.vertices.shape[1]
        cloth = (self.rim.weights @ state.cloth)[..., None] * self.facing(state, self.rim, blend)
        inner = self.surface(state, self.coarse, bones)[0]
        pixels = self.pixels(torch.cat([rim + cloth, inner], 1))
        unit = OUTLINE * self.height[:, None]
        gap = (pixels[:, :count] - outlines.points) / unit[..., None]
        across = (gap * outlines.normals).sum(-1).square()
        off = terms.geman_mcclure(across + 0.1 * gap.square().sum(-1), 4.0)
        weight = outlines.weight * self.rim_snug
        cost = OUTLINE_SHARE * (weight * off).sum(1) / weight.sum(1).clamp(min=1)
        outside = terms.geman_mcclure((outlines.outside(pixels[:, count:]) / unit).square(), 4.0)
        return (cost + OUTSIDE_SHARE * outside.mean(1)) * outlines.known

    def size(self, betas: Tensor) -> Tensor:
        """Stature for `betas` over that of the mean body. Lengths are divided by it, so that being small never pays."""
        tall = self.body.joint_template[HEAD, 1] - self.body.joint_template[ANKLES[0], 1]
        grown = self.body.joint_dirs[HEAD, 1] - self.body.joint_dirs[ANKLES[0], 1]
        return 1 + (grown @ betas) / tall

    def motion_cost(self, state: State, joints: Tensor, scale: Tensor | None) -> Tensor:
        """Cost of joint accelerations, in the world if `scale` is given, else about the pelvis, and of turning."""
        if len(joints) < 3:
            return joints.new_zeros(())
        place = (joints - joints[:, :1]) @ self.world.turn if scale is None else self.to_world(state, joints, scale)
        jerk = terms.acceleration(place, self.world.times) / (self.steady[:, None] * self.size(state.betas))
        turn = terms.acceleration(state.pose, self.world.times) / TURNING
        cost = terms.geman_mcclure(jerk.square().sum(-1), 4.0).sum() + terms.geman_mcclure(turn.square(), 4.0).sum()
        speed = (state.pose[1:] - state.pose[:-1]) / (self.world.times[1:] - self.world.times[:-1])[:, None]
        return (cost + (speed / TURN_SPEED).square().sum()) / len(joints)

    def trusted(self, points: Tensor) -> Tensor:
        """How far [F,M] the marks' camera-axes `points` [F,M,3] are seen: in the picture, on a part whose landmarks are visible."""
        pixels = self.pixels(points.detach())
        return self.mark_trust * ((pixels > 0) & (pixels < self.world.size)).all(-1)

    def heights(self, state: State, points: Tensor, scale: Tensor, trust: Tensor) -> Tensor | None:
        """How high camera-axes points [F,M,3] are over the floor [F,M] m; None without a floor.

        A point that is not seen says how the body is posed, not where it stands: `trust` [F,M] is the share of its slope that
        place and scale get.
        """
        if self.world.floor is None:
            return None
        normal, offset = self.world.floor
        about = (points - state.place[:, None]) @ self.world.turn @ normal
        stand = self.to_world(state, state.place[:, None], scale) @ normal + scale * offset
        return about + trust * stand + (1 - trust) * stand.detach()

    def minimise(
        self,
        state: State,
        steps: int,
        outlines: terms.Outlines | None,
        in_world: bool,
        progress: Callable[[int, float], None],
    ) -> State:
        """Adam from `state` for `steps` steps; `in_world` adds feet, balance and, of a moving camera, the scale."""
        turn = torch.zeros(len(state.pose), 3, requires_grad=True)
        behind = (state.place[:, 2] < 0) & ~torch.tensor(self.evidence.seen)  # whom the camera does not see
        side = torch.where(behind, -1.0, 1.0)[:, None]
        depth = (side * state.place[:, 2:]).clamp(min=NEAREST)
        ray = torch.cat([side * state.place[:, :2] / depth, depth.log()], 1).requires_grad_()
        shared = (state.pose, state.betas, state.bias, state.cloth)
        pose, betas, bias, cloth = (part.clone().requires_grad_() for part in shared)
        first_scale = float(np.log(state.scale))
        log_scale = torch.tensor(first_scale, requires_grad=True)
        groups = [(turn, 0.02), (ray, 0.01), (pose, 0.03), (betas, 0.03), (bias, 0.01), (cloth, 0.001)]
        if in_world and self.world.moving:
            groups.append((log_scale, 0.004))
        adam = torch.optim.Adam([{"params": [p], "lr": lr} for p, lr in groups], betas=(0.9, 0.98))

        def rate(i: int) -> float:
            """Share of the learning rates at step `i`: ten steps up, then a cosine down."""
            return min(1.0, (i + 1) / 10) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * i / steps)))

        schedule = torch.optim.lr_scheduler.LambdaLR(adam, rate)
        for i in range(steps):
            z = side * ray[:, 2:].exp()
            scale = log_scale.exp()
            place = torch.cat([ray[:, :2] * z, z], 1)
            now = State(matrix_from_rotvec(turn) @ state.root, place, pose, betas, bias, cloth)
            if i % 25 == 0 and outlines is not None:
                self.match_outlines(now, outlines)
            bones = self.bones(now)
            points, joints = self.pose(now, bones)
            cost = self.picture_cost(now, points)
            if outlines is not None:
                cost = cost + self.outline_cost(now, outlines, bones)
            local = pose.unflatten(-1, (23, 3))
            total = cost.mean() + PRIOR_SHARE * terms.pose_prior(local, self.spread).mean()
            total = total + BETAS * betas.square().sum() + (bias / torch.tensor(BIAS)).square().sum()
            total = total + ((log_scale - first_scale) / self.world.scale_spread).square()
            total = total + ((cloth - CLOTH[0]) / CLOTH[1]).square().sum()
            total = total + self.motion_cost(now, joints, scale if in_world else None)
            for one in self._world_costs(now, bones, joints, scale, i / steps, i % 25 == 0) if in_world else ():
                total = total + one
            adam.zero_grad()
            total.backward()
            adam.step()
            schedule.step()
            if i % 25 == 24 or i == steps - 1:
                progress(i + 1, float(total.detach()))
        with torch.no_grad():
            z = side * ray[:, 2:].exp()
            place = torch.cat([ray[:, :2] * z, z], 1)
            root = matrix_from_rotvec(turn) @ state.root
            pose, betas, bias, cloth = (part.detach() for part in (pose, betas, bias, cloth))
        return State(root, place, pose, betas, bias, cloth, float(log_scale.detach().exp()))

    def _world_costs(
        self, now: State, bones: Bones, joints: Tensor, scale: Tensor, share: float, look: bool
    ) -> Iterator[Tensor]:
        """Costs of what holds in the world: feet, floor, flow and balance, after a `share` of the steps.

        `look`: see again which feet stand; that is kept until the next look.
        """
        loose, world = loosen(share), self.world
        marks, size, count = self.surface(now, self.marks, bones)[0], self.size(now.betas), self.soles.numel()
        feet = self.to_world(now, marks[:, :count], scale).unflatten(1, self.soles.shape)
        trust = self.trusted(marks)
        high = self.heights(now, marks, scale, trust)
        low = None if high is None else high[:, :count].unflatten(1, self.soles.shape)
        if look:
            stands = stance(feet.detach(), None if low is None else low.detach(), world.times, loose)
            self.stands = stands * trust[:, :count].unflatten(1, self.soles.shape).mean(-1)
        yield slide_cost(feet, self.stands, size)
        if high is not None and low is not None:
            yield floor_cost(low, high, self.stands, size, loose)
        if world.motion is not None:
            pixels, chosen = self.pixels(marks[:, count:]), self.marks.vertices[count:].numpy()
            yield world.motion.cost(pixels, self.height, chosen, partial(self.bodies, now), share)
        placed = self.to_world(now, joints, scale)
        yield balance_cost(placed, self.stands, world.times, world.up, world.up_spread, size)
