"""What an avatar that one real camera taught looks like to two others: treadmill, trained on cam01 alone.

    HUGS_CLIPS=../shared/data python -m tests.benchmarks.real_views build/family/treadmill [hugs run options]

The folder is that of `tests.benchmarks.fit --treadmill`, made if it is missing. `human_only` is run on the pictures and the
calibration of cam01; every fifth picture is held out. Then the person is drawn over white as each calibrated camera sees
them, in the poses that training left, and compared with that camera's picture, cut out by our own mask of it. Frames count
in which all cameras agree on the hips. One camera does not tell how large the person is: the world is scaled about cam01
so that the hips are as far away as those that all cameras triangulate to. Printed for each camera: the angle from cam01 at
the hips; IoU of drawn person and mask; PSNR and LPIPS in the box around both, and PSNR of what lies in both. Lines "at the
hips": with the hips moved to the triangulated ones, which leaves shape, pose and colours. cam01.png, cam02.png and cam03.png
show pictures beside the drawn ones.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.avatar.drawing.avatar import PosedAvatar
from stages.avatar.drawing.cast import Cast
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import psnr
from stages.avatar.rasterize import Camera
from stages.estimators.assets import fetch
from stages.estimators.bodyfit.evidence import model_landmarks
from stages.estimators.bodyfit.posed import posed_vertices
from stages.filming.clip_cast import load_cast
from stages.formats.cameras import read_cameras
from stages.formats.clip import Clip
from stages.formats.images import read_image, read_mask, write_image
from stages.formats.video import write_video
from tests.made.family.treadmill import (
    EVERY,
    FAR,
    HIPS,
    JOINTS,
    RATE,
    SIZE,
    VIEWS,
    make_treadmill,
    read_calibration,
    triangulated,
)

OPENGL = np.diag([1.0, -1, -1, 1])
SHOWN = 5
"""Every so many of the pictures are shown."""
CRF = 8
"""Of the clip that is made of camera 1's undistorted pictures: hardly seen."""


@dataclass(frozen=True)
class Hips:
    """Places [F,3] m in the frame of cam01, as all cameras see them and of the trained body; `known` [F]: all agree."""

    true: np.ndarray
    ours: np.ndarray
    known: np.ndarray

    @property
    def scale(self) -> float:
        """True metres a metre of ours."""
        true, ours = (np.linalg.norm(one[self.known], axis=1) for one in (self.true, self.ours))
        return float(np.median(true / ours))


