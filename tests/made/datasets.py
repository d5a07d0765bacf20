"""Folders in the layouts of NeuMan and ZJU-MoCap, written from views of the synthetic clip, with the truth beside them.

Each world is turned and moved against the truth's, so that a transform left out is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.formats.body_model import read_body_model
from stages.formats.images import write_image, write_mask
from stages.formats.video import decode, write_video
from stages.synthetic import person
from stages.synthetic.files import write_truth, write_views
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import NO_EFFECTS, ClipEffects
from tests.made.worlds import align_viewmats

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
SHIFT = np.array([3.0, -1.2, 0.8])
UNITS = 2.7  # SfM units per metre
LENS = np.array([-0.2, 0.03, 0.002, -0.001, 0.004])


@dataclass(frozen=True)
class Made:
    """The data set's folder and the folder of the truth, as stages.synthetic.files writes it."""

    folder: Path
    truth: Path


def neuman(
    folder: Path,
    frames: int = 15,
    width: int = 96,
    height: int = 128,
    k: float = 0.0,
    points: int = 400,
    noise: float = 0.0,
    camera_noise: float = 0.0,
    effects: ClipEffects = NO_EFFECTS,
    seed: int = 0,
    crf: int | None = None,
    wears: Sequence[str] = (),
    clip: synthetic.SyntheticClip | None = None,
) -> Made:
    """A NeuMan sequence called bike; poses have scales that differ by up to 8 % and look right from their own camera.

    `noise` is the standard deviation of what is added to the poses: in radians to joint angles, and of the mean
    distance to the camera to places. `camera_noise` is the same for the cameras: radians, and of the mean distance from
    the person. With `crf` the pictures are what is left of them in a video coded so. `wears`: see `synthetic.make_clip`,
    which makes the clip where none is given.
    """
    model = read_body_model()
    if clip is None:
        size = {"frames": frames, "width": width, "height": height}
        clip = synthetic.make_clip(model, seed=seed, effects=effects, wears=wears, **size)
    views = clip.frames
    made = Made(folder / "bike", folder / "truth")
    write_truth(made.truth, clip)
    four = made.folder / "4d_humans" / "sam_segmentations"
    for path in (made.folder / "images", made.folder / "sparse", four, made.folder / "segmentations"):
        path.mkdir(parents=True)
    if crf is None:
        pictures = views.images
    else:
        write_video(folder / "coded.mp4", views.images, clip.fps, crf=crf)
        pictures = [picture for _, _, picture in decode(folder / "coded.mp4")]
    for i in range(frames):
        write_image(made.folder / "images" / f"{i:05d}.png", pictures[i])
        write_mask(four / f"mask_{i:04d}.png", views.masks[i])
        write_mask(made.folder / "segmentations" / f"{i:05d}.png.png", 255 - views.masks[i])
    viewmats = align_viewmats(views.viewmats, UNITS, TURN.as_matrix(), SHIFT)
    write_sparse(
        made.folder / "sparse", disturbed(viewmats, camera_noise, UNITS * synthetic.DISTANCE), views, k, points
    )
    pelvis = model.J_regressor[0] @ (model.v_template + model.shapedirs @ clip.betas)
    centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
    orient = (TURN * Rotation.from_rotvec(views.global_orient)).as_rotvec()
    there = UNITS * TURN.apply(views.joints[:, 0]) + SHIFT  # the pelvis in SfM units
    stretch = 1 + 0.08 * np.linspace(-1, 1, frames)[np.random.default_rng(0).permutation(frames)]
    scale = UNITS * stretch / np.median(stretch)
    rng = np.random.default_rng(2)
    angles = noise * rng.normal(size=views.body_pose.shape)
    away = np.linalg.norm(there - centres, axis=1).mean()
    there = there + noise * away * rng.normal(size=there.shape)
    moved = centres + (scale / UNITS)[:, None] * (there - centres)
    np.savez(
        made.folder / "4d_humans" / "smpl_optimized_aligned_scale.npz",
        global_orient=orient.astype(np.float32),
        body_pose=(views.body_pose + angles).astype(np.float32),
        betas=np.tile(clip.betas, (frames, 1)).astype(np.float32),
        transl=(moved - scale[:, None] * pelvis).astype(np.float32),
        scale=scale.astype(np.float32),
        bbox=np.zeros((frames, 4), np.float32),
        body=np.array(model.name),
    )
    return made


