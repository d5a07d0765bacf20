"""What an avatar in a skirt, a long coat, a ponytail or with a bag, or one filmed in a single pose, is like in new poses:
synthetic clips with all truth.

    python -m tests.benchmarks.loose WORK [--half setting] [--only skirt] [--own] [--steps 500] [--json out.json]

Seed 0 of each garment is for setting constants, seed 1 is asked; `none` wears nothing loose. Each clip is a NeuMan folder;
cameras are the true ones.
Masks and poses are true or, with `--own`, found as the stages masks, sfm and smpl find them. Survey's detector decides
whether clothes are modelled. Printed: PSNR and LPIPS in the person's box, of frames that were not trained on, as
training draws them and as the finished avatar is in them, and of six poses that no frame shows, in which true clothes
are at rest. A picture of each clip shows the latter beside the truth; the avatar is kept, too. The kinds of
`tests.made.one_pose` are clips of one pose, with ten new poses. Of outlines in new poses: IoU with the true one, mean and least,
the pieces of more than 30 px off it in all pictures, and of what is worn the IoU of what stands off the true body.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from stages import calibrated, masks, neuman, smpl, train
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.kernels.mesh import covered
from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import person_crop, scores
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.contract import Job
from stages.estimators.assets import fetch
from stages.estimators.bodyfit.posed import posed_bodies
from stages.estimators.detectors.clothing import detect
from stages.estimators.detectors.evidence import ClipEvidence
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.clip import Clip, load_clip
from stages.formats.facts import Sfm, read_facts
from stages.formats.images import read_image, read_mask, write_image
from stages.formats.poses import read_poses
from stages.formats.splats import write_splats
from stages.records import Avatar, BodyPoses, Effects
from stages.training.beginning.start import Task, build
from stages.training.results import Result, result_of
from stages.training.step.fit import Fit
from stages.training.timing.accuracy import heldout_accuracy
from stages.training.timing.finishing import Finishing
from tests.made import datasets, one_pose
from tests.made.learned import Learned, Pose, draw, load_learned, pose_of
from tests.made.synthetic.wardrobe import MAKERS
from tests.made.truth import align, in_result_world

GARMENTS = (*MAKERS, "none", *one_pose.KINDS)
SEEDS = {"setting": 0, "asked": 1}
KINDS = (read_image, "images"), (read_mask, "masks")
Scored = tuple[dict[str, float | None], np.ndarray]
SIZE = {"frames": 40, "width": 192, "height": 256, "points": 3000}
PIECE, WORN = 30, 40  # px
PARAMS = {"human_points": 7_000, "human_cap": 12_000, "scene_cap": 16_000, "scene_fill": 8_000}


def inputs(work: Path, garment: str, seed: int, own: bool) -> Path:
    """The folder with what the stages before `survey` make of the clip; made once."""
    made, place = work / f"{garment}{seed}", work / f"{garment}{seed}" / ("own" if own else "true")
    if not (made / "bike").exists():
        clip, wears = None, () if garment == "none" else (garment,)
        if garment in one_pose.KINDS:
            clip = one_pose.make(garment, seed, SIZE["width"], SIZE["height"], SIZE["frames"])
        datasets.neuman(made, seed=seed, wears=wears, clip=clip, **SIZE)
    if not (place / "smpl" / "body.npz").exists():
        staged(made, place, own)
    return place


def staged(made: Path, place: Path, own: bool) -> None:
    """Make the folder `place` of what the stages before `survey` make of the clip `made`."""
    shutil.rmtree(place, ignore_errors=True)
    folders = {name: place / name for name in ("frames", "masks", "sfm", "smpl")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    jobs = {name: Job(folder, emit=lambda event: None) for name, folder in folders.items()}
    frames, sfm = folders["frames"], folders["sfm"]
    neuman.run(jobs["frames"], neuman.Params(), video=made / "bike")
    if own:
        shutil.rmtree(frames / "given" / "masks")
        (frames / "given" / "smpl_fit.npz").unlink()
    masks.run(jobs["masks"], masks.Params(), frames=frames)
    calibrated.run(jobs["sfm"], calibrated.Params(), frames=frames, masks=folders["masks"])
    smpl.run(jobs["smpl"], smpl.Params(), frames=frames, sfm=sfm)


def trained(
    place: Path, steps: int, own: bool, clothing: bool | None, sizes: dict[str, int] = PARAMS, face: bool = False
) -> tuple[Fit, dict[str, Any]]:
    """The training of a clip, and what is to be said of it; `clothing` overrides the detector."""
    clip, facts = load_clip(place / "sfm", place / "smpl"), read_facts(place / "sfm" / "sfm.json", Sfm)
    finding = detect(ClipEvidence(clip, facts))
    on = finding.called_for if clothing is None else clothing
    params = train.Params(steps=steps, **sizes)
    fit = build(Task([clip], params, {"pose_refinement": own, "clothing": on, "face": face}), lambda text: None)
    began = time.process_time()
    while fit.progress.step < steps:
        fit.advance()
    return fit, {"on": on, "off": finding.value, "cpu_seconds": time.process_time() - began}


def of_one(fit: Fit, clip: Clip) -> tuple[Result, Avatar, BodyPoses]:
    """A training of one person, finished: the result, the avatar and the poses."""
    quiet = Finishing(Job(Path(), emit=lambda event: None), [], 0, 0.0)
    result = result_of(fit, [clip], [{"seconds": 0.0}], {}, quiet)
    ((avatar, body),) = result.people
    return result, avatar, body


class Shown(NamedTuple):
    """The finished avatar of a clip, and how it is compared."""

    clip: Clip
    body: BodyPoses
    learned: Learned
    lpips: Lpips | None

    def score(self, person: Splats, pose: Pose, camera: Camera, wanted: np.ndarray, mask: np.ndarray) -> Scored:
        """Scores in the person's box, and the picture."""
        picture, _ = draw(person, self.learned.shade(self.learned.scene, pose), camera)
        crop = person_crop(torch.as_tensor(mask).float() / 255)
        both = (torch.tensor(picture).clamp(0, 1), torch.tensor(wanted).float() / 255)
        return scores(*(one[crop].contiguous() for one in both), self.lpips), to_uint8(picture)


