"""How good the built-in masks and body fit are on synthetic clips, whose truth is known; the bars stand in `BARS`.

    hugs demo --seed 1 --work build/seed1
    python -m tests.benchmarks.finished_fit build/seed1/clip [another clip's folder ...] [--pipeline default]

Prints a line for each measure: the value of each clip, their mean, and the bar.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.estimators.bodyfit.contact import sole_vertices
from stages.estimators.bodyfit.evidence import gather, model_landmarks
from stages.estimators.bodyfit.posed import posed_vertices
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.landmarks import read_landmarks
from stages.formats.poses import read_poses
from stages.records import BodyModel, BodyPoses, Cameras
from tests.made.truth import Similarity, align, joints_of, mask_ious, rows

TALL = 864  # px, the height of the pictures that the bar on reprojection is for
STANDS = 0.02  # m that a true sole may move between two frames and still stand: the person turns on the spot
BARS = {
    "mean mask IoU": "at least 0.93",
    "worst mask IoU": "at least 0.85",
    "mean joint error, cm": "at most 4",
    "joints jitter, cm": "",
    "true joints jitter, cm": "",
    "landmarks off, px of 864": "at most 6",
    "joints off, px of 864": "at most 6",
    "size of the person, %": "within 3",
    "standing feet slide, cm a frame": "at most 2",
    "worst slide, cm a frame": "",
}


def measured(results: Path, truth: Path) -> dict[str, float]:
    """The measures of BARS for the finished stages of one clip and the truth beside it."""
    fitted, wanted = read_poses(results / "smpl" / "body.npz"), read_poses(truth / "body.npz")
    model, true_model = read_body_model(results / "smpl" / "body_model.npz"), read_body_model()
    cameras, true_cameras = read_cameras(results / "sfm" / "cameras.npz"), read_cameras(truth / "cameras.npz")
    similarity = align(cameras, true_cameras, fitted.world_from_sfm)
    order = rows(fitted.names, wanted.names)
    found, joints = similarity.to_truth(joints_of(fitted, model)), joints_of(wanted, true_model)[order]
    views = true_cameras.viewmats[rows(fitted.names, true_cameras.names)]
    seen = (project(points, views, true_cameras.Ks[order])[0] for points in (found, joints))
    ious = mask_ious(results / "masks" / "masks", truth / "masks")
    tall = similarity.scale * stature(model, fitted) / stature(true_model, wanted)
    slides = sliding(*standing_soles(fitted, model, similarity, wanted, true_model, order))
    values = (
        ious.mean(),
        ious.min(),
        100 * np.linalg.norm(found - joints, axis=-1).mean(),
        jitter(found),
        jitter(joints),
        np.median(landmark_errors(results, fitted, model, cameras)) * TALL / cameras.height,
        np.median(np.linalg.norm(next(seen) - next(seen), axis=-1)) * TALL / cameras.height,
        100 * (tall - 1),
        100 * slides.mean(),
        100 * slides.max(),
    )
    return dict(zip(BARS, map(float, values), strict=True))


def stature(model: BodyModel, poses: BodyPoses) -> float:
    """Height of the body at rest, m."""
    return float(np.ptp((model.v_template + model.shapedirs @ poses.betas)[:, 1]))


def jitter(joints: np.ndarray) -> float:
    """Mean length of the second differences of joints [F,24,3], cm."""
    return 100 * float(np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).mean())


def landmark_errors(results: Path, poses: BodyPoses, model: BodyModel, cameras: Cameras) -> np.ndarray:
    """Pixels between the body's landmarks and BlazePose's, of those it is surer of than not."""
    names, regressor = model_landmarks(model)
    evidence = gather(list(read_landmarks(results / "smpl" / "landmarks.npz").values()), names)
    views = rescale_viewmats(cameras.viewmats, poses.world_from_sfm)
    points = np.stack([regressor @ vertices for vertices in posed_vertices(model, poses)])
    off = np.linalg.norm(project(points, views, cameras.Ks)[0] - evidence.xy, axis=-1)
    return off[evidence.weight > 0.5]


def standing_soles(fitted, model, similarity: Similarity, wanted, true_model, order) -> tuple[np.ndarray, np.ndarray]:
    """Points under both feet [F,2,S,3] m in the truth's world: the fit's, and the true ones."""
    soles = [sole_vertices(Body(body)).numpy() for body in (model, true_model)]
    found = np.stack([vertices[soles[0]] for vertices in posed_vertices(model, fitted)])
    true = np.stack([vertices[soles[1]] for vertices in posed_vertices(true_model, wanted)])[order]
    return similarity.to_truth(found), true


def sliding(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """How far [N] m each standing foot moves from one frame to the next, beyond what the true foot does.

    A foot stands where its true sole [F,2,S,3] moves less than STANDS and is on the floor, y = 0, in both frames.
    """
    moved, truly = (np.diff(feet.mean(2), axis=0) for feet in (found, true))
    low = true[..., 1].min(2) < 0.01
    stands = low[1:] & low[:-1] & (np.linalg.norm(truly, axis=-1) < STANDS)
    return np.linalg.norm(moved - truly, axis=-1)[stands]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--pipeline", default="default")
    args = parser.parse_args()
    found = [measured(clip / args.pipeline, clip / "synthetic" / "truth") for clip in args.clips]
    for name, bar in BARS.items():
        values = [clip[name] for clip in found]
        print(f"{name:<32}", *(f"{value:7.3f}" for value in values), f"  mean {np.mean(values):7.3f}  {bar}")


if __name__ == "__main__":
    main()
