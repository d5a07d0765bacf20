"""The courtyard clip (layout in its README) and a finished run on it, as the family's measures take them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stages.formats.arrays import read_npz
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.facts import Listing, Sfm, read_facts
from stages.formats.images import read_image, read_mask
from stages.formats.landmarks import read_landmarks
from stages.formats.points import read_points
from stages.formats.poses import read_poses
from stages.records import BodyPoses, Cameras
from tests.made.family.evidence import Take, Truth
from tests.made.family.measures import measured
from tests.made.truth import joints_of

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From the clip's axes, z up, to the family's."""


def read_truth(clip: Path, results: Path) -> Truth:
    """The clip's truth under the names of a run's frames, y up; true masks in the size of the run's."""
    facts = json.loads((clip / "cameras.json").read_text())
    index = {frame.name: int(frame.index) for frame in read_facts(results / "frames" / "frames.json", Listing).frames}
    body, names = read_npz(clip / "body.npz"), tuple(index)
    taken, sized = list(index.values()), read_cameras(results / "sfm" / "cameras.npz")
    known = {frame["index"]: np.array(frame["camera_from_world"]) for frame in facts["frames"]}
    viewmats = np.stack([known[i] for i in taken])
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ Y_UP.T
    Ks = np.tile(np.array(facts["K"], float).reshape(3, 3), (len(names), 1, 1))
    orient = (Rotation.from_matrix(Y_UP) * Rotation.from_rotvec(body["global_orient"][taken])).as_rotvec()
    model = read_body_model(clip.parent / "body" / "free_body_smpl.npz")
    poses = BodyPoses(
        names, body["betas"], orient, body["body_pose"][taken], np.zeros((len(names), 3)), np.ones(len(names))
    )
    pelvis = body["joints"][taken, 0] @ Y_UP.T
    poses = replace(poses, transl=pelvis - joints_of(poses, model)[:, 0])
    masks = [_sized(clip / "masks" / f"{index[name]:05d}.png", sized) for name in sized.names]
    return Truth(model, poses, Cameras(names, viewmats, Ks, sized.width, sized.height), masks)


def _sized(path: Path, cameras: Cameras) -> np.ndarray:
    return cv2.resize(read_mask(path), (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)


def read_finished(results: Path) -> Take:
    """What the finished stages give the body fit, as the smpl stage reads it, its landmarks from landmarks.npz."""
    sfm, seen = results / "sfm", read_landmarks(results / "smpl" / "landmarks.npz")
    cameras = read_cameras(sfm / "cameras.npz")
    return Take(
        cameras=cameras,
        times=np.array(read_facts(results / "frames" / "frames.json", Listing).times(cameras.names)),
        images=[read_image(sfm / "images" / f"{name}.png") for name in cameras.names],
        masks=[read_mask(sfm / "masks" / f"{name}.png") for name in cameras.names],
        points=read_points(sfm / "points.ply")[0].astype(np.float64),
        tracks=[seen[name] for name in cameras.names],
        moving=read_facts(sfm / "sfm.json", Sfm).verdict == "moving",
    )


def measure_finished(clip: Path, results: Path) -> dict[str, dict[str, float]]:
    """The measures of the run's own fit, and of its poses after training if it was trained."""
    truth, take, found = read_truth(clip, results), read_finished(results), {}
    model = read_body_model(results / "smpl" / "body_model.npz")
    for stage in ("smpl", "train"):
        path = results / stage / "body.npz"
        if path.exists():
            poses = read_poses(path)
            found[f"courtyard, {stage}"] = measured(poses, model, take.cameras, take.moving, truth, take.masks)
    return found