def disturbed(viewmats: np.ndarray, noise: float, distance: float) -> np.ndarray:
    """`viewmats` [C,4,4] turned by `noise` rad and moved by `noise` times `distance`, as standard deviations."""
    rng = np.random.default_rng(4)
    turns, moves = rng.normal(size=(2, len(viewmats), 3)) * noise
    there = viewmats.copy()
    there[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix() @ viewmats[:, :3, :3]
    there[:, :3, 3] = (Rotation.from_rotvec(turns).as_matrix() @ viewmats[:, :3, 3:])[..., 0] + moves * distance
    return there


def write_sparse(folder: Path, viewmats: np.ndarray, views: synthetic.TrueViews, k: float, points: int) -> None:
    """COLMAP's text files: SIMPLE_RADIAL, or PINHOLE with k = 0; points on the room's surfaces, seen by all cameras."""
    height, width = views.masks.shape[1:]
    K = views.Ks[0]
    lens = f"SIMPLE_RADIAL {width} {height} {K[0, 0]} {K[0, 2]} {K[1, 2]} {k}"
    if not k:
        lens = f"PINHOLE {width} {height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
    (folder / "cameras.txt").write_text(f"# Camera list\n1 {lens}\n")
    lines = ["# Image list with two lines of data per image:"]
    for i in reversed(range(len(viewmats))):  # COLMAP keeps no order
        x, y, z, w = Rotation.from_matrix(viewmats[i, :3, :3]).as_quat()
        pose = " ".join(f"{v:.17g}" for v in (w, x, y, z, *viewmats[i, :3, 3]))
        lines += [f"{i + 1} {pose} 1 {i:05d}.png", "10.5 20.5 1 11 21 -1" if i % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = ["# 3D point list"]
    for n, (i, x, y) in enumerate(points_of(views, points)):
        z = views.depths[i, y, x]
        seen = np.linalg.inv(K) @ [(x + 0.5) * z, (y + 0.5) * z, z]
        world = views.viewmats[i, :3, :3].T @ (seen - views.viewmats[i, :3, 3])
        at = UNITS * TURN.apply(world) + SHIFT
        colour = " ".join(map(str, views.images[i, y, x]))
        track = " ".join(f"{j + 1} {n}" for j in range(len(viewmats)))
        rows.append(f"{n + 1} {at[0]:.9g} {at[1]:.9g} {at[2]:.9g} {colour} 0.5 {track}")
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def points_of(views: synthetic.TrueViews, count: int) -> list[tuple[int, int, int]]:
    """(view, x, y) of `count` background pixels, none of them in the sky."""
    rng = np.random.default_rng(1)
    view, row, column = np.nonzero((views.masks == 0) & np.isfinite(views.depths))
    return [(int(view[i]), int(column[i]), int(row[i])) for i in rng.choice(len(view), count, replace=False)]


def zju(folder: Path, subject: int = 377, moments: int = 6, cameras: int = 3, side: int = 96) -> Made:
    """A ZJU-MoCap sequence with distorted pictures; the truth has a view for each moment and camera, camera by camera.

    Subject 313 has names counted from 1 and a params/ folder; others have new_params/. mask/ lacks the person's upper
    half and mask_cihp/ the lower one.
    """
    model = read_body_model()
    room, rng = synthetic.room_of(3)
    K = pinhole(0.95 * side, side, side) + np.array([[0, 0, 2.5], [0, 3, -1.5], [0, 0, 0]])
    stage = synthetic.Renderer(model, room, rng.uniform(-0.8, 0.8, 10), K)
    orient, pose = person.make_motion(moments, 12.0, rng)
    angles = np.linspace(0, 2, cameras)
    eyes = [np.array([2.6 * np.sin(a), 1.3, 2.6 * np.cos(a)]) for a in angles]
    viewmats = np.stack([look_at(eye, np.array([0, 0.95, 0]), synthetic.UP) for eye in eyes])
    every = np.repeat(viewmats, moments, 0)
    views = stage.views(every, np.tile(orient, (cameras, 1)), np.tile(pose, (cameras, 1)), side, side, lambda n: None)
    made = Made(folder / f"CoreView_{subject}", folder / "truth")
    write_views(made.truth, views, stage.betas)
    first = int(subject in (313, 315))
    paths = [[picture_path(subject, c, m + first) for c in range(cameras)] for m in range(moments)]
    grid = distorting_grid(K, side)
    for m in range(moments):
        for c in range(cameras):
            image, mask = views.images[c * moments + m], views.masks[c * moments + m]
            bent = (cv2.remap(p, *grid, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for p in (image, mask))
            image, mask = bent
            upper = np.arange(side)[:, None] < side // 2
            path = made.folder / paths[m][c]
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, image)
            for kind, half in (("mask", ~upper), ("mask_cihp", upper)):
                path = (made.folder / kind / paths[m][c]).with_suffix(".png")
                path.parent.mkdir(parents=True, exist_ok=True)
                write_mask(path, ((mask > 127) & half).astype(np.uint8))  # labels 0 and 1
    theirs = align_viewmats(viewmats, 1.0, TURN.as_matrix(), SHIFT)
    opencv = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    cams = {
        "K": [opencv.tolist()] * cameras,
        "R": [view[:3, :3].tolist() for view in theirs],
        "T": [(1000 * view[:3, 3:]).tolist() for view in theirs],
        "D": [LENS[:, None].tolist()] * cameras,
    }
    np.save(made.folder / "annots.npy", {"cams": cams, "ims": [{"ims": row, "kpts2d": []} for row in paths]})
    write_params(made.folder / ("params" if first else "new_params"), stage, views, moments, first)
    return made


def picture_path(subject: int, camera: int, number: int) -> str:
    """How a subject's pictures are called."""
    if subject in (313, 315):
        return (
            f"Camera ({camera + 1})/CoreView_{subject}_Camera_({camera + 1})_{number:04d}_2019-08-23_16-08-50.592.jpg"
        )
    return f"Camera_B{camera + 1}/{number:06d}.jpg"


def distorting_grid(K: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a picture through LENS shows what the pinhole picture has, as cv2.remap wants it."""
    whole = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    at = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 1, 2).astype(np.float64)
    straight = cv2.undistortPoints(at, whole, LENS, P=whole).reshape(side, side, 2).astype(np.float32)
    return straight[..., 0], straight[..., 1]


def write_params(folder: Path, stage, views: synthetic.TrueViews, moments: int, first: int) -> None:
    """Rh, Th, poses, shapes of each moment: the posed body turned about the origin, found from vertices, not a formula."""
    folder.mkdir()
    still = np.zeros((moments, 3))

    def vertices(*parts: np.ndarray) -> np.ndarray:
        return stage.body(*(torch.as_tensor(part) for part in (stage.betas, *parts)))[0].numpy()

    rest = vertices(still, views.body_pose[:moments], still)
    world = vertices(views.global_orient[:moments], views.body_pose[:moments], views.transl[:moments])
    for m in range(moments):
        turn = TURN * Rotation.from_rotvec(views.global_orient[m])
        away = TURN.apply(world[m]) + SHIFT - turn.apply(rest[m])
        assert np.ptp(away, axis=0).max() < 1e-9, "a rigid motion takes one to the other"
        poses = np.concatenate([np.zeros(3), views.body_pose[m]])
        arrays = {"Rh": turn.as_rotvec()[None], "Th": away[:1], "poses": poses[None], "shapes": stage.betas[None]}
        rows: dict[str, object] = {key: a.astype(np.float32) for key, a in arrays.items()}
        np.save(folder / f"{m + first}.npy", rows | {"body": "free body"})
