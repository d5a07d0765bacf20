"""A camera path of your own around a person in their scene.

python examples/camera_path.py work/dance/default pictures/
"""

import sys
from pathlib import Path

import numpy as np

import hugs


def main(run: str, out: str, count: int = 24) -> None:
    """Write pictures of the clip's middle frame from an arc of 60 degrees, as numbered .png files."""
    avatar = hugs.load(run)
    clip, floor = avatar.motions["clip"], avatar.floor
    assert floor is not None, "the folder of a run has a floor"
    person = avatar.pose(*clip[len(clip) // 2])
    hips, left = person.joints[0], np.cross(floor.up, floor.ahead)  # axes of the floor: up, ahead, left
    path = []
    for angle in np.radians(np.linspace(-30, 30, count)):
        eye = hips + 0.3 * floor.up + 3 * (np.cos(angle) * floor.ahead + np.sin(angle) * left)
        path.append(hugs.camera(eye, hips, floor.up, focal=600, width=480, height=640))
    images = hugs.draw(person, path, avatar.scene, light=avatar.light).image  # one picture a camera
    Path(out).mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        hugs.write_image(Path(out) / f"{number:03d}.png", image)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
