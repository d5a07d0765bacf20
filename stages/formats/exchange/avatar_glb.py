"""avatar.glb: the avatar as glTF, to be posed by any program that skins.

It holds the body's mesh, the skeleton, motions, and the Gaussians as points on the same skeleton with the extension
KHR_gaussian_splatting (https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos). Programs that know no
Gaussians show points: their colour has the opacity for its alpha, and `_SCALE` is kept by Blender for geometry nodes. One
such name only: the importer of Blender 5.0 mixes several up, in an order that changes from start to start.
y is up, metres, the T-pose, its soles at height 0 by the node above the skeleton; the inverse bind matrices are plain
steps, see `records.Rig`. Bones of clothes are joints like others, and motions move them as they swing; how they do is
kept for hugs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.exchange.bone_names import Names, bone_names
from stages.formats.exchange.glb import HINT, Arrays, Glb, write_glb
from stages.formats.splats import gathered
from stages.records import JOINTS, SH_C0, Avatar, Mesh, Rig, Scene, Take

SPLATS = "KHR_gaussian_splatting"
FORMAT = 1  # of what stands under "hugs" in the file
VERTICES, TRIANGLES = 34962, 34963  # glTF's targets of buffer views
POINTS = 0  # glTF's mode
Stand = tuple[list[float], list[float], float]
"""Where somebody stands: place [3] m, turn as x y z w, and how many times as large they are."""


def write_avatar_glb(
    path: Path, rig: Rig, mesh: Mesh, takes: Sequence[Take], names: Names = "smpl", floor: float = 0.0
) -> None:
    """Write the avatar; the same avatar makes the same bytes. The floor of the T-pose is at the height `floor` m of the rig."""
    arrays, content = Arrays(), start()
    hugs = {"format": FORMAT, "betas": rig.betas.tolist(), "antialias": rig.antialias}
    content["extras"] = {"hugs": hugs | _clothes(rig)}
    stand = {"name": "stand", "translation": [0.0, -floor, 0.0]}
    first = add_figure(content, arrays, rig, mesh, names, stand)
    content["scenes"][0]["name"] = "avatar"
    if takes:  # glTF knows no empty lists
        content["animations"] = [{"name": take.name, **animation(take, arrays, first)} for take in takes]
    write_glb(path, content, arrays)


def write_film_glb(
    path: Path, figures: Sequence[tuple[str, Rig, Mesh | None, Take, Stand]], scene: Scene | None
) -> None:
    """Write people with a motion each, one animation for all, and a scene of Gaussians; y up, floor at 0.

    Of each person: name, rig, mesh, motion on a floor at height 0, and where they stand.
    """
    arrays, content = Arrays(), start()
    content["scenes"][0]["name"] = "film"
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for name, rig, mesh, take, (place, quat, scale) in figures:
        stand = {"name": name, "translation": place, "rotation": quat, "scale": [scale] * 3}
        moves = animation(take, arrays, add_figure(content, arrays, rig, mesh, "smpl", stand))
        channels += [channel | {"sampler": channel["sampler"] + len(samplers)} for channel in moves["channels"]]
        samplers += moves["samplers"]
    content["animations"] = [{"name": "film", "samplers": samplers, "channels": channels}]
    if scene is not None:
        content["scenes"][0]["nodes"].append(len(content["nodes"]))
        content["nodes"].append({"name": "scene", "mesh": len(content["meshes"])})
        content["meshes"].append({"name": "scene", "primitives": [_points(scene, arrays, {})]})
    write_glb(path, content, arrays)


def start() -> dict[str, Any]:
    """The JSON of a file without figures."""
    return {
        "asset": {"version": "2.0", "generator": "hugs"},
        "extensionsUsed": [SPLATS],
        "scene": 0,
        "scenes": [{"nodes": []}],
        "nodes": [],
        "skins": [],
        "materials": [{"name": "skin", "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}],
        "meshes": [],
    }


def add_figure(
    content: dict[str, Any], arrays: Arrays, rig: Rig, mesh: Mesh | None, names: Names, stand: dict[str, Any]
) -> int:
    """Add mesh, Gaussians and skeleton of a person below the node `stand`; returns the node of the first joint."""
    nodes, meshes, skins = (content[kind] for kind in ("nodes", "meshes", "skins"))
    shapes = {} if mesh is None else {"body": _surface(mesh, arrays)}
    shapes["gaussians"] = _points(rig, arrays, _weights(rig, arrays))
    begin, skin = len(nodes), len(skins)
    first = begin + len(shapes) + 1
    nodes += [{"name": name, "mesh": len(meshes) + i, "skin": skin} for i, name in enumerate(shapes)]
    nodes += [stand | {"children": [first]}, *_joints(rig, bone_names(names), first)]
    places = _places(rig)
    joints = list(range(first, first + len(places)))
    skins.append({"inverseBindMatrices": arrays.add(_inverse_binds(places)), "skeleton": first, "joints": joints})
    meshes += [{"name": name, "primitives": [primitive]} for name, primitive in shapes.items()]
    content["scenes"][0]["nodes"] += range(begin, first)
    return first


def _joints(rig: Rig, names: Sequence[str], first: int) -> list[dict[str, Any]]:
    """A node a joint, at rest: its step from its parent."""
    nodes: list[dict[str, Any]] = []
    places, parents = _places(rig), np.asarray(rig.parents)
    if rig.clothes is not None:
        parents = np.concatenate([parents, rig.clothes.hang_on])
        names = [*names, *(f"cloth_{k:02d}" for k in range(len(rig.clothes)))]
    for joint, (name, parent) in enumerate(zip(names, parents.tolist(), strict=True)):
        step = places[joint] - (places[parent] if parent >= 0 else 0)
        nodes.append({"name": name, "translation": step.astype(float).tolist()})
        children = [first + int(child) for child in np.flatnonzero(parents == joint)]
        nodes[-1] |= {"children": children} if children else {}
    return nodes


def _places(rig: Rig) -> np.ndarray:
    """Where the joints are at rest, then the bones of clothes."""
    return rig.joints if rig.clothes is None else np.concatenate([rig.joints, rig.clothes.centres]).astype(np.float32)


def _clothes(rig: Rig) -> dict[str, Any]:
    """The clothes as lists, by name; nothing without them."""
    if rig.clothes is None:
        return {}
    return {"clothes": {name: np.asarray(values).tolist() for name, values in vars(rig.clothes).items()}}


def _inverse_binds(joints: np.ndarray) -> np.ndarray:
    """Rows [J,16] of the matrices, column by column."""
    matrices = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    matrices[:, 3, :3] = -joints
    return matrices.reshape(-1, 16)


def _surface(mesh: Mesh, arrays: Arrays) -> dict[str, Any]:
    narrow = np.uint16 if len(mesh.vertices) < 1 << 16 else np.uint32
    attributes = {
        "POSITION": arrays.add(mesh.vertices.astype(np.float32), bounds=True, target=VERTICES),
        "NORMAL": arrays.add(mesh.normals.astype(np.float32), target=VERTICES),
        "COLOR_0": arrays.add(_linear(mesh.colors, np.ones(len(mesh.colors))), scaled=True, target=VERTICES),
        "JOINTS_0": arrays.add(mesh.bones, target=VERTICES),
        "WEIGHTS_0": arrays.add(mesh.weights, scaled=True, target=VERTICES),
    }
    indices = arrays.add(mesh.faces.reshape(-1).astype(narrow), target=TRIANGLES)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _points(splats: Scene, arrays: Arrays, weights: dict[str, int]) -> dict[str, Any]:
    """A primitive of Gaussians, skinned where there are `weights`."""

    def add(values: np.ndarray) -> int:
        return arrays.add(values.astype(np.float32), target=VERTICES)

    shown = np.clip(0.5 + SH_C0 * splats.sh0, 0, 1)
    attributes = {
        "POSITION": arrays.add(splats.means.astype(np.float32), bounds=True, target=VERTICES),
        "COLOR_0": arrays.add(_linear(shown, splats.opacities), scaled=True, target=VERTICES),
        **weights,
        f"{SPLATS}:ROTATION": add(splats.quats[:, [1, 2, 3, 0]]),
        f"{SPLATS}:SCALE": add(splats.scales),
        f"{SPLATS}:OPACITY": add(splats.opacities),
        f"{SPLATS}:SH_DEGREE_0_COEF_0": add(splats.sh0),
    }
    for degree in range(1, 4):
        for i, row in enumerate(range(degree**2 - 1, (degree + 1) ** 2 - 1)):
            if row < splats.shN.shape[1]:
                attributes[f"{SPLATS}:SH_DEGREE_{degree}_COEF_{i}"] = add(splats.shN[:, row])
    attributes["_SCALE"] = attributes[f"{SPLATS}:SCALE"]
    kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    return {"mode": POINTS, "attributes": attributes, "extensions": {SPLATS: kind}}


def _weights(rig: Rig, arrays: Arrays) -> dict[str, int]:
    """Eight bones a Gaussian, in two sets: most programs skin with both, some with the first, whose four weigh most."""
    found = {}
    for i, four in enumerate((slice(0, 4), slice(4, 8))):
        found[f"JOINTS_{i}"] = arrays.add(rig.bones8[:, four], target=VERTICES)
        found[f"WEIGHTS_{i}"] = arrays.add(rig.words8[:, four], scaled=True, target=VERTICES)
    return found


def _linear(colors: np.ndarray, alphas: np.ndarray) -> np.ndarray:
    """Colours [N,3] of a display, and alphas [N], as glTF's, linear: uint16 [N,4]."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return np.rint(np.concatenate([linear, alphas[:, None]], 1) * 65535).astype(np.uint16)


