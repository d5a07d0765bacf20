"""How far a result is from the synthetic clip's truth, and the truth told in a result's own world.

SfM fixes no scale and no axes, so all comparisons first find the similarity truth ~ scale * R @ result + t that best
takes the result's cameras to the true ones; distances are then in the truth's metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.images import read_image, read_mask
from stages.formats.poses import read_poses, write_poses
from stages.records import BodyModel, BodyPoses, Cameras
from tests.made.worlds import align_viewmats


@dataclass(frozen=True)
class Similarity:
    """truth = scale * R @ result + t."""

    scale: float
    R: np.ndarray
    t: np.ndarray

    def to_truth(self, points: np.ndarray) -> np.ndarray:
        """Points [...,3] of the result's world in the truth's."""
        return self.scale * points @ self.R.T + self.t

    def to_result(self, points: np.ndarray) -> np.ndarray:
        """Points [...,3] of the truth's world in the result's."""
        return (points - self.t) @ self.R / self.scale


@dataclass(frozen=True)
class CameraErrors:
    """Of registered cameras: centre error in m (mean and largest), path length to compare with, turn, focal."""

    registered: float
    centre: float
    worst: float
    extent: float
    turn_degrees: float
    focal: float


def rows(names: tuple[str, ...], known: tuple[str, ...]) -> list[int]:
    """Where each of `names` stands in `known`."""
    where = {name: i for i, name in enumerate(known)}
    return [where[name] for name in names]


def align(result: Cameras, truth: Cameras, world_from_sfm: float = 1.0) -> Similarity:
    """The similarity that takes the result's world (SfM units times `world_from_sfm`) to the truth's.

    The turn comes from the cameras' own orientations, scale and place from their centres: a hand-held path is nearly a
    line, about which centres alone leave the world to turn (0.8 degrees on seed 1, 4 cm at the person).
    """
    order = rows(result.names, truth.names)
    u, _, vt = np.linalg.svd((truth.viewmats[order, :3, :3].mT @ result.viewmats[:, :3, :3]).sum(0))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    found, wanted = result.centers * world_from_sfm, truth.centers[order]
    turned = (found - found.mean(0)) @ R.T
    scale = float((turned * (wanted - wanted.mean(0))).sum() / (turned**2).sum())
    return Similarity(scale, R, wanted.mean(0) - scale * R @ found.mean(0))


def camera_errors(result: Cameras, truth: Cameras, frames: int) -> CameraErrors:
    """How far SfM cameras are from the truth after alignment; `frames` is how many SfM was given."""
    order, similarity = rows(result.names, truth.names), align(result, truth)
    centres = truth.centers[order]
    gap = np.linalg.norm(similarity.to_truth(result.centers) - centres, axis=1)
    turned = result.viewmats[:, :3, :3] @ similarity.R.T @ truth.viewmats[order, :3, :3].mT
    return CameraErrors(
        registered=len(result) / frames,
        centre=float(gap.mean()),
        worst=float(gap.max()),
        extent=float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()),
        turn_degrees=float(np.degrees(Rotation.from_matrix(turned).magnitude().mean())),
        focal=float(abs(result.Ks[:, 0, 0] / result.width / truth.Ks[order, 0, 0] * truth.width - 1).mean()),
    )


def joints_of(poses: BodyPoses, model: BodyModel) -> np.ndarray:
    """Joints [F,24,3] in the world of `poses`."""
    body = Body(model, dtype=torch.float64)
    arrays = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    return body(*(torch.as_tensor(array, dtype=torch.float64) for array in arrays))[1].numpy()


def joint_errors(
    result: BodyPoses, truth: BodyPoses, similarity: Similarity, result_model: BodyModel, truth_model: BodyModel
) -> tuple[float, float]:
    """Mean joint error in m: in the world, and with both pelvises put together (orientation and size untouched)."""
    found = similarity.to_truth(joints_of(result, result_model))
    wanted = joints_of(truth, truth_model)[rows(result.names, truth.names)]
    about = (found - found[:, :1]) - (wanted - wanted[:, :1])
    return tuple(float(np.linalg.norm(gap, axis=-1).mean()) for gap in (found - wanted, about))


def mask_ious(found: Path, truth: Path) -> np.ndarray:
    """Intersection over union of every mask of the folder `found` with the true mask of its name, shrunk to its size."""
    ious = []
    for path in sorted(found.glob("*.png")):
        mask = read_mask(path)
        a, b = (
            mask > 127,
            cv2.resize(read_mask(truth / path.name), mask.shape[::-1], interpolation=cv2.INTER_AREA) > 127,
        )
        ious.append((a & b).sum() / (a | b).sum())
    return np.array(ious)


def in_result_world(folder: Path, similarity: Similarity, fitted: BodyPoses, model: BodyModel, truth_model: BodyModel):
    """True cameras and poses of `folder` in the result's world, for the result's own body: (Cameras, BodyPoses).

    The body keeps the result's shape; its pelvis comes to stand where the true one does.
    """
    cameras, poses = read_cameras(folder / "cameras.npz"), read_poses(folder / "body.npz")
    inverse = 1 / similarity.scale, similarity.R.T, -similarity.R.T @ similarity.t / similarity.scale
    turned = Rotation.from_matrix(similarity.R.T) * Rotation.from_rotvec(poses.global_orient)
    pelvis = similarity.to_result(joints_of(poses, truth_model)[:, 0])
    moved = replace(
        poses,
        betas=fitted.betas,
        global_orient=turned.as_rotvec(),
        transl=np.zeros_like(poses.transl),
        world_from_sfm=fitted.world_from_sfm,
    )
    moved = replace(moved, transl=pelvis - joints_of(moved, model)[:, 0])
    return replace(cameras, viewmats=align_viewmats(cameras.viewmats, *inverse)), moved


def tell_novel_poses(results: Path, truth: Path, out: Path) -> tuple[str, ...]:
    """Write the truth's novel cameras and poses in a result's world: cameras.npz and poses.npz in `out`; their names."""
    fitted, model = read_poses(results / "train" / "body.npz"), read_body_model(results / "smpl" / "body_model.npz")
    cameras = read_cameras(results / "sfm" / "cameras.npz"), read_cameras(truth / "cameras.npz")
    similarity = align(*cameras, fitted.world_from_sfm)
    views, poses = in_result_world(truth / "novel", similarity, fitted, model, read_body_model())
    write_cameras(out / "cameras.npz", views)
    write_poses(out / "poses.npz", poses)
    return views.names


def novel_psnr(found: Path, truth: Path, names: tuple[str, ...]) -> tuple[float, float]:
    """Mean PSNR in dB of the pictures of novel poses in `found`, whole and in the person's tight box."""
    full, crop = [], []
    for name in names:
        pictures = [read_image(folder / f"{name}.png") for folder in (found, truth / "novel" / "images")]
        box = box_of(read_mask(truth / "novel" / "masks" / f"{name}.png"))
        full.append(psnr(*pictures))
        crop.append(psnr(*(picture[box] for picture in pictures)))
    return float(np.mean(full)), float(np.mean(crop))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise ratio in dB of uint8 pictures."""
    return float(10 * np.log10(255**2 / np.square(a.astype(float) - b).mean()))


def box_of(mask: np.ndarray) -> tuple[slice, slice]:
    """The tight box around a mask."""
    down, right = (np.flatnonzero((mask > 127).any(axis)) for axis in (1, 0))
    return slice(down[0], down[-1] + 1), slice(right[0], right[-1] + 1)
