"""Does a clip of a camera that stands before nothing to hold on to end with an avatar; is one that moves a little called still?

    HUGS_CLIPS=FOLDER python -m tests.benchmarks.still WORK [--only dark curtain] [--pipeline ci]

The person of the path-traced clip `spin`, who turns once, by their true masks, 20 frames of 384x384 before a background of
each row of STANDS and MOVES. Those that stand go through `hugs run`, the others through stage sfm alone. A line for each
clip: what sfm says of the camera, PSNR of the person over white on held-out frames, or the error that ended it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from stages.formats.cameras import read_cameras
from stages.formats.images import read_mask
from stages.formats.video import decode, write_video
from tests.made.command import ROOT
from tests.made.rooms import texture

SIDE, EVERY, FPS = 384, 3, 4.0
NOISE = 1.5
Y, X = np.mgrid[:SIDE, :SIDE].astype(np.float32)
CLOTH = np.ascontiguousarray(texture(3)[..., 0].astype(np.float32))
FLOOR = np.where(Y < 290, 125, 95).astype(np.float32)
DUST = FLOOR - 30 * ((X % 61 < 2) & (Y % 53 < 2))
DOOR = FLOOR - 35 * ((X > 60) & (X < 133) & (Y > 60) & (Y < 290))
SOFT = cv2.GaussianBlur(CLOTH[:SIDE, :SIDE], (0, 0), 10)
SPOT = 70 + 90 * np.exp(-((X - 190) ** 2 + (Y - 120) ** 2) / 12000)
Shot = tuple[np.ndarray, np.ndarray]
"""A picture of the person, float32 [H,W,3], and their share of each pixel [H,W]."""


def before(wall: np.ndarray, shot: Shot, i: int) -> np.ndarray:
    """The person before a grey wall [H,W]."""
    picture, share = shot
    return picture * share[..., None] + wall[..., None] * (1 - share[..., None])


def dark(shot: Shot, i: int) -> np.ndarray:
    return 0.4 * before(12 + 0 * X, shot, i)


def curtain(shot: Shot, i: int) -> np.ndarray:
    wall = FLOOR.copy()
    wall[:270, 30:350] = (100 + 40 * np.sin(X / 6 + 2 * np.sin(i)))[:270, 30:350]
    return before(wall, shot, i)


def screen(shot: Shot, i: int) -> np.ndarray:
    wall = FLOOR.copy()
    wall[22:218, 62:322], wall[30:210, 70:314] = 15, CLOTH[40 * i : 40 * i + 180, :244]
    return before(wall, shot, i)


def virtual(shot: Shot, i: int) -> np.ndarray:
    """A picture in place of the room, which shows at the edges of a cut that changes from frame to frame."""
    wide = cv2.dilate(shot[1], np.ones((3 + 4 * (i % 3),) * 2, np.uint8))
    room = np.where(wide[..., None] > 0.5, before(FLOOR, shot, i), CLOTH[:SIDE, :SIDE, None])
    return room.astype(np.float32)


def fills(shot: Shot, i: int) -> np.ndarray:
    """So near that the picture cuts off shins and feet."""
    return warped(before(FLOOR, shot, i), 1.6, 0, 60)


def bumped(shot: Shot, i: int) -> np.ndarray:
    return warped(before(FLOOR, shot, i), 1, *((0, 0) if i < 14 else (8, -6)))


def zooms(wall: np.ndarray, sways: float, shot: Shot, i: int) -> np.ndarray:
    """In, on a tripod unless it `sways` by so many px."""
    return warped(before(wall, shot, i), 1 + 0.012 * i, sways * np.sin(1.3 * i), 0.8 * sways * np.cos(2.1 * i))


def zooms_out(wall: np.ndarray, shot: Shot, i: int) -> np.ndarray:
    return warped(before(wall, shot, i), 1 + 0.012 * (19 - i), 0, 0)


def zooms_and_stops(wall: np.ndarray, shot: Shot, i: int) -> np.ndarray:
    return warped(before(wall, shot, i), 1 + 0.02 * min(i, 9), 0, 0)


def sways(wall: np.ndarray, shot: Shot, i: int) -> np.ndarray:
    return warped(before(wall, shot, i), 1.05, 3 * np.sin(1.3 * i), 2.4 * np.cos(2.1 * i))


def warped(picture: np.ndarray, zoom: float, right: float, down: float) -> np.ndarray:
    """The picture zoomed about its middle, then moved by so many px."""
    middle = SIDE / 2 * (1 - zoom)
    way = np.array([[zoom, 0, middle + right], [0, zoom, middle + down]], np.float32)
    return cv2.warpAffine(picture, way, (SIDE, SIDE), borderMode=cv2.BORDER_REPLICATE)


Scene = Callable[[Shot, int], np.ndarray]
STANDS: dict[str, Scene] = {
    "blank": partial(before, 125 + 0 * X), "dark": dark, "out_of_focus": partial(before, SOFT), "curtain": curtain,
    "screen": screen, "virtual": virtual, "fills": fills, "bumped": bumped,
    "spotlight": partial(before, SPOT), "zooms": partial(zooms, CLOTH[:SIDE, :SIDE], 0), "zooms_dots": partial(zooms, DUST, 0),
    "zooms_door": partial(zooms, DOOR, 0), "zooms_out": partial(zooms_out, SOFT), "zooms_stops": partial(zooms_and_stops, DOOR),
}  # fmt: skip
MOVES: dict[str, Scene] = {
    "floor_sways": partial(sways, FLOOR), "dust_sways": partial(sways, DUST), "soft_sways": partial(sways, SOFT),
    "dust_zooms_sways": partial(zooms, DUST, 3),
}  # fmt: skip


def shots_of(clip: Path) -> list[Shot]:
    """Each third frame of the clip with its true mask."""
    found = []
    for i, _, picture in decode(clip / "video.mp4"):
        if i % EVERY == 0:
            mask = read_mask(clip / "masks" / f"{i:05d}.png")
            both = [cv2.resize(part, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for part in (picture, mask)]
            found.append((both[0].astype(np.float32), both[1].astype(np.float32) / 255))
    return found


def film(path: Path, scene: Scene, shots: list[Shot]) -> None:
    """Write the clip, with noise of a camera."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    pictures = (scene(shot, i) + rng.normal(0, NOISE, (SIDE, SIDE, 3)) for i, shot in enumerate(shots))
    write_video(path, (picture.clip(0, 255).round().astype(np.uint8) for picture in pictures), FPS)


