"""Two avatars in one scene.

python examples/two_people.py work/dance/default work/kitchen/default/export/avatar.npz two.png
"""

import sys

import numpy as np

import hugs


def main(run: str, other: str, out: str) -> None:
    """Draw the middle frame of a run with a second person, who does the same beside the first on the same floor."""
    first, second = hugs.load(run), hugs.load(other)
    clip, floor = first.motions["clip"], first.floor
    assert floor is not None, "the folder of a run has a floor"
    middle = len(clip) // 2
    body_pose, orient, transl = clip[middle][:3]
    person = first.pose(body_pose, orient, transl)
    beside = transl + 0.9 * np.cross(floor.up, floor.ahead)  # m to the left of who looks ahead
    heights = (second.pose(body_pose, orient, beside).means - floor.point) @ floor.up
    guest = second.pose(body_pose, orient, beside - np.percentile(heights, 0.5) * floor.up)  # feet on the floor
    picture = hugs.draw([person, guest], first.cameras[middle], first.scene, light=first.light)
    hugs.write_image(out, picture.image)


if __name__ == "__main__":
    main(*sys.argv[1:])
