"""What the packages exchange: plain arrays with names, shapes and units. No files, no tensors, no mathematics."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from stages.gestures import Face, Fingers, HandsFace

BETAS = 10
SH_C0 = 0.5 / np.sqrt(np.pi).item()  # a colour is 0.5 + SH_C0 sh0 + higher terms
JOINTS = 24
JOINT_NAMES = tuple(
    """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot
    neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist
    left_hand right_hand""".split()
)


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras of one clip, all of one size.

    `names` [C] str are frame names without suffix; `viewmats` [C,4,4] float64 are camera_from_world with OpenCV axes (x right, y
    down, z forward), in the units of the file they came from (SfM units in sfm/cameras.npz); `Ks` [C,3,3] float64 in px, the
    centre of the first pixel at (0.5, 0.5).
    """

    names: tuple[str, ...]
    viewmats: np.ndarray
    Ks: np.ndarray
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.names)

    @property
    def centers(self) -> np.ndarray:
        """Camera positions in the world [C,3]."""
        rotation = self.viewmats[:, :3, :3]
        return -(rotation.mT @ self.viewmats[:, :3, 3:])[..., 0]


@dataclass(frozen=True)
class SeenLandmarks:
    """BlazePose's 33 landmarks of a person in a frame: where they are, `xy` [33,2] px.

    `visibility` [33] is the probability that one is in the picture and not hidden; `world` [33,3] m from the hips' middle, x
    right, y down, z away from the camera.
    """

    xy: np.ndarray
    visibility: np.ndarray
    world: np.ndarray


@dataclass(frozen=True)
class BodyPoses:
    """SMPL parameters of F frames: X_world = SMPL(global_orient, body_pose, betas) + transl, in metres.

    `betas` [10]; rotation vectors `global_orient` [F,3], `body_pose` [F,69], rad; `transl` [F,3] m; `confidence` [F], 0 (do not
    train on it) to 1; if known `hands` [F,2,15,3] rad, `face` [F,K]. The world's axes are SfM's, its unit `world_from_sfm` m.
    """

    names: tuple[str, ...]
    betas: np.ndarray
    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    confidence: np.ndarray
    world_from_sfm: float = 1.0
    hands: np.ndarray | None = None
    face: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class BodyModel:
    """SMPL-format body of V vertices: metres, y up, facing +z, T-pose, its left hand at +x; float32.

    `v_template` [V,3]; `faces` [T,3] int32; `shapedirs` [V,3,10] m per unit of beta; `posedirs` [V,3,207] m per entry of (R - I),
    zero where the body has none; `J_regressor` [24,V]; `lbs_weights` [V,24], rows sum to 1; `parents` [24], the root's is -1.
    `keypoint_regressor` [K,V] with `keypoint_names`, and `fingers`, where the file has them.
    """

    v_template: np.ndarray
    faces: np.ndarray
    shapedirs: np.ndarray
    posedirs: np.ndarray
    J_regressor: np.ndarray
    lbs_weights: np.ndarray
    parents: np.ndarray
    keypoint_regressor: np.ndarray | None = None
    keypoint_names: tuple[str, ...] | None = None
    fingers: HandsFace | None = None
    name: str = ""

    def sized(self, factor: float) -> BodyModel:
        """The same body `factor` times as large."""
        parts = {name: getattr(self, name) * np.float32(factor) for name in ("v_template", "shapedirs", "posedirs")}
        return replace(self, fingers=self.fingers and self.fingers.sized(factor), **parts)

    def landmark_regressor(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and matrix [K,V]: landmarks = matrix @ vertices, on posed vertices too.

        The stored keypoints (nose, left_ear, left_shoulder, ..., left_heel, left_big_toe), or where the file has none
        the model's own limb joints (left_shoulder ... left_ankle, left_foot). Vertex ids mean nothing across models.
        """
        if self.keypoint_regressor is not None and self.keypoint_names is not None:
            return self.keypoint_names, self.keypoint_regressor
        parts = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
        rows = [i for i, name in enumerate(JOINT_NAMES) if name.partition("_")[2] in parts]
        return tuple(JOINT_NAMES[i] for i in rows), self.J_regressor[rows]


@dataclass(frozen=True)
class Clothes:
    """K bones of clothes and hair, after the skeleton's 24 in the weights of an avatar; see `avatar.effects.clothing`.

    centres[K,3] m at rest; carriers[K,24]: the share of each of the skeleton's bones that carries it, where a leg pushes it;
    what no leg pushes hangs from the upright pelvis. Before it is carried it swings: swings[K,6,1+Q], for 1 and Q features
    of the pose = (body_pose - mean[69]) @ axes[69,Q], held within low[Q] and high[Q]; where one is beyond, all fade, to 0 at
    half of high - low. Of the six of a swing three are a turn in 0.3 rad, three a shift in 0.05 m.
    """

    swings: np.ndarray
    centres: np.ndarray
    carriers: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def hang_on(self) -> np.ndarray:
        """The joint [K] that carries most of each bone: its parent where bones are a tree."""
        return np.asarray(self.carriers).argmax(1)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays as the file names them."""
        return {f"clothes_{f.name}": np.asarray(getattr(self, f.name)) for f in fields(self)}

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True)
class Ground:
    """The floor on which a person stood, a plane in the world of their clip.

    `point` [3] m lies on it, below where they stood in the middle of the clip; `up` [3] is its normal and `ahead` [3] the way
    they looked there, both of length 1 and square to each other. `metres` per SfM unit. `height_error` m at `point` and
    `tilt_error` rad are one standard deviation; `points`: how many parts of the scene lie in it, 0 where the bodies alone tell
    it; `how` it was found, in words.
    """

    point: np.ndarray
    up: np.ndarray
    ahead: np.ndarray
    metres: float
    height_error: float
    tilt_error: float
    points: int
    how: str

    @property
    def turn(self) -> np.ndarray:
        """Rotation [3,3] from the frame of motions (y up, z ahead, x to the left) to the world."""
        return np.stack([np.cross(self.up, self.ahead), self.up, self.ahead], 1)


