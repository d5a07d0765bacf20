"""avatar.glb: the person as a textured mesh on a skeleton, with motions, for any program that reads glTF.

y is up, metres, facing +z, the T-pose, its soles at height 0 by the node `stand` above the skeleton. It holds mesh, texture,
material, skeleton and motions, and no Gaussians: those are in avatar_splats.glb, see `splats_glb`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.formats.exchange.bone_names import Names
from stages.formats.exchange.glb import TRIANGLES, VERTICES, Arrays, write_glb
from stages.formats.exchange.skeleton import Skeleton, skeleton_of
from stages.gestures import FACE_NAMES, face_names
from stages.records import Mesh, Rig, Take

JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
MOVED = 2e-4  # m: a vertex that a shape moves less stays
LINEAR, LINEAR_MIPMAPS, CLAMPED = 9729, 9987, 33071  # glTF's numbers


def write_avatar_glb(
    path: Path, rig: Rig, mesh: Mesh, takes: Sequence[Take], names: Names = "smpl", floor: float = 0.0
) -> None:
    """Write the avatar; the same avatar makes the same bytes. The floor of the T-pose is at the height `floor` m of the rig."""
    arrays, content, skeleton = Arrays(), start("avatar"), skeleton_of(rig, names)
    stand = {"name": "stand", "translation": [0.0, -floor, 0.0]}
    primitive = surface(content, mesh, arrays)
    first = add_figure(content, arrays, "body", skeleton, primitive, stand, list(targets_of(mesh)))
    add_motions(content, arrays, skeleton, takes, first)
    write_glb(path, content, arrays)


def start(name: str) -> dict[str, Any]:
    """The JSON of a file with a scene of that name, and nothing in it."""
    kinds = ("nodes", "meshes", "skins", "materials", "textures", "images", "samplers", "animations")
    asset = {"version": "2.0", "generator": "hugs"}
    return {"asset": asset, "scene": 0, "scenes": [{"name": name, "nodes": []}]} | {kind: [] for kind in kinds}


def add_figure(
    content: dict[str, Any],
    arrays: Arrays,
    name: str,
    skeleton: Skeleton,
    primitive: dict[str, Any],
    stand: dict[str, Any],
    shapes: Sequence[str] = (),
) -> int:
    """Add a skinned `primitive` as the mesh `name`, its skeleton below the node `stand`; returns the node of the first joint.

    `shapes` are the names of its targets.
    """
    nodes, begin = content["nodes"], len(content["nodes"])
    first = begin + 2
    nodes += [
        {"name": name, "mesh": len(content["meshes"]), "skin": len(content["skins"])},
        stand | {"children": [first]},
        *skeleton.nodes(first),
    ]
    joints = list(range(first, len(nodes)))
    binds = arrays.add(skeleton.inverse_binds())
    content["skins"].append({"inverseBindMatrices": binds, "skeleton": first, "joints": joints})
    content["meshes"].append({"name": name, "primitives": [primitive]})
    if shapes:
        content["meshes"][-1] |= {"weights": [0.0] * len(shapes), "extras": {"targetNames": list(shapes)}}
    content["scenes"][0]["nodes"] += [begin, begin + 1]
    return first


def add_motions(content: dict[str, Any], arrays: Arrays, skeleton: Skeleton, takes: Sequence[Take], first: int) -> None:
    """Add an animation a motion, of the skeleton from node `first`."""
    content["animations"] += [{"name": take.name, **skeleton.animation(take, arrays, first)} for take in takes]


def surface(content: dict[str, Any], mesh: Mesh, arrays: Arrays) -> dict[str, Any]:
    """The primitive of a mesh, whose material and texture go into `content`."""
    narrow = np.uint16 if len(mesh.vertices) < 1 << 16 else np.uint32
    attributes = {
        "POSITION": arrays.add(mesh.vertices.astype(np.float32), bounds=True, target=VERTICES),
        "NORMAL": arrays.add(mesh.normals.astype(np.float32), target=VERTICES),
        "TEXCOORD_0": arrays.add(mesh.uvs.astype(np.float32), target=VERTICES),
        "JOINTS_0": arrays.add(mesh.bones, target=VERTICES),
        "WEIGHTS_0": arrays.add(mesh.weights, scaled=True, target=VERTICES),
    }
    indices = arrays.add(mesh.faces.reshape(-1).astype(narrow), target=TRIANGLES)
    _, packed = cv2.imencode(".jpg", mesh.texture[..., ::-1], JPEG)
    number = len(content["images"])
    content["images"].append(
        {"name": "colours", "bufferView": arrays.add_bytes(packed.tobytes()), "mimeType": "image/jpeg"}
    )
    content["samplers"].append({"magFilter": LINEAR, "minFilter": LINEAR_MIPMAPS, "wrapS": CLAMPED, "wrapT": CLAMPED})
    content["textures"].append({"source": number, "sampler": number})
    look = {"baseColorTexture": {"index": number}, "metallicFactor": 0, "roughnessFactor": 1}
    content["materials"].append({"name": "person", "pbrMetallicRoughness": look})
    primitive = {"attributes": attributes, "indices": indices, "material": number}
    moved = targets_of(mesh).values()
    targets = [{"POSITION": arrays.add_few(shape, np.linalg.norm(shape, axis=1) > MOVED)} for shape in moved]
    return primitive | {"targets": targets} if targets else primitive


def targets_of(mesh: Mesh) -> dict[str, np.ndarray]:
    """The shapes of a mesh's face by name, as they move its vertices [V,3] m: all FACE_NAMES, since face trackers look for each of
    them, then those of the body's own that move some."""
    if mesh.morphs is None:
        return {}
    named = zip(face_names(len(mesh.morphs)), mesh.morphs, strict=True)
    return {name: shape for name, shape in named if name in FACE_NAMES or np.linalg.norm(shape, axis=1).max() > MOVED}