def novel(place: Path, shown: Shown) -> tuple[dict[str, float], np.ndarray]:
    """Mean scores of new poses and cameras, clothes at rest, and a picture: truth above result."""
    clip, truth, body = shown.clip, place.parent / "truth", shown.body
    similarity = align(clip.cameras, read_cameras(truth / "cameras.npz"), clip.body.world_from_sfm)
    cameras, poses = in_result_world(truth / "novel", similarity, body, clip.body_model, read_body_model())
    found, tiles, edges = [], [], []
    bare = bodies_of(truth / "novel")
    for i, name in enumerate(cameras.names):
        pose = pose_of(poses, i)
        camera = Camera.of(cameras.viewmats[i], cameras.Ks[i], cameras.width, cameras.height)
        wanted, mask = (read(truth / "novel" / kind / f"{name}.png") for read, kind in KINDS)
        person = shown.learned.person(pose)
        row, picture = shown.score(person, pose, camera, wanted, mask)
        found.append(row)
        edges.append(outline(draw(person, None, camera)[1] > 0.5, mask > 127, bare[i]))
        tiles.append(np.concatenate([wanted, picture]))
    ious, pieces, objects = zip(*edges)
    worn = [iou for iou in objects if iou is not None]
    marks = {"iou": fmean(ious), "least": min(ious), "pieces": sum(pieces)}
    return means(found) | marks | ({"object": fmean(worn)} if worn else {}), np.concatenate(tiles, 1)


def bodies_of(views: Path) -> list[np.ndarray]:
    """Where the body alone [H,W] is seen in each of the true views of a folder."""
    cameras, poses, model = read_cameras(views / "cameras.npz"), read_poses(views / "body.npz"), read_body_model()
    posed = posed_bodies(model, poses, list(range(len(poses.names))))
    size = cameras.width, cameras.height
    return [covered(one, model.faces, *view, *size) for one, *view in zip(posed, cameras.viewmats, cameras.Ks)]