@dataclass(frozen=True)
class Scene:
    """N Gaussians in the world frame, metres.

    means[N,3], quats[N,4] (w x y z, unit), scales[N,3] > 0, opacities[N] in 0..1, sh0[N,3], shN[N,K-1,3]
    with K = (degree+1)^2; colour = 0.5 + SH_C0 sh0 + higher terms. `antialias`: they were learned with opacities
    lowered as the screen's blur widens a Gaussian (Mip-Splatting, https://arxiv.org/abs/2311.16493); draw them so.
    `invented` bool[N]: no frame shows what these Gaussians do; None where their file does not say which.
    `said`: what the reader of their file left out, in sentences.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh0: np.ndarray
    shN: np.ndarray
    antialias: bool = field(default=False, kw_only=True)
    invented: np.ndarray | None = field(default=None, kw_only=True)
    said: tuple[str, ...] = field(default=(), kw_only=True)

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Avatar(Scene):
    """N Gaussians in the canonical da-pose frame, metres, and all that posing them needs.

    lbs_weights[N,24+K] (rows sum to 1), joints[24,3] rest joints at `betas`, parents[24] (root -1), betas[10], canonical_pose[69]
    axis-angle of the pose in which the Gaussians stand; K: the bones of `clothes`, 0 with None. `casters` cast the shadow:
    middles [24,3] m and covariances [24,3,3] m^2 of the body's parts at rest; `normals` [N,3] are those of the surface on which
    Gaussians hang; both None in files of before 0.3.0 and of other programs. No `fingers` and `face` where the body has none.
    """

    lbs_weights: np.ndarray
    joints: np.ndarray
    parents: np.ndarray
    betas: np.ndarray
    canonical_pose: np.ndarray
    clothes: Clothes | None = field(default=None, kw_only=True)
    casters: tuple[np.ndarray, np.ndarray] | None = field(default=None, kw_only=True)
    fingers: Fingers | None = field(default=None, kw_only=True)
    face: Face | None = field(default=None, kw_only=True)
    normals: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def limb_weights(self) -> np.ndarray:
        """Skinning weights [N,24] on the skeleton alone: a bone of clothes counts as the joints that carry it."""
        own, worn = np.split(np.asarray(self.lbs_weights), [JOINTS], axis=1)
        return own if self.clothes is None else own + worn @ np.asarray(self.clothes.carriers)


@dataclass(frozen=True)
class Slopes:
    """How the skinning weights of C Gaussians of cloth change over it, by which they grow where bones draw it wide.

    `rows` [C] of theirs among all; `bones` [C,M] uint8 are those whose weight changes most, the steepest first; `slopes`
    [C,M,3] in 1/m, in the T-pose: a bone that takes the Gaussian elsewhere than the others do draws it by that times its slope.
    """

    rows: np.ndarray
    bones: np.ndarray
    slopes: np.ndarray


@dataclass(frozen=True)
class Rig(Scene):
    """An avatar as engines skin it: N Gaussians in the T-pose, metres, y up, facing +z, four bones each, or eight.

    A pose moves a Gaussian by the sum of weight x transform of its bones; at rest all transforms are the identity, and bone k
    turns about joints[k]. joints[24,3] m, named by JOINT_NAMES; parents[24] (root -1); bones[N,4] uint8, the heaviest first;
    weights[N,4] uint8, a row adds up to 255; kept[N]: the share of all its weights that the four have; bones8[N,8] and
    words8[N,8] uint16, rows adding up to 65535, for who skins with eight, with finger bones after all others; facing[N,3] unit,
    the direction in which each is lit; betas[10]. From 24 on bones are those of `clothes`, if any, as an Avatar's; of what is
    cloth there are `slopes`. Where there are `fingers`, as an Avatar's, finger_joints[40,3] m are where the bones of FINGER_NAMES
    begin, as hands lie in the avatar, then tips.
    """

    joints: np.ndarray
    parents: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    kept: np.ndarray
    bones8: np.ndarray
    words8: np.ndarray
    facing: np.ndarray
    betas: np.ndarray
    clothes: Clothes | None = field(default=None, kw_only=True)
    slopes: Slopes | None = field(default=None, kw_only=True)
    fingers: Fingers | None = field(default=None, kw_only=True)
    finger_joints: np.ndarray | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Mesh:
    """A skinned, textured surface in a rig's T-pose: V vertices, T triangles, counter-clockwise from outside.

    `vertices` [V,3] m, `normals` [V,3] unit, `faces` [T,3] int32; `uvs` [V,2] are places in `texture` [S,S,3] uint8, as shown on
    a display, from its upper left corner (0, 0) to its lower right one (1, 1). `bones` [V,4] uint8 as a Rig's, the heaviest
    first, those of fingers after all others, `weights` [V,4] uint16, rows adding up to 65535. A vertex on a seam of the texture
    is there twice. `said`: what was left out, in words. `morphs` [K,V,3] m, where there is a face: how its shapes move it.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    texture: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    said: tuple[str, ...] = ()
    morphs: np.ndarray | None = None


