"""Clips of a corner of a room, photographed by a camera that walks or turns, and stage sfm run on them."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stages import sfm
from stages.avatar.cameras import lens
from stages.avatar.cameras import pinhole as cameras
from stages.contract import Job
from stages.formats.images import write_image, write_mask
from tests.made.possible import impossible

WIDTH, HEIGHT, FOCAL, K1 = 320, 240, 300.0, 0.06


def texture(seed: int) -> np.ndarray:
    """A picture with detail at every scale, uint8 [1024,1024,3]."""
    rng = np.random.default_rng(seed)
    total = np.zeros((1024, 1024, 3), np.float32)
    for size in (16, 32, 64, 128, 256, 512):
        noise = rng.normal(size=(size, size, 3)).astype(np.float32)
        total += cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    total = (total - total.min()) / np.ptp(total)
    return (255 * total).astype(np.uint8)


WALLS = [  # plane n.x = d with its texture; a corner of a room with a screen in front
    (np.array([0.0, 0, 1]), 7.0, texture(0)),
    (np.array([0.0, 1, 0]), 1.5, texture(1)),
    (np.array([0.9, 0, 0.435]), 5.0, texture(2)),
]


def photograph(
    view: np.ndarray,
    focal: float = FOCAL,
    k: float | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    screens: Sequence[tuple[float, float, float, np.ndarray]] = (),
) -> np.ndarray:
    """The room through a SIMPLE_RADIAL lens, uint8 [H,W,3]; `k` is K1 by default; `size` is width and height.

    `screens` stand before the wall: at what z, from which x to which, and their texture.
    """
    width, height = size
    k = K1 if k is None else k
    y, x = np.mgrid[:height, :width] + 0.5
    ideal = lens.undistort(np.stack([x - width / 2, y - height / 2], -1) / focal, k)
    rays = np.concatenate([ideal, np.ones((height, width, 1))], -1) @ view[:3, :3]
    eye = cameras.camera_centers(view)
    image, nearest = np.zeros((height, width, 3), np.uint8), np.full((height, width), np.inf)
    walls = [(*wall, -np.inf, np.inf) for wall in WALLS]
    walls += [(np.array([0.0, 0, 1]), z, picture, low, high) for z, low, high, picture in screens]
    for normal, offset, picture, low, high in walls:
        distance = (offset - eye @ normal) / np.where(abs(rays @ normal) < 1e-9, 1e-9, rays @ normal)
        hit = eye + rays * distance[..., None]
        axes = np.delete(np.arange(3), abs(normal).argmax())
        grid = (hit[..., axes] * 40 % 1023).astype(np.float32)
        seen = cv2.remap(picture, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
        front = (distance > 0) & (distance < nearest) & (hit[..., 0] > low) & (hit[..., 0] < high)
        image[front], nearest[front] = seen[front], distance[front]
    return image


def write_clip(folder, views: np.ndarray, person: bool = True) -> None:
    """frames/ and masks/ of a clip of the room; the "person" is a patch that slides the other way."""
    for kind in ("frames/images", "masks/masks"):
        (folder / kind).mkdir(parents=True)
    listing, patch = [], texture(9)
    for i, view in enumerate(views):
        image, mask, left = photograph(view), np.zeros((HEIGHT, WIDTH), np.uint8), 190 - 6 * i
        if person:
            image[60:, left : left + 70] = patch[100 : 100 + HEIGHT - 60, 300:370]
            mask[60:, left : left + 70] = 255
        write_image(folder / "frames/images" / f"{3 * i:06d}.png", image)
        write_mask(folder / "masks/masks" / f"{3 * i:06d}.png", mask)
        listing.append({"name": f"{3 * i:06d}", "index": 3 * i, "time_s": i / 10, "sharpness": 1.0})
    facts = {"width": WIDTH, "height": HEIGHT, "frames": listing, "dropped": {}}
    facts["video"] = {"path": "clip.mp4", "frames": 3 * len(views)}
    (folder / "frames/frames.json").write_text(json.dumps(facts))
    (folder / "masks/masks.json").write_text(json.dumps({"source": "blazepose"}))


def walk(count: int, travel: float, turn: float = 6.0) -> np.ndarray:
    phase = np.linspace(-1, 1, count)
    views = np.tile(np.eye(4), (count, 1, 1))
    angles = np.stack([-turn * phase, 3 * np.sin(4 * phase), 0 * phase], 1)
    views[:, :3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    at = np.stack([travel * phase, 0.2 * travel * np.sin(3 * phase), 0.2 * travel * phase**2], 1)
    views[:, :3, 3] = -(views[:, :3, :3] @ at[..., None])[..., 0]
    return views


def run(folder, smpl_fit: Path | None = None, **settings) -> tuple[dict, list[dict]]:
    events: list[dict] = []
    out = folder / "out"
    out.mkdir()
    job = Job(out, emit=events.append)
    sfm.run(job, sfm.Params(**settings), frames=folder / "frames", masks=folder / "masks", smpl_fit=smpl_fit)
    facts = json.loads((out / "sfm.json").read_text())
    assert not impossible(facts, WIDTH, HEIGHT)
    return facts, events
