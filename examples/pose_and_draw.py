"""Pose an avatar and draw it.

python examples/pose_and_draw.py work/dance/default pose.png
"""

import sys

import numpy as np

import hugs


def main(path: str, out: str) -> None:
    """Draw the avatar of a run's folder, or of an avatar.npz, with its arms down."""
    avatar = hugs.load(path)
    body_pose = np.zeros((23, 3))  # SMPL's: 23 joints, rotation vectors in radians
    for name, turn in (("left_shoulder", -1.2), ("right_shoulder", 1.2)):
        body_pose[hugs.JOINT_NAMES.index(name) - 1, 2] = turn  # about z, the way that the T-pose faces
    person = avatar.pose(body_pose)
    hips = person.joints[0]
    camera = hugs.camera(eye=hips + [0, 0, 3], target=hips)
    image, alpha, depth = hugs.draw(person, camera, background=1.0)
    hugs.write_image(out, image)
    print(f"{avatar}\n{person}\n{alpha.mean():.0%} of the picture is covered, {depth[alpha > 0.9].mean():.2f} m away")


if __name__ == "__main__":
    main(*sys.argv[1:])