def animation(take: Take, arrays: Arrays, first: int) -> dict[str, Any]:
    """Samplers and channels of a motion for the joints from node `first`."""
    times = arrays.add(take.times.astype(np.float32), bounds=True)
    samplers = [{"input": times, "output": arrays.add(take.pelvis.astype(np.float32))}]
    channels = [{"sampler": 0, "target": {"node": first, "path": "translation"}}]
    for joint in range(JOINTS):
        turns = take.rotations[:, joint, [1, 2, 3, 0]].astype(np.float32)
        channels.append({"sampler": len(samplers), "target": {"node": first + joint, "path": "rotation"}})
        samplers.append({"input": times, "output": arrays.add(turns)})
    for k in range(0 if take.clothes is None else take.clothes.shape[1]):
        moved = np.asarray(take.clothes)[:, k].astype(np.float32)
        for path, values in (("rotation", moved[:, [1, 2, 3, 0]]), ("translation", moved[:, 4:])):
            channels.append({"sampler": len(samplers), "target": {"node": first + JOINTS + k, "path": path}})
            samplers.append({"input": times, "output": arrays.add(np.ascontiguousarray(values))})
    return {"samplers": samplers, "channels": channels}


def read_avatar_glb(path: Path) -> Avatar:
    """The avatar in a .glb that `write_avatar_glb` wrote: in the T-pose, with eight bones a Gaussian.

    StageError for any other GLB, and for values that cannot be.
    """
    glb = Glb(path)
    try:
        marks = glb.content["extras"]["hugs"]
        known = marks["format"] == FORMAT
    except (KeyError, TypeError, IndexError) as error:
        raise StageError(f"{path} is no avatar of hugs", HINT, ["it has no extras.hugs"]) from error
    if not known:
        facts = [f"its format is {marks['format']!r}, this hugs knows {FORMAT}"]
        raise StageError(f"{path} was made by another version of hugs", "update hugs", facts)
    try:
        return _avatar(glb, marks)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        raise StageError(f"{path} is damaged", HINT, [f"{type(error).__name__}: {error}"]) from error


