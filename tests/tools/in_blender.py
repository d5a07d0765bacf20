"""What Blender makes of an avatar.glb, for a Python that has bpy: `python in_blender.py avatar.glb truth.npz`.

`truth.npz` has, for each motion NAME, `NAME_frame`, and where our own skinning puts `NAME_body`, y up. Prints
JSON: the motions, the mean and largest distances in mm, and where each bone points.
"""

import json
import sys

import bpy
import numpy as np


def places(thing: bpy.types.Object) -> np.ndarray:
    """The vertices of an object as it is posed, y up as in glTF."""
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    flat = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", flat)
    world = np.array(thing.matrix_world)
    points = flat.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
    return points[:, [0, 2, 1]] * [1, 1, -1]


def main(glb: str, truth: str, fps: int = 30) -> None:
    """Import, play, measure."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = fps  # else the import rescales the motions
    bpy.ops.import_scene.gltf(filepath=glb)
    things = {thing.name: thing for thing in bpy.data.objects}
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    wanted, found = np.load(truth), {}
    for action in bpy.data.actions:
        armature.animation_data.action = action
        armature.animation_data.action_slot = action.slots[0]
        for track in armature.animation_data.nla_tracks:
            track.mute = True
        bpy.context.scene.frame_set(int(wanted[f"{action.name}_frame"]))
        away = {
            name: 1000 * np.linalg.norm(places(things[name]) - wanted[f"{action.name}_{name}"], axis=1)
            for name in ("body",)
        }
        found[action.name] = {name: [float(mm.mean()), float(mm.max())] for name, mm in away.items()}
    ways = {bone.name: bone.tail_local - bone.head_local for bone in armature.data.bones}
    bones = {name: [way.normalized()[0], way.normalized()[2], -way.normalized()[1]] for name, way in ways.items()}
    print("\n" + json.dumps({"motions": found, "bones": bones}))


if __name__ == "__main__":
    main(*sys.argv[1:3])
