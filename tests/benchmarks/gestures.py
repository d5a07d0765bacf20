"""How well an avatar's fingers and face take gestures that its clip never showed: synthetic clips with all truth.

    python -m tests.benchmarks.gestures WORK [--half setting] [--only near] [--inputs true] [--steps 400] [--json out.json]

Seed 0 of each kind of `tests.made.gestures` is for setting constants, seed 1 is asked. Each clip is a NeuMan folder; cameras
are the true ones. Masks, poses, and the fingers and face of each frame are true; with `--inputs face` the face is learned; with
`--inputs own` so it is, and the rest is found as the stages masks and smpl find it. Printed: PSNR and LPIPS in the boxes of the
hands and of the head, in six new gestures: of the avatar with its fingers and face posed, and of the same avatar with both at
rest. Boxes hold the true hand and the one at rest; those under 64 px are widened for LPIPS. For each, the person is moved so that
its joint is where the true one is: a body whose feet no frame shows has a size of its own. Then how far fingers that were read
are off, wrists put together. A picture of each clip shows truth, posed and rigid.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch

from stages.avatar.body.joints import HANDS, HEAD
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import scores
from stages.avatar.rasterize import Camera
from stages.estimators.assets import fetch
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.face import detect
from stages.estimators.hands.seeing import places
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.clip import Clip, load_clip
from stages.formats.facts import Sfm, read_facts
from stages.formats.hands import hands_in, write_hands
from stages.formats.images import read_image, write_image
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import write_splats
from stages.gestures import HandPoses
from stages.records import Effects
from stages.synthetic import person
from stages.training.timing.accuracy import heldout_accuracy
from tests.benchmarks.loose import SEEDS, of_one, staged, trained
from tests.made import datasets
from tests.made.gestures import KINDS, Gestures, finger_points, gesturing, make
from tests.made.learned import Learned, draw, load_learned, pose_of
from tests.made.truth import align, in_result_world, joints_of

SIZE = {"frames": 30, "width": 320, "height": 384}
PARAMS = {"human_points": 20_000, "human_cap": 30_000, "scene_cap": 30_000, "scene_fill": 10_000}
PARTS, WAYS = ("hands", "head"), ("posed", "rigid")
Box = tuple[int, int, int, int]
"""Left, top, right and bottom, px."""


def inputs(work: Path, kind: str, seed: int, given: str) -> Path:
    """The folder with what the stages before `survey` make of the clip; made once."""
    made, place = work / f"{kind}{seed}", work / f"{kind}{seed}" / given
    if not (made / "bike").exists():
        clip, shown, new = make(kind, seed, **SIZE)
        datasets.neuman(made, points=3000, clip=clip, **SIZE)
        shown.write(made / "truth" / "gestures.npz")
        new.write(made / "truth" / "novel" / "gestures.npz")
    if not (place / "smpl" / "body.npz").exists():
        staged(made, place, given == "own")
        if given != "own":
            true = Gestures.read(made / "truth" / "gestures.npz")
            give(place, true.hands, true.face if given == "true" else None)
    return place


def give(place: Path, turns: np.ndarray, face: np.ndarray | None) -> None:
    """Write hands.npz of the true fingers `turns` [F,2,15,3] rad, and the true `face` [F,52], if any, into body.npz."""
    poses, read = read_poses(place / "smpl" / "body.npz"), np.ones(turns.shape[:2])
    hands = HandPoses(poses.names, turns, np.median(turns, 0), read > 0, 0 * read, read)
    write_hands(place / "smpl" / "hands.npz", hands)
    write_poses(place / "smpl" / "body.npz", replace(poses, face=face))


def boxes(views: Path) -> list[dict[int, Box]]:
    """Where the true hands, and hands at rest, and the head are in each of the true views of a folder, by their joint; those that
    are whole."""
    cameras, poses, model = read_cameras(views / "cameras.npz"), read_poses(views / "body.npz"), read_body_model()
    bodies = gesturing(model, poses.betas, Gestures.read(views / "gestures.npz")), Body(model, dtype=torch.float64)
    pose = poses.betas, poses.global_orient, poses.body_pose, poses.transl
    skins = np.concatenate([person.pose_body(body, *pose)[1] for body in bodies], 1)
    pixels, _ = project(skins, cameras.viewmats, cameras.Ks)
    limbs = np.tile(model.lbs_weights, (2, 1)) > 0.5
    found: list[dict[int, Box]] = []
    for at in pixels:
        each = {joint: at[limbs[:, joint]] for joint in (*HANDS, HEAD)}
        each_box = {j: (*spots.min(0).astype(int), *(spots.max(0) + 1).astype(int)) for j, spots in each.items()}
        size = cameras.width, cameras.height
        found.append(
            {j: box for j, box in each_box.items() if min(box) >= 0 and box[2] <= size[0] and box[3] <= size[1]}
        )
    return found


def widened(box: Box, least: int, size: tuple[int, int]) -> Box:
    """A box of at least so many px each way in a picture of `size`."""
    sides = []
    for low, high, most in ((box[0], box[2], size[0]), (box[1], box[3], size[1])):
        more = max(0, least - (high - low))
        low = min(max(0, low - more // 2), most - max(least, high - low))
        sides.append((low, max(high, low + least)))
    return sides[0][0], sides[1][0], sides[0][1], sides[1][1]


def novel(place: Path, clip: Clip, learned: Learned, lpips: Lpips) -> tuple[dict[str, Any], np.ndarray]:
    """Mean scores of new gestures by part and way, and a picture: truth above posed above rigid."""
    views, model = place.parent / "truth" / "novel", read_body_model()
    similarity = align(clip.cameras, read_cameras(place.parent / "truth" / "cameras.npz"), clip.body.world_from_sfm)
    cameras, poses = in_result_world(views, similarity, clip.body, clip.body_model, model)
    moves = similarity.to_result(joints_of(read_poses(views / "body.npz"), model)) - joints_of(poses, clip.body_model)
    new, where, tiles = Gestures.read(views / "gestures.npz"), boxes(views), []
    found: dict[str, dict[str, list[tuple[float, float]]]] = {part: {way: [] for way in WAYS} for part in PARTS}
    for i, name in enumerate(cameras.names):
        pose, wanted = pose_of(poses, i), read_image(views / "images" / f"{name}.png")
        camera = Camera.of(cameras.viewmats[i], cameras.Ks[i], cameras.width, cameras.height)
        people = learned.person(pose, new.hands[i], new.face[i]), learned.person(pose)
        scene, drawn = learned.shade(learned.scene, pose), {}
        for joint, box in where[i].items():
            part = "head" if joint == HEAD else "hands"
            for way, one in zip(WAYS, people):
                moved = one._replace(means=one.means + torch.tensor(moves[i, joint], dtype=torch.float32))
                drawn[way] = draw(moved, scene, camera)[0]
                found[part][way].append(score(drawn[way], wanted, box, lpips))
        tiles.append(np.concatenate([wanted, *(to_uint8(drawn[way]) for way in WAYS)]))
    rows = {
        part: {way: dict(zip(("psnr", "lpips"), map(fmean, zip(*each)))) for way, each in ways.items()}
        for part, ways in found.items()
    }
    return rows | {"boxes": {part: len(found[part]["posed"]) for part in PARTS}}, np.concatenate(tiles, 1)


def score(picture: np.ndarray, wanted: np.ndarray, box: Box, lpips: Lpips) -> tuple[float, float]:
    """PSNR in dB and LPIPS in a box of a picture [H,W,3] 0..1, where uint8 [H,W,3] is wanted."""
    both = [torch.tensor(picture).clamp(0, 1), torch.tensor(wanted).float() / 255]
    found = []
    for left, top, right, bottom in (box, widened(box, lpips.smallest, (wanted.shape[1], wanted.shape[0]))):
        found.append(scores(*(one[top:bottom, left:right].contiguous() for one in both), lpips))
    psnr, close = found[0]["psnr"], found[1]["lpips"]
    assert psnr is not None and close is not None
    return psnr, close


def fingers_off(place: Path) -> dict[str, float | int]:
    """How far the fingers that were read are off, and would be at rest, cm, median of joints and tips."""
    true, hands = Gestures.read(place.parent / "truth" / "gestures.npz").hands, hands_in(place / "smpl")
    if hands is None:
        return {"read": 0}
    betas = [read_poses(folder / "body.npz").betas for folder in (place / "smpl", place.parent / "truth")]
    rows, model = [int(name) for name in hands.names], read_body_model()
    wanted = finger_points(model, betas[1], true[rows])
    off = [
        100 * float(np.median(np.linalg.norm(finger_points(model, betas[0], turns) - wanted, axis=-1)[hands.read]))
        for turns in (hands.turns, 0 * hands.turns)
    ]
    return {"read": int(hands.read.sum()), "of": hands.read.size, "off": off[0], "at_rest": off[1]}


def rate(work: Path, kind: str, seed: int, given: str, steps: int, lpips: Lpips) -> dict[str, Any]:
    """Make, train and score one clip."""
    began = time.process_time()
    place = inputs(work, kind, seed, given)
    clip, staging = load_clip(place / "sfm", place / "smpl"), time.process_time() - began
    large = detect(ClipEvidence(clip, read_facts(place / "sfm" / "sfm.json", Sfm))).called_for
    fit, row = trained(place, steps, given == "own", False, PARAMS, large)
    others = [int(i) for i in np.flatnonzero(~clip.training)]
    heldout = heldout_accuracy(fit.cast(), fit.seen(), others, lpips)
    result, avatar, _ = of_one(fit, clip)
    write_splats(place / "avatar.npz", avatar)
    learned = load_learned(avatar, result.scene, result.effects or Effects())
    scored, picture = novel(place, clip, learned, lpips)
    write_image(place / "novel.png", picture)
    long = places(clip.body_model, clip.body, clip.cameras).lengths
    row |= {"clip": f"{kind}{seed}", "inputs": given, "px": float(np.median(long)), "novel": scored, "staging": staging}
    return row | {
        "heldout": {key: heldout[f"{key}_person"] for key in ("psnr", "lpips")},
        "fingers": fingers_off(place),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--half", choices=SEEDS, default="setting")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--inputs", choices=("true", "face", "own"), default="true")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--json", type=Path)
    args, rows = parser.parse_args(), []
    with np.load(fetch("lpips_alex.npz")) as arrays:
        lpips = Lpips(arrays)
    for kind in args.only:
        row = rate(args.work, kind, SEEDS[args.half], args.inputs, args.steps, lpips)
        rows.append(row)
        parts = [
            f"{part} {way} {row['novel'][part][way]['psnr']:.2f} dB, LPIPS {row['novel'][part][way]['lpips']:.3f}"
            for part in PARTS
            for way in WAYS
        ]
        parts.append(f"held-out person {row['heldout']['psnr']:.2f} dB, LPIPS {row['heldout']['lpips']:.3f}")
        print(f"{row['clip']:<6} {args.inputs:<4}  hands {row['px']:.0f} px  {'   '.join(parts)}   "
              f"fingers {row['fingers']}   {row['cpu_seconds']:.0f} s", flush=True)  # fmt: skip
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
