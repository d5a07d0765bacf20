"""avatar.vrm: the textured mesh as VRM 1.0, for the programs of virtual characters.

A GLB whose extension VRMC_vrm says which node is which bone of a person and what may be done with the file: y up, metres, facing
+z, the T-pose, the floor at height 0, no motions. https://github.com/vrm-c/vrm-specification
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.formats.exchange.avatar_glb import add_figure, start, surface, targets_of
from stages.formats.exchange.bone_names import Names, bone_names, finger_names
from stages.formats.exchange.glb import Arrays, write_glb
from stages.formats.exchange.skeleton import Skeleton, skeleton_of
from stages.formats.exchange.vrm_meta import VrmMeta
from stages.formats.face_turns import TURNS
from stages.records import JOINT_NAMES, Mesh, Rig

VRM, HEAD = "VRMC_vrm", JOINT_NAMES.index("head")
PRESETS = {  # of VRM: of which shapes of the face each consists, and how much
    "aa": {"jawOpen": 0.6},
    "ih": {"jawOpen": 0.2, "mouthStretchLeft": 0.5, "mouthStretchRight": 0.5},
    "ou": {"jawOpen": 0.15, "mouthPucker": 0.9},
    "ee": {
        "jawOpen": 0.15,
        "mouthSmileLeft": 0.5,
        "mouthSmileRight": 0.5,
        "mouthStretchLeft": 0.3,
        "mouthStretchRight": 0.3,
    },
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.8},
    "blink": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "blinkLeft": {"eyeBlinkLeft": 1.0},
    "blinkRight": {"eyeBlinkRight": 1.0},
    "happy": {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "cheekSquintLeft": 0.4, "cheekSquintRight": 0.4},
    "sad": {"mouthFrownLeft": 0.8, "mouthFrownRight": 0.8, "browInnerUp": 0.7},
    "angry": {"browDownLeft": 0.9, "browDownRight": 0.9, "noseSneerLeft": 0.4, "noseSneerRight": 0.4},
    "surprised": {"browInnerUp": 0.8, "browOuterUpLeft": 0.8, "browOuterUpRight": 0.8, "jawOpen": 0.3},
    "lookUp": {"eyeLookUpLeft": 1.0, "eyeLookUpRight": 1.0},
    "lookDown": {"eyeLookDownLeft": 1.0, "eyeLookDownRight": 1.0},
    "lookLeft": {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    "lookRight": {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
    "relaxed": {"mouthSmileLeft": 0.3, "mouthSmileRight": 0.3, "eyeBlinkLeft": 0.25, "eyeBlinkRight": 0.25},
}
RANGES = {
    "HorizontalInner": "eyeLookIn",
    "HorizontalOuter": "eyeLookOut",
    "VerticalDown": "eyeLookDown",
    "VerticalUp": "eyeLookUp",
}
"""Of VRM's ways to look: the shape of each eye that is full where the eye turns as far as it goes."""


def write_avatar_vrm(path: Path, rig: Rig, mesh: Mesh, meta: VrmMeta, names: Names = "vrm", floor: float = 0.0) -> None:
    """Write the avatar; the same avatar makes the same bytes. The floor of the T-pose is at the height `floor` m of the rig."""
    arrays, content = Arrays(), start("avatar")
    stand = {"name": "stand", "translation": [0.0, -floor, 0.0]}
    skeleton, primitive, targets = skeleton_of(rig, names), surface(content, mesh, arrays), targets_of(mesh)
    first = add_figure(content, arrays, "body", skeleton, primitive, stand, list(targets))
    bones = {bone: {"node": first + joint} for joint, bone in enumerate(bone_names("vrm"))}
    if rig.finger_joints is not None:
        fingers = first + len(rig.joints) + (0 if rig.clothes is None else len(rig.clothes))
        bones |= {bone: {"node": fingers + k} for k, bone in enumerate(finger_names("vrm"))}
    about: dict[str, Any] = {"specVersion": "1.0", "meta": meta.as_written(), "humanoid": {"humanBones": bones}}
    if targets:
        about["expressions"] = expressions(first - 2, list(targets))
        if all(targets[f"{look}{side}"].any() for look in RANGES.values() for side in ("Left", "Right")):
            about["lookAt"] = look_at(mesh, targets, skeleton)
    write_glb(path, content | {"extensionsUsed": [VRM], "extensions": {VRM: about}}, arrays)


def expressions(node: int, targets: list[str]) -> dict[str, Any]:
    """VRM's expressions by the morph `targets` of the mesh at `node`: its presets, and each by its name, for face tracking."""

    def bound(shapes: dict[str, float]) -> dict[str, Any]:
        return {
            "morphTargetBinds": [
                {"node": node, "index": targets.index(name), "weight": weight} for name, weight in shapes.items()
            ]
        }

    presets = {name: bound(shapes) for name, shapes in PRESETS.items()}
    return {"preset": presets, "custom": {name: bound({name: 1.0}) for name in targets}}


def look_at(mesh: Mesh, targets: dict[str, np.ndarray], skeleton: Skeleton) -> dict[str, Any]:
    """How eyes follow a point: by the expressions lookUp and so on, seen from between the eyes, which move by `targets`."""
    shares = [np.linalg.norm(targets[f"eyeLookIn{side}"], axis=1) for side in ("Left", "Right")]
    eyes = np.mean([share @ mesh.vertices / share.sum() for share in shares], axis=0)
    ranges = {
        f"rangeMap{way}": {"inputMaxValue": abs(TURNS[f"{look}Left"][2]), "outputScale": 1.0}
        for way, look in RANGES.items()
    }
    offset = skeleton.turns[HEAD].T @ (eyes - skeleton.places[HEAD])
    return {"type": "expression", "offsetFromHeadBone": offset.tolist(), **ranges}