def rate(video: Path, pipeline: str, stands: bool) -> str:
    """Run the clip, and say what came of it."""
    results, last = video.parent / "work" / video.stem / pipeline, [] if stands else ["sfm"]
    command = ["run", video, *last, "--pipeline", pipeline, "--work", video.parent / "work"]
    code = "from hugs_cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *map(str, command)], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        lines = [line for line in (done.stdout + done.stderr).splitlines() if "error" in line]
        return "refused: " + (lines or [done.stderr[-200:]])[0].strip()
    verdict = json.loads((results / "sfm" / "sfm.json").read_bytes())["verdict"]
    if not stands:
        return verdict
    held = json.loads((results / "evaluate" / "metrics.json").read_bytes())["heldout"]
    there = (results / "train" / "avatar.npz").is_file()
    focals = read_cameras(results / "sfm" / "cameras.npz").Ks[:, 0, 0]
    verdict += f", zooms to {focals.max() / focals.min():.2f}" if np.ptp(focals) else ""
    return f"{verdict}, {'an avatar' if there else 'NO avatar'}, {held['person_white']['psnr']:.1f} dB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", nargs="+", choices=[*STANDS, *MOVES], default=[*STANDS, *MOVES])
    parser.add_argument("--pipeline", default="ci")
    args = parser.parse_args()
    shots = shots_of(Path(os.environ["HUGS_CLIPS"]) / "spin")
    for name in args.only:
        video = args.work / f"{name}.mp4"
        film(video, {**STANDS, **MOVES}[name], shots)
        print(f"{name:14} {rate(video, args.pipeline, name in STANDS)}", flush=True)


if __name__ == "__main__":
    main()