def trained(folder: Path, more: list[str]) -> Path:
    """Train on cam01 alone, with its calibration; the folder of the results."""
    at = folder / VIEWS[0]
    cameras = read_cameras(at / "cameras.npz")
    K = cameras.Ks[0]
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": cameras.width, "h": cameras.height}
    frames = [{"file_path": f"{i:06d}.png", "transform_matrix": OPENGL.tolist()} for i in range(len(cameras))]
    (at / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    pictures = (read_image(at / "images" / f"{name}.png") for name in cameras.names)
    write_video(at / "clip.mp4", pictures, RATE / EVERY, crf=CRF)
    hugs = [sys.executable, "-c", "from hugs_cli import main; main()", "run", str(at / "clip.mp4")]
    work = folder / "work"
    options = ["--pipeline", "human_only", "--cameras", str(at / "transforms.json"), "--work", str(work)]
    subprocess.run([*hugs, "train", *options, *more], check=True)
    return work / "clip" / "human_only"


def hips_of(folder: Path, clip: Path, learned: Clip) -> Hips:
    """The hips of the person that training left, beside those of all cameras."""
    model = learned.body_model
    names, regressor = model_landmarks(model)
    rows = regressor[[names.index(JOINTS[j]) for j in HIPS]]
    ours = np.stack([(rows @ vertices).mean(0) for vertices in posed_vertices(model, learned.body)])
    points, missed = triangulated(folder, clip)
    return Hips(points[:, HIPS].mean(1), ours, np.all(missed[:, HIPS] < FAR * SIZE, axis=1))


def seen_from(
    view: str, folder: Path, clip: Path, cast: Cast[PosedAvatar], hips: Hips, lpips: Lpips
) -> tuple[list[float], list[np.ndarray]]:
    """IoU, PSNR in the box, PSNR of what lies in both, LPIPS in the box, means over frames; and picture beside drawing."""
    cameras, lenses = read_cameras(folder / view / "cameras.npz"), read_calibration(clip / "Calib.qca.txt")
    viewmat = lenses[view].viewmat @ np.linalg.inv(lenses[VIEWS[0]].viewmat)
    viewmat[:3, 3] /= hips.scale
    found, shown = [], []
    for i, name in enumerate(cameras.names):
        if not hips.known[i]:
            continue
        camera = Camera.of(viewmat, cameras.Ks[i], cameras.width, cameras.height)
        drawn, alpha = cast.at(i, cast.people).picture(camera, background=1.0)
        mask = read_mask(folder / view / "masks" / f"{name}.png").astype(np.float32) / 255
        picture = read_image(folder / view / "images" / f"{name}.png").astype(np.float32) / 255
        picture = 1 + mask[..., None] * (picture - 1)
        either, both = (mask > 0.5) | (alpha > 0.5), (mask > 0.5) & (alpha > 0.5)
        rows, columns = (np.flatnonzero(either.any(axis)) for axis in (1, 0))
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        a, b = (torch.tensor(one[box].copy()).clamp(0, 1) for one in (drawn, picture))
        inside = (torch.tensor(one[both]) for one in (drawn.clip(0, 1), picture))
        found.append([both.sum() / either.sum(), psnr(a, b), psnr(*inside), float(lpips(a, b))])
        if len(found) % SHOWN == 1:
            shown.append(np.concatenate([picture, drawn.clip(0, 1)], 1))
    return np.mean(found, 0).tolist(), shown


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two directions [3]."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    args, more = parser.parse_known_args()
    if "HUGS_CLIPS" not in os.environ:
        parser.error("HUGS_CLIPS must name the folder of real clips")
    clip = Path(os.environ["HUGS_CLIPS"]) / "treadmill"
    if not (args.folder / "facts.json").exists():
        make_treadmill(args.folder, clip)
    results = trained(args.folder, more)
    (learned,), cast = load_cast(results / "sfm", results / "smpl", results / "train", "cpu")
    with np.load(fetch("lpips_alex.npz")) as weights:
        lpips = Lpips(weights)
    hips, lenses = hips_of(args.folder, clip, learned), read_calibration(clip / "Calib.qca.txt")
    if len(learned.names) != len(hips.known):
        raise SystemExit(f"the run kept {len(learned.names)} of the {len(hips.known)} frames that are compared")
    print(
        f"all agree in {hips.known.sum()} of {len(hips.known)} frames; the world is made {hips.scale:.3f} times as large"
    )
    middle = np.linalg.inv(lenses[VIEWS[0]].viewmat) @ [*np.median(hips.true[hips.known], 0), 1]
    sights = {view: lens.viewmat[:3, :3].T @ (lens.viewmat @ middle)[:3] for view, lens in lenses.items()}
    body, (who,) = learned.body, cast.people
    for moved in (False, True):
        apart = hips.true / hips.scale - hips.ours if moved else 0
        person = PosedAvatar.of(who.avatar, body.global_orient, body.body_pose, body.transl + apart)
        alone = cast._replace(people=[person], scene=None, speeds=None)
        for view in VIEWS:
            angle = angle_between(sights[view], sights[VIEWS[0]])
            (iou, box, inside, far), shown = seen_from(view, args.folder, clip, alone, hips, lpips)
            where = f"{view}, {angle:3.0f} degrees{', at the hips' if moved else ''}"
            print(f"{where:<33} IoU {iou:.3f}  box {box:.2f} dB, LPIPS {far:.3f}  in both {inside:.2f} dB", flush=True)
            if moved:
                write_image(args.folder / f"{view}.png", to_uint8(np.concatenate(shown, 1)))


if __name__ == "__main__":
    main()