def outline(found: np.ndarray, true: np.ndarray, body: np.ndarray) -> tuple[float, int, float | None]:
    """IoU of two outlines [H,W], pieces of more than PIECE px off the true one, and the IoU of what stands off the `body`
    near what does in truth; None where hardly anything does.
    """
    off, _, sizes, _ = cv2.connectedComponentsWithStats((found & ~grown(true, 2)).astype(np.uint8))
    iou, worn = float((found & true).sum() / (found | true).sum()), true & ~grown(body, 1)
    pieces = int((sizes[1:off, cv2.CC_STAT_AREA] > PIECE).sum())
    if worn.sum() < WORN:
        return iou, pieces, None
    ours = found & ~grown(body, 1) & grown(worn, 8)
    return iou, pieces, float((ours & worn).sum() / (ours | worn).sum())


def grown(shape: np.ndarray, by: int) -> np.ndarray:
    """A shape [H,W] and what is at most so many px beside it."""
    return cv2.dilate(shape.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1))) > 0


def finished(shown: Shown, fit: Fit, others: list[int]) -> dict[str, float]:
    """Mean scores of the finished avatar in the frames `others`."""
    viewmats, views, found = fit.cameras(), fit.full, []
    for i in others:
        mask, pose = views.masks[i].numpy(), pose_of(shown.body, i)
        camera = Camera(viewmats[i], views.Ks[i], mask.shape[1], mask.shape[0])
        found.append(shown.score(shown.learned.person(pose), pose, camera, views.images[i].numpy(), mask)[0])
    return means(found)


def means(rows: list[dict[str, float | None]]) -> dict[str, float]:
    """PSNR in dB and LPIPS, that of the boxes that are large enough for it."""
    return {key: fmean(value for row in rows if (value := row[key]) is not None) for key in ("psnr", "lpips")}


def rate(work: Path, garment: str, seed: int, args: argparse.Namespace, lpips: Lpips | None) -> dict[str, Any]:
    """Make, train and score one clip."""
    place = inputs(work, garment, seed, args.own)
    fit, row = trained(place, args.steps, args.own, args.clothing)
    others = [int(i) for i in np.flatnonzero(~load_clip(place / "sfm", place / "smpl").training)]
    heldout = heldout_accuracy(fit.cast(), fit.seen(), others, lpips)
    clip = load_clip(place / "sfm", place / "smpl")
    result, avatar, body = of_one(fit, clip)
    write_splats(place / f"avatar{args.tag}.npz", avatar)
    shown = Shown(clip, body, load_learned(avatar, result.scene, result.effects or Effects()), lpips)
    scored, picture = novel(place, shown)
    write_image(place / f"novel{args.tag}.png", picture)
    row |= {"clip": f"{garment}{seed}", "own": args.own, "novel": scored, "finished": finished(shown, fit, others)}
    return row | {"heldout": {key: heldout[f"{key}_person"] for key in ("psnr", "lpips")}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--half", choices=SEEDS, default="setting")
    parser.add_argument("--only", nargs="+", choices=GARMENTS, default=GARMENTS)
    parser.add_argument("--own", action="store_true")
    parser.add_argument("--clothing", action=argparse.BooleanOptionalAction, help="override the detector")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--tag", default="", help="of the picture's name")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    with np.load(fetch("lpips_alex.npz")) as arrays:
        lpips = Lpips(arrays)
    for garment in args.only:
        rows.append(rate(args.work, garment, SEEDS[args.half], args, lpips))
        row = rows[-1]
        parts = "   ".join(
            f"{kind} {row[kind]['psnr']:.2f} dB, LPIPS {row[kind]['lpips']:.3f}"
            for kind in ("heldout", "finished", "novel")
        )
        marks = row["novel"]
        worn = f", object {marks['object']:.2f}" if "object" in marks else ""
        parts += f"   outline {marks['iou']:.3f} (least {marks['least']:.3f}), {marks['pieces']} pieces{worn}"
        off = "nothing" if row["off"] is None else f"{row['off']:.3f}"
        print(f"{row['clip']:<10} {'own' if args.own else 'true'}  off the body {off}, {'on ' if row['on'] else 'off'}  "
              f"{parts}   {row['cpu_seconds']:.0f} s", flush=True)  # fmt: skip
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
