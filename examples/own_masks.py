"""A run with masks of another program, here of OpenCV's GrabCut.

python examples/own_masks.py dance/ masks/
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import hugs


def main(clip: str, out: str) -> None:
    """Write masks, and run the pipeline with them."""
    write_masks(clip, out)
    avatar = hugs.run(clip, masks=out, progress=tell)
    print(avatar)


def write_masks(clip: str, out: str) -> None:
    """Write a mask for each picture of a folder, and show some as outlines.png.

    Whatever finds a person in a picture may take the place of `person_in`.
    """
    masks, shown = Path(out), []
    masks.mkdir(exist_ok=True)
    for file in sorted(Path(clip).glob("*.png")):
        picture = cv2.imread(str(file))
        assert picture is not None, f"{file} is no picture"
        found = person_in(picture)
        cv2.imwrite(str(masks / file.name), np.uint8(255) * found)  # by the name of its picture; white is the person
        shown.append(np.where(found[..., None], picture, picture // 4))
    cv2.imwrite("outlines.png", np.concatenate(shown[:: len(shown) // 4 + 1], axis=1))


def person_in(picture: np.ndarray) -> np.ndarray:
    """Mask [H,W] bool of what differs, in a picture [H,W,3] uint8, from its rim: the person fills most of the middle."""
    height, width = picture.shape[:2]
    middle = (width // 6, height // 20, width * 2 // 3, height * 9 // 10)
    mask, near, far = np.zeros((height, width), np.uint8), np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(picture, mask, middle, near, far, 5, cv2.GC_INIT_WITH_RECT)
    return np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD))


def tell(now: hugs.Progress) -> None:
    """Print which stages are there."""
    if now.state in ("cached", "done"):
        print(now.stage, now.state)


if __name__ == "__main__":
    main(*sys.argv[1:3])