@dataclass(frozen=True)
class Take:
    """What a rig does for a while: y up, on the floor and at the place where it stands in the T-pose.

    `times` [F] s, rising from 0; `rotations` [F,24,4] w x y z, unit, of each joint in its parent's axes, the root's in
    the world's; `pelvis` [F,3] m, where the root joint is. Between two poses turns are slerped, places linear.
    `hands` [F,2,15,3] rad, as FINGER_NAMES, where fingers move. As an avatar performs it there are `clothes` [F,K,7], with the
    bones of clothes: their turns, w x y z, and places, m, in the axes of the joint they hang on; and `fingers` [F,30,4], turns of
    finger bones in the axes of the bone above, from where they lie in the avatar.
    """

    name: str
    times: np.ndarray
    rotations: np.ndarray
    pelvis: np.ndarray
    hands: np.ndarray | None = None
    clothes: np.ndarray | None = None
    fingers: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True)
class Effects:
    """Effects as learned from a clip; None if off.

    Shadows: `light` [3], the direction towards the light in the world, of length 1; `darkness`, the share of all light that comes
    from there; `softness` of edges in m; `density`, the optical depth through a limb, and `size`, the share of its covariance
    that casts. Of the time between two frames `shutter` is the share in which the shutter is open, `readout` that in which the
    rows are read, negative from below. `shading` [8,3]: the log of the light on the person, a colour each, in spherical harmonics
    of degree 1 and 2 of the world's directions.
    """

    light: np.ndarray | None = None
    darkness: float | None = None
    softness: float | None = None
    density: float | None = None
    size: float | None = None
    shutter: float | None = None
    readout: float | None = None
    shading: np.ndarray | None = None

    def known(self) -> dict[str, np.ndarray]:
        """What is not None, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: np.asarray(value, np.float64) for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class Split:
    """Of C frames: `training` and `heldout` bool [C] (a frame may be neither), `moments` int [C], not falling.

    Frames of one moment show one pose, so what training learns of a pose holds for all of them. `rule` is a sentence.
    """

    training: np.ndarray
    heldout: np.ndarray
    moments: np.ndarray
    rule: str
