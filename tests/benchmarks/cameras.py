"""What stage sfm says of cameras that are known: focal length with its error, lens, and whether the camera moved.

    python -m tests.benchmarks.cameras build/cameras --half setting [--clips wide_sideways still_crowd]

Each clip is drawn: a corner of a painted room with screens in it, through a lens, 480x360 px, 20 frames, a person's
patch masked. `--half setting` is for setting constants; `--half asked`, and `--half clean` with 40 cameras without any
lens, once per change of code. A line for each clip: the verdict, the focal length's error and twice its stated spread in
per cent, by how many px the lens found and the true one bend the corners differently, and seconds. Parallax is the angle
at which the ends of the path see the room's middle.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stages import sfm
from stages.avatar.cameras import lens
from stages.contract import Job, StageError
from stages.formats.images import write_image, write_mask
from tests.made.rooms import photograph, texture

WIDTH, HEIGHT, FRAMES, DEPTH = 480, 360, 20, 5.5
SCREENS = tuple(
    (z, x, x + 0.7, texture(30 + i)) for i, (z, x) in enumerate(((3.2, -1.5), (4.1, 0.2), (5.0, 1.3), (3.7, -0.6)))
)
STRIPS = 6
"""Bands of rows that a rolling shutter takes one after the other."""
NEAR, BENT = 5.0, 3.0
"""Per cent of the focal length, and px of the corners, that are near enough."""


@dataclass(frozen=True)
class Clip:
    """One clip: focal length in mm of a picture 36 mm wide, k of its lens, its path and parallax in degrees."""

    name: str
    half: str
    mm: float
    k: float
    path: str
    """sideways, forward, turn or still."""
    parallax: float = 0.0
    zoom: float = 1.0
    """By how much the focal length grows over the clip."""
    rolling: float = 0.0
    """Of the time between two frames that the last row comes after the first."""
    crowd: float = 0.0
    """Share of the picture, from above, covered by patches that sway."""

    @property
    def verdicts(self) -> tuple[str, ...]:
        """What stage sfm may say; with hardly any parallax a turn is as good an answer."""
        if self.path == "still":
            return ("static camera",)
        if self.path == "turn":
            return ("rotation only",)
        return ("moving", "rotation only") if self.parallax < 1 else ("moving",)


CLIPS = (
    Clip("wide_sideways", "setting", 24, -0.1, "sideways", 20),
    Clip("normal_sideways", "setting", 35, 0.0, "sideways", 8),
    Clip("tele_sideways", "setting", 85, 0.0, "sideways", 6),
    Clip("wide_forward", "setting", 26, 0.0, "forward", 10),
    Clip("little", "setting", 28, 0.0, "sideways", 0.3),
    Clip("one_degree", "setting", 35, 0.0, "sideways", 1.2),
    Clip("turn", "setting", 28, 0.0, "turn"),
    Clip("still_crowd", "setting", 35, 0.0, "still", crowd=0.6),
    Clip("rolling", "setting", 28, 0.0, "sideways", 10, rolling=0.4),
    Clip("zoom", "setting", 28, 0.0, "sideways", 10, zoom=1.3),
    Clip("wide_bent", "asked", 36, -0.3, "sideways", 15),
    Clip("pincushion", "asked", 45, 0.05, "sideways", 10),
    Clip("tele_forward", "asked", 70, 0.0, "forward", 12),
    Clip("phone", "asked", 28, 0.0, "sideways", 4),
    Clip("hardly", "asked", 35, 0.0, "sideways", 0.6),
    Clip("two_degrees", "asked", 28, 0.0, "sideways", 2),
    Clip("turn_tele", "asked", 50, 0.0, "turn"),
    Clip("still_crowd_wide", "asked", 24, 0.0, "still", crowd=0.5),
    Clip("rolling_crowd", "asked", 35, 0.0, "sideways", 12, rolling=0.3, crowd=0.3),
    Clip("zoom_out", "asked", 45, 0.0, "sideways", 12, zoom=0.8),
)


def clean(count: int = 40) -> tuple[Clip, ...]:
    """Clips of cameras without lens, zoom or shutter, at random (seed 0): is a lens made up on any of them?"""
    rng, clips = np.random.default_rng(0), []
    for i in range(count):
        mm, parallax = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in ((24, 85), (0.3, 20)))
        path = ("sideways", "forward", "sideways", "turn")[i % 4]
        clips.append(Clip(f"clean_{i:02}", "clean", mm, 0.0, path, 0.0 if path == "turn" else parallax))
    return tuple(clips)


CLIPS += clean()


def views_of(clip: Clip, at: np.ndarray) -> np.ndarray:
    """viewmats [N,4,4] at moments `at` [N] from -1 to 1, shaken as by a hand unless the camera stands."""
    views = np.tile(np.eye(4), (len(at), 1, 1))
    if clip.path == "still":
        return views
    reach = DEPTH * np.tan(np.radians(clip.parallax / 2))
    sway = np.stack([np.sin(3 * at), np.sin(4 * at + 1), np.sin(2.5 * at + 2)], 1)
    turn = np.array([24.0, 4, 2]) * sway if clip.path == "turn" else np.array([2.5, 1.5, 1.0]) * sway
    if clip.path == "sideways":
        turn[:, 0] += 0.5 * clip.parallax * at
    views[:, :3, :3] = Rotation.from_euler("yxz", turn, degrees=True).as_matrix()
    ways = {
        "sideways": np.stack([at, 0.15 * np.sin(3 * at), 0.1 * at**2], 1),
        "forward": np.stack([0.2 * np.sin(2 * at), 0.1 * np.sin(3 * at), at], 1),
        "turn": np.zeros((len(at), 3)),
    }
    views[:, :3, 3] = -(views[:, :3, :3] @ (reach * ways[clip.path])[..., None])[..., 0]
    return views


def draw(clip: Clip, folder: Path) -> None:
    """Write frames/ and masks/ of the clip."""
    for kind in ("frames/images", "masks/masks"):
        (folder / kind).mkdir(parents=True)
    at, cloth, listing = np.linspace(-1, 1, FRAMES), texture(9), []
    for i, moment in enumerate(at):
        focal = clip.mm / 36 * WIDTH * (1 + (clip.zoom - 1) * (moment + 1) / 2)
        strips = STRIPS if clip.rolling else 1
        late = clip.rolling * (np.arange(strips) + 0.5) / strips * (at[1] - at[0])
        shots = [photograph(view, focal, clip.k, (WIDTH, HEIGHT), SCREENS) for view in views_of(clip, moment + late)]
        image = np.concatenate([np.array_split(shot, strips)[j] for j, shot in enumerate(shots)])
        rng = np.random.default_rng(3)
        for y in range(0, round(clip.crowd * HEIGHT), 24):
            for x in range(0, WIDTH, 24):
                u, v = rng.uniform(0.5, 2.5, 2)
                left, top = int(300 * u + 9 * np.sin(v * i + u)), int(300 * v + 7 * np.sin(u * i))
                below = min(24, HEIGHT - y)
                image[y : y + below, x : x + 24] = cloth[top : top + below, left : left + 24]
        mask, person = np.zeros((HEIGHT, WIDTH), np.uint8), 260 - 4 * i
        image[90:, person : person + 90] = cloth[100 : 100 + HEIGHT - 90, 300:390]
        mask[90:, person : person + 90] = 255
        name = f"{3 * i:06d}"
        coded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        write_image(folder / f"frames/images/{name}.png", cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1].copy())
        write_mask(folder / f"masks/masks/{name}.png", mask)
        listing.append({"name": name, "index": 3 * i, "time_s": i / 10, "sharpness": 1.0})
    facts = {"width": WIDTH, "height": HEIGHT, "frames": listing, "video": {"path": "clip.mp4", "frames": 3 * FRAMES}}
    (folder / "frames/frames.json").write_text(json.dumps(facts))
    (folder / "masks/masks.json").write_text(json.dumps({"source": "blazepose"}))


def rate(clip: Clip, folder: Path) -> dict[str, Any]:
    """Run stage sfm on the clip, and compare with its truth."""
    if not (folder / "frames/frames.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        draw(clip, folder)
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    began, said = time.perf_counter(), []
    job = Job(out, emit=lambda event: said.append(event.get("text", "")) if event["event"] == "warning" else None)
    try:
        sfm.run(job, sfm.Params(features=1024), frames=folder / "frames", masks=folder / "masks")
    except StageError as error:
        return {"verdict": str(error), "right": False, "seconds": time.perf_counter() - began}
    facts = json.loads((out / "sfm.json").read_text())
    true = clip.mm / 36 * WIDTH * (1 + (clip.zoom - 1) / 2)
    found, k = facts["focal_px"], facts["distortion"]["params"][0]
    bends = [lens.max_shift(*one, WIDTH, HEIGHT) * np.sign(one[1]) for one in ((found, k), (true, clip.k))]
    spread = facts.get("lens", {}).get("focal_spread_px", 0.0)
    return {
        "verdict": facts["verdict"],
        "right": facts["verdict"] in clip.verdicts,
        "focal_off": 100 * (found / true - 1),
        "stated": 200 * spread / true,
        "bent": float(abs(bends[0] - bends[1])),
        "seconds": time.perf_counter() - began,
        "said": said,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--half", choices=("setting", "asked", "clean"))
    parser.add_argument("--clips", nargs="+", default=[])
    args = parser.parse_args()
    rows = {}
    print(f"{'':18}{'verdict':16}{'':6}{'focal %':>8}{'stated':>8}{'bent px':>8}{'s':>7}")
    for clip in CLIPS:
        if (args.half in (None, clip.half)) and (not args.clips or clip.name in args.clips):
            row = rows[clip.name] = rate(clip, args.folder / clip.name)
            numbers = [row.get(key, np.nan) for key in ("focal_off", "stated", "bent", "seconds")]
            mark = "" if row["right"] else "WRONG"
            print(f"{clip.name:18}{row['verdict'][:15]:16}{mark:6}", "".join(f"{n:8.1f}" for n in numbers), flush=True)
    told = [row for row in rows.values() if row["verdict"] in ("moving", "rotation only")]
    near = [row for row in told if abs(row["focal_off"]) <= max(NEAR, row["stated"])]
    made_up = [row for row in told if row["bent"] > BENT]
    print(f"verdict right in {sum(row['right'] for row in rows.values())} of {len(rows)}")
    print(f"focal length within {NEAR:.0f} % or twice its stated spread in {len(near)} of {len(told)} that have one")
    print(f"corners bent by over {BENT:.0f} px otherwise than they are in {len(made_up)} of {len(told)}")


if __name__ == "__main__":
    main()
