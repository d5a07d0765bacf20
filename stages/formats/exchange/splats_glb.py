"""avatar_splats.glb: the avatar's Gaussians as points on its skeleton, with motions, in the extension KHR_gaussian_splatting.

https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos. Programs that know no Gaussians show points: their colour has the
opacity for its alpha, and `_SCALE` is kept by Blender for geometry nodes. One such name only: the importer of Blender 5.0 mixes
several up, in an order that changes from start to start. y is up, metres, the T-pose, as in avatar.glb. How clothes swing is
kept for hugs, and so is how hands rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.exchange.avatar_glb import add_figure, add_motions, start
from stages.formats.exchange.bone_names import Names
from stages.formats.exchange.glb import HINT, VERTICES, Arrays, Glb, write_glb
from stages.formats.exchange.skeleton import HANDS, skeleton_of
from stages.formats.splats import gathered
from stages.gestures import FINGER_NAMES
from stages.records import JOINTS, SH_C0, Avatar, Rig, Scene, Take

SPLATS = "KHR_gaussian_splatting"
FORMATS = (1, 2)  # of what stands under "hugs" in the file: without fingers, with them
POINTS = 0  # glTF's mode


def write_splats_glb(path: Path, rig: Rig, takes: Sequence[Take], names: Names = "smpl", floor: float = 0.0) -> None:
    """Write the avatar's Gaussians; the same avatar makes the same bytes. The floor of the T-pose is at the height `floor` m of the
    rig."""
    arrays, content, skeleton = Arrays(), start("avatar"), skeleton_of(rig, names)
    hugs = {"format": FORMATS[rig.fingers is not None], "betas": rig.betas.tolist(), "antialias": rig.antialias}
    content |= {"extensionsUsed": [SPLATS], "extras": {"hugs": hugs | _clothes(rig) | _fingers(rig)}}
    stand = {"name": "stand", "translation": [0.0, -floor, 0.0]}
    first = add_figure(content, arrays, "gaussians", skeleton, points(rig, arrays, _weights(rig, arrays)), stand)
    add_motions(content, arrays, skeleton, takes, first)
    write_glb(path, content, arrays)


def _clothes(rig: Rig) -> dict[str, Any]:
    """The clothes as lists, by name; nothing without them."""
    if rig.clothes is None:
        return {}
    return {"clothes": {name: np.asarray(values).tolist() for name, values in vars(rig.clothes).items()}}


def _fingers(rig: Rig) -> dict[str, Any]:
    """Joints, tips and shape of fingers as lists; nothing without them. Their weights are the file's own."""
    if rig.fingers is None:
        return {}
    return {"fingers": {name: np.asarray(getattr(rig.fingers, name)).tolist() for name in ("joints", "tips", "shape")}}


def points(splats: Scene, arrays: Arrays, weights: dict[str, int]) -> dict[str, Any]:
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


def read_avatar_glb(path: Path) -> Avatar:
    """The avatar in avatar_splats.glb, or in an avatar.glb of before it was a mesh alone: in the T-pose, eight bones a Gaussian.

    StageError for any other GLB, and for values that cannot be.
    """
    glb = Glb(path)
    try:
        marks = glb.content["extras"]["hugs"]
        known = marks["format"] in FORMATS
    except (KeyError, TypeError, IndexError) as error:
        raise StageError(f"{path} holds no Gaussians of hugs", HINT, ["it has no extras.hugs"]) from error
    if not known:
        facts = [f"its format is {marks['format']!r}, this hugs knows {FORMATS[-1]} and before"]
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
    own = JOINTS + len(lists.get("clothes_centres", ()))
    fingers: dict[str, np.ndarray] = {
        f"fingers_{name}": np.asarray(values, np.float32) for name, values in marks.get("fingers", {}).items()
    }
    bones = own + (len(FINGER_NAMES) if fingers else 0)
    glb.budget.spend(4 * n * bones, f"weights of {n} Gaussians for {bones} bones")
    weights = np.zeros((n, bones), np.float32)
    for part in range(2):
        moved, words = column(f"JOINTS_{part}", 4, "u1"), column(f"WEIGHTS_{part}", 4, "<u2")
        for i in range(4):
            weights[np.arange(n), moved[:, i]] += words[:, i] / np.float32(65535)
    weights, shares = np.split(weights, [own], 1)
    if fingers:
        weights[:, HANDS] += shares.reshape(n, 2, -1).sum(2)
        rows = np.flatnonzero(shares.any(1))
        fingers |= {"fingers_rows": rows, "fingers_shares": shares[rows]}
    higher = [f"{SPLATS}:SH_DEGREE_{d}_COEF_{i}" for d in (1, 2, 3) for i in range(2 * d + 1)]
    rest = [column(name, 3) for name in higher if name in attributes]
    skin = glb.content["skins"][0]
    binds = glb.array(skin["inverseBindMatrices"], "<f4", 16)
    turns = binds.reshape(-1, 4, 4)[:, :3, :3]  # column by column: the joint's axes in the world's
    joints, parents = -(turns @ binds[:, 12:15, None])[..., 0], np.full(len(binds), -1, np.int32)
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
    return gathered(Avatar, arrays | lists | fingers, glb.path.name, HINT)
