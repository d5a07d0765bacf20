"""A real person before three calibrated cameras: joints triangulated from the landmarks of all, against a fit on one alone.

World: metres, as the calibration (Qualisys) has it; all cameras see the same 100 moments.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.estimators.bodyfit.evidence import model_landmarks
from stages.estimators.bodyfit.posed import posed_vertices
from stages.estimators.person.blazepose import NAMES
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.images import read_image, read_mask, write_image
from stages.formats.points import write_points
from stages.records import Cameras
from tests.made.family.evidence import Take, find_person, fit_take, read_tracks

VIEWS = ("cam01", "cam02", "cam03")
EVERY, RATE, SIZE = 4, 60.0, 0.5
"""Which frames are taken, frames a second of the videos, and what the pictures are made smaller by."""
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = tuple(f"{side}_{part}" for part in PARTS for side in ("left", "right"))
GROUPS = (("shoulder", "hip"), ("elbow", "wrist"), ("knee", "ankle"))
HIPS = [JOINTS.index("left_hip"), JOINTS.index("right_hip")]
FAR = 25.0
"""Px of the full pictures from which a triangulated joint is no joint that all agree on."""


@dataclass(frozen=True)
class Lens:
    """One calibrated camera: `viewmat` [4,4] camera_from_world in m, `K` [3,3] px, `distortion` [4] k1 k2 p1 p2."""

    viewmat: np.ndarray
    K: np.ndarray
    distortion: np.ndarray


def read_calibration(path: Path) -> dict[str, Lens]:
    """The cameras of a Qualisys file by name: 1/64 px and mm there, y up and z back in the camera."""
    found = {}
    for camera in xml.parse(path).getroot().iter("camera"):
        place, lens = (
            {key: float(value) for key, value in camera.find(part).attrib.items()}
            for part in ("transform", "intrinsic")
        )
        axes = np.array([[place[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.diag([1.0, -1, -1]) @ axes
        viewmat[:3, 3] = -viewmat[:3, :3] @ [place[axis] / 1000 for axis in "xyz"]
        K = np.array(
            [
                [lens["focalLengthU"], 0, lens["centerPointU"]],
                [0, lens["focalLengthV"], lens["centerPointV"]],
                [0, 0, 64],
            ]
        )
        names = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        found[camera.attrib["serial"]] = Lens(viewmat, K / 64, np.array([lens[name] for name in names]))
    return found


def make_treadmill(folder: Path, clip: Path) -> None:
    """Write a clip's folder for each of VIEWS as `evidence` has it, without truth: pictures without distortion, half the size."""
    lenses = read_calibration(clip / "Calib.qca.txt")
    for view in VIEWS:
        at, lens = folder / view, lenses[view]
        (at / "images").mkdir(parents=True, exist_ok=True)
        names, K = [], np.diag([SIZE, SIZE, 1]) @ lens.K
        video, i = cv2.VideoCapture(str(clip / f"{view}.mp4")), 0
        while (read := video.read())[0]:
            if i % EVERY == 0:
                names.append(f"{i:06d}")
                plain = cv2.undistort(read[1], lens.K, lens.distortion)
                small = cv2.resize(plain, None, fx=SIZE, fy=SIZE, interpolation=cv2.INTER_AREA)
                write_image(at / "images" / f"{names[-1]}.png", small[..., ::-1].copy())
            i += 1
        height, width = small.shape[:2]
        still = np.tile(np.eye(4), (len(names), 1, 1))
        write_cameras(at / "cameras.npz", Cameras(tuple(names), still, np.tile(K, (len(names), 1, 1)), width, height))
        write_points(at / "points.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        find_person(at, names)
    (folder / "facts.json").write_text(json.dumps({"fps": RATE / EVERY, "moving": False}) + "\n")


def triangulated(folder: Path, clip: Path) -> tuple[np.ndarray, np.ndarray]:
    """JOINTS [F,12,3] m in the frame of cam01 from the landmarks in all views, and by how many px they miss on average [F,12].

    Where one view has left and right of a pair of GROUPS the other way around than the two others, it is turned back; where
    all of them have in a frame, against most frames, all are.
    """
    lenses = read_calibration(clip / "Calib.qca.txt")
    first = np.linalg.inv(lenses[VIEWS[0]].viewmat)
    columns = [NAMES.index(name) for name in JOINTS]
    cameras, spots, sure = [], [], []
    for view in VIEWS:
        K, tracks = read_cameras(folder / view / "cameras.npz").Ks[0], read_tracks(folder / view)
        cameras.append(K @ (lenses[view].viewmat @ first)[:3])
        spots.append([np.full((12, 2), np.nan) if pose is None else pose.xy[columns] for pose in tracks])
        sure.append([np.zeros(12) if pose is None else pose.visibility[columns] for pose in tracks])
    P, xy, weight = np.stack(cameras), np.stack(spots), np.stack(sure).clip(0.05)
    points, missed = _meet(P, xy, weight)
    for group in GROUPS:
        at = [j for j, name in enumerate(JOINTS) if name.partition("_")[2] in group]
        other = [j ^ 1 for j in at]
        best = missed[:, at].mean(1)
        for view in range(len(VIEWS)):
            turned_xy, turned_weight = xy.copy(), weight.copy()
            turned_xy[view, :, at], turned_weight[view, :, at] = xy[view, :, other], weight[view, :, other]
            found, off = _meet(P, turned_xy, turned_weight)
            better = off[:, at].mean(1) < best
            best = np.where(better, off[:, at].mean(1), best)
            rows = np.ix_(better, at)
            points[rows], missed[rows] = found[rows], off[rows]
        turned = _turned(points[:, at], points[:, other])
        for values in (points, missed):
            values[np.ix_(turned, at)] = values[np.ix_(turned, other)]
    return points, missed


def _turned(points: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The frames [F] in which `points` [F,J,3] are the `other` side's: going from frame to frame, against most of them."""
    both, side, last = np.stack([points, other], 1), [0], points[0]
    for i in range(1, len(points)):
        away = np.linalg.norm(both[i] - last, axis=-1)
        side.append(int(np.nansum(away, 1).argmin()))
        last = np.where(np.isfinite(both[i, side[-1]]), both[i, side[-1]], last)
    found = np.array(side) == 1
    return found if found.mean() <= 0.5 else ~found


def _meet(P: np.ndarray, xy: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [F,J,3] nearest to what cameras P [V,3,4] see at `xy` [V,F,J,2], by DLT, and their mean miss in px [F,J]."""
    rows = weight[..., None, None] * (xy[..., None] * P[:, None, None, 2:3] - P[:, None, None, :2])
    rows = np.moveaxis(rows, 0, 2).reshape(*xy.shape[1:3], -1, 4)
    points = np.full((*xy.shape[1:3], 3), np.nan)
    known = np.isfinite(rows).all((2, 3))
    solved = np.linalg.svd(rows[known])[2][:, -1]
    points[known] = solved[:, :3] / solved[:, 3:]
    seen = np.einsum("vij,fkj->vfki", P, np.concatenate([points, np.ones_like(points[..., :1])], -1))
    return points, np.linalg.norm(seen[..., :2] / seen[..., 2:] - xy, axis=-1).mean(0)


def measure_treadmill(folder: Path, clip: Path) -> dict[str, float]:
    """How far in cm the fit on cam01 alone is from the triangulated joints, hips on hips: mean, worst frame, the mean of each part;
    and how many px the triangulated ones miss the landmarks by."""
    if not (folder / "facts.json").exists():
        make_treadmill(folder, clip)
    at = folder / VIEWS[0]
    cameras = read_cameras(at / "cameras.npz")
    times = np.array([int(name) for name in cameras.names]) / RATE
    masks = [read_mask(at / "masks" / f"{name}.png") for name in cameras.names]
    images = [read_image(at / "images" / f"{name}.png") for name in cameras.names]
    model = read_body_model()
    fit, _ = fit_take(Take(cameras, times, images, masks, np.zeros((0, 3)), read_tracks(at), False), model)
    names, regressor = model_landmarks(model)
    chosen = regressor[[names.index(name) for name in JOINTS]]
    found = np.stack([chosen @ vertices for vertices in posed_vertices(model, fit.poses)])
    wanted, missed = triangulated(folder, clip)
    gap = found - found[:, HIPS].mean(1, keepdims=True) - (wanted - wanted[:, HIPS].mean(1, keepdims=True))
    each = 100 * np.where(missed < FAR * SIZE, np.linalg.norm(gap, axis=-1), np.nan)
    parts = {part: np.nanmean(each[:, [j for j, name in enumerate(JOINTS) if part in name]]) for part in PARTS}
    depth = 100 * np.nanmean(np.where(missed < FAR * SIZE, gap[..., 2], np.nan)[:, [0, 1]])
    summary = {
        "joints": np.nanmean(each),
        "worst frame": np.nanmax(np.nanmean(each, 1)),
        "shoulders along the view": depth,
    }
    used = {"triangulated, px off": np.nanmedian(missed) / SIZE, "used, %": 100 * np.isfinite(each).mean()}
    return {key: float(value) for key, value in (summary | parts | used).items()}
