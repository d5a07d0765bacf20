"""Where Blender puts the bones of a .bvh, for a Python that has bpy: `python bvh_in_blender.py motion.bvh`.

Prints JSON: the place of each bone's head in each frame, m, y up as in the file.
"""

import json
import sys

import bpy


def main(path: str) -> None:
    """Import with Blender's own settings, play, print."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_anim.bvh(filepath=path, update_scene_fps=True, update_scene_duration=True)
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    first, last = (round(frame) for frame in armature.animation_data.action.frame_range)
    found = {bone.name: [] for bone in armature.data.bones}
    for frame in range(first, last + 1):
        bpy.context.scene.frame_set(frame)
        for bone in armature.pose.bones:
            x, y, z = armature.matrix_world @ bone.head
            found[bone.name].append([x, z, -y])
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
