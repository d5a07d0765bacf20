"""avatar.vrm: the textured mesh as VRM 1.0, for the programs of virtual characters.

A GLB whose extension VRMC_vrm says which node is which bone of a person and what may be done with the file: y up, metres, facing
+z, the T-pose, the floor at height 0, no motions. https://github.com/vrm-c/vrm-specification
"""

from __future__ import annotations

from pathlib import Path

from stages.formats.exchange.avatar_glb import add_figure, start, surface
from stages.formats.exchange.bone_names import Names, bone_names
from stages.formats.exchange.glb import Arrays, write_glb
from stages.formats.exchange.skeleton import skeleton_of
from stages.formats.exchange.vrm_meta import VrmMeta
from stages.records import Mesh, Rig

VRM = "VRMC_vrm"


def write_avatar_vrm(path: Path, rig: Rig, mesh: Mesh, meta: VrmMeta, names: Names = "vrm", floor: float = 0.0) -> None:
    """Write the avatar; the same avatar makes the same bytes. The floor of the T-pose is at the height `floor` m of the rig."""
    arrays, content = Arrays(), start("avatar")
    stand = {"name": "stand", "translation": [0.0, -floor, 0.0]}
    first = add_figure(content, arrays, "body", skeleton_of(rig, names), surface(content, mesh, arrays), stand)
    bones = {bone: {"node": first + joint} for joint, bone in enumerate(bone_names("vrm"))}
    about = {"specVersion": "1.0", "meta": meta.as_written(), "humanoid": {"humanBones": bones}}
    write_glb(path, content | {"extensionsUsed": [VRM], "extensions": {VRM: about}}, arrays)
