"""What a GLB says, read by the rules of glTF and not with our reader: values, joints in a motion, skinned points."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stages.formats.exchange.glb import Glb

KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


def array(glb: Glb, number: int) -> np.ndarray:
    """An accessor's values."""
    accessor = glb.content["accessors"][number]
    view = glb.content["bufferViews"][accessor["bufferView"]]
    columns, kind = KINDS[accessor["type"]], TYPES[accessor["componentType"]]
    values = np.frombuffer(glb.data, kind, accessor["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    return values / np.iinfo(kind).max if accessor.get("normalized") else values


def world_of(glb: Glb, pose: int | None = None) -> dict[int, np.ndarray]:
    """Where each node stands, [4,4] by number: at rest, or at key `pose` of the first motion."""
    nodes, local = glb.content["nodes"], {}
    parts = [{"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]} | node for node in nodes]
    for channel in glb.content["animations"][0]["channels"] if pose is not None else ():
        values = array(glb, glb.content["animations"][0]["samplers"][channel["sampler"]]["output"])
        parts[channel["target"]["node"]][channel["target"]["path"]] = values[pose]
    for number, part in enumerate(parts):
        local[number] = np.eye(4)
        local[number][:3, :3] = Rotation.from_quat(part["rotation"]).as_matrix() * part["scale"]
        local[number][:3, 3] = part["translation"]
    world: dict[int, np.ndarray] = {}

    def place(number: int, above: np.ndarray) -> None:
        world[number] = above @ local[number]
        for child in nodes[number].get("children", ()):
            place(child, world[number])

    for number in glb.content["scenes"][0]["nodes"]:
        place(number, np.eye(4))
    return world


def skinned(glb: Glb, pose: int, mesh: int = 0) -> np.ndarray:
    """The points [N,3] of a mesh at key `pose` of the first motion."""
    attributes, skin = glb.content["meshes"][mesh]["primitives"][0]["attributes"], glb.content["skins"][0]
    binds = array(glb, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    world, blend = world_of(glb, pose), 0
    bones = np.stack([world[node] for node in skin["joints"]]) @ binds
    for i in range(8):
        if f"JOINTS_{i // 4}" in attributes:
            joint = array(glb, attributes[f"JOINTS_{i // 4}"])[:, i % 4]
            blend = blend + bones[joint] * array(glb, attributes[f"WEIGHTS_{i // 4}"])[:, i % 4, None, None]
    points = array(glb, attributes["POSITION"])
    return (blend[:, :3, :3] @ points[..., None])[..., 0] + blend[:, :3, 3]