def _avatar(glb: Glb, marks: dict[str, Any]) -> Avatar:
    primitives = [one for mesh in glb.content["meshes"] for one in mesh["primitives"]]
    marked = [one for one in primitives if SPLATS in one.get("extensions", {})]
    attributes = marked[0]["attributes"]

    def column(name: str, columns: int, kind: str = "<f4") -> np.ndarray:
        return glb.array(attributes[name], kind, columns)

    means = column("POSITION", 3)
    n = len(means)
    lists = {f"clothes_{name}": np.asarray(values, np.float32) for name, values in marks.get("clothes", {}).items()}
    bones = JOINTS + len(lists.get("clothes_centres", ()))
    glb.budget.spend(4 * n * bones, f"weights of {n} Gaussians for {bones} bones")
    weights = np.zeros((n, bones), np.float32)
    for part in range(2):
        moved, words = column(f"JOINTS_{part}", 4, "u1"), column(f"WEIGHTS_{part}", 4, "<u2")
        for i in range(4):
            weights[np.arange(n), moved[:, i]] += words[:, i] / np.float32(65535)
    higher = [f"{SPLATS}:SH_DEGREE_{d}_COEF_{i}" for d in (1, 2, 3) for i in range(2 * d + 1)]
    rest = [column(name, 3) for name in higher if name in attributes]
    skin = glb.content["skins"][0]
    binds = glb.array(skin["inverseBindMatrices"], "<f4", 16)
    joints, parents = -binds[:, 12:15], np.full(len(binds), -1, np.int32)
    places = {node: joint for joint, node in enumerate(skin["joints"])}
    for joint, node in enumerate(skin["joints"]):
        for child in glb.content["nodes"][node].get("children", ()):
            parents[places[child]] = joint
    arrays = {
        "means": means,
        "quats": column(f"{SPLATS}:ROTATION", 4)[:, [3, 0, 1, 2]],
        "scales": column(f"{SPLATS}:SCALE", 3),
        "opacities": column(f"{SPLATS}:OPACITY", 1)[:, 0],
        "sh0": column(f"{SPLATS}:SH_DEGREE_0_COEF_0", 3),
        "shN": np.stack(rest, 1) if rest else np.zeros((n, 0, 3), np.float32),
        "lbs_weights": weights,
        "joints": joints[:JOINTS],
        "parents": parents[:JOINTS],
        "betas": np.asarray(marks["betas"], np.float32),
        "canonical_pose": np.zeros(3 * (JOINTS - 1), np.float32),
        "antialias": np.asarray(bool(marks["antialias"])),
    }
    return gathered(Avatar, arrays | lists, glb.path.name, HINT)
