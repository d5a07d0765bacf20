"""Train on arrays of your own, from whatever gives cameras and body poses.

python examples/train_on_arrays.py arrays.npz mine/
"""

import sys

import numpy as np

import hugs

NAMES = ("images", "masks", "viewmats", "Ks", "body_pose", "global_orient", "transl", "points", "colors")


def main(file: str, out: str) -> None:
    """Train on the arrays of a file, which are those of `help(hugs.train)` by name; draw the first frame as frame.png."""
    arrays = np.load(file)
    given = {name: arrays[name] for name in NAMES}
    result = hugs.train(**given, settings={"steps": 400})
    hugs.save(result, out)

    _, poses = result.people[0]  # refined while it trained
    avatar, scene = hugs.load(f"{out}/avatar.npz"), hugs.load_scene(f"{out}/scene.npz")
    person = avatar.pose(poses.body_pose[0], poses.global_orient[0], poses.transl[0])
    count, height, width = given["images"].shape[:3]
    camera = hugs.Camera.of(given["viewmats"][0], given["Ks"][0], width, height)
    hugs.write_image(f"{out}/frame.png", hugs.draw(person, camera, scene).image)
    print(f"{count} frames, held out {result.curve[-1]['psnr']} dB: {out}/frame.png")


if __name__ == "__main__":
    main(*sys.argv[1:3])
