"""Camera files in the layouts of COLMAP, instant-ngp, nerfstudio and NeRF's synthetic scenes, from true cameras.

Each is written in a world turned, moved and scaled against the truth's, so that a transform left out is seen. COLMAP's
files are written by COLMAP itself.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import project
from stages.formats.given_cameras.record import PARAMS
from stages.records import Cameras
from tests.made.worlds import align_viewmats

TURN, SHIFT, UNITS = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([3.0, -1.2, 0.8]), 2.7
LENSES = {
    "SIMPLE_RADIAL": [0.06],
    "RADIAL": [0.06, -0.01],
    "OPENCV": [0.06, -0.01, 0.002, -0.001],
    "OPENCV_FISHEYE": [0.03, -0.01, 0.002, 0.001],
    "FULL_OPENCV": [0.06, -0.01, 0.002, -0.001, 0.01, 0.02, 0.001, 0.0],
    "FOV": [0.6],
    "SIMPLE_RADIAL_FISHEYE": [0.03],
    "RADIAL_FISHEYE": [0.03, -0.01],
    "THIN_PRISM_FISHEYE": [0.03, -0.01, 0.001, -0.001, 0.002, 0.001, 0.001, 0.001],
}


def moved(cameras: Cameras) -> np.ndarray:
    """Their viewmats [C,4,4] in the world of the files."""
    return align_viewmats(cameras.viewmats, UNITS, TURN, SHIFT)


def intrinsics(cameras: Cameras, model: str, scale: float = 1.0) -> list[float]:
    """The numbers of a model for pictures `scale` times as large."""
    K = cameras.Ks[0] * scale
    focal = [K[0, 0]] if PARAMS[model].startswith("f ") else [K[0, 0], K[1, 1]]
    return [*focal, K[0, 2], K[1, 2], *LENSES.get(model, [])]


def colmap(
    folder: Path,
    cameras: Cameras,
    points: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    *,
    text: bool = False,
    model: str = "PINHOLE",
    scale: float = 1.0,
    names: list[str] | None = None,
) -> Path:
    """A model as COLMAP writes it, every point seen in every picture; points in the truth's world."""
    import zlib  # noqa: F401  before pycolmap

    import pycolmap

    folder.mkdir(parents=True, exist_ok=True)
    points = np.zeros((0, 3)) if points is None else points
    made = pycolmap.Reconstruction()
    width, height = round(cameras.width * scale), round(cameras.height * scale)
    params = intrinsics(cameras, model, scale)
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=width, height=height, params=params, camera_id=7)
    )
    names = names or [f"{name}.png" for name in cameras.names]
    for i in reversed(range(len(cameras))):  # COLMAP keeps no order
        xy = project(points, cameras.viewmats[i], cameras.Ks[i])[0] * scale
        image = pycolmap.Image(name=names[i], camera_id=7, image_id=3 * i + 5)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in xy])
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(moved(cameras)[i, :3]))
    for k, point in enumerate(points):
        track = pycolmap.Track()
        for i in range(len(cameras)):
            track.add_element(3 * i + 5, k)
        made.add_point3D(UNITS * TURN @ point + SHIFT, track, np.zeros(3, np.uint8) if colors is None else colors[k])
    made.update_point_3d_errors()
    (made.write_text if text else made.write_binary)(folder)
    return folder


def instant_ngp(path: Path, cameras: Cameras, scale: float = 1.0) -> Path:
    """As instant-ngp's colmap2nerf.py: all numbers at the top, the world's axes exchanged."""
    exchange = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    K, w, h = cameras.Ks[0] * scale, cameras.width * scale, cameras.height * scale
    angles = {f"camera_angle_{k}": 2 * np.arctan(s / 2 / K[i, i]) for i, k, s in ((0, "x", w), (1, "y", h))}
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "k1": 0, "k2": 0, "p1": 0, "p2": 0, "cx": K[0, 2], "cy": K[1, 2]}
    poses = exchange @ opengl(moved(cameras))
    frames = [
        {"file_path": f"./images/{name}.jpg", "sharpness": 50.1, "transform_matrix": pose.tolist()}
        for name, pose in zip(cameras.names, poses, strict=True)
    ]
    return write(path, {**angles, **lens, "w": w, "h": h, "aabb_scale": 16, "frames": frames})


def nerfstudio(path: Path, cameras: Cameras, model: str = "OPENCV") -> Path:
    """As nerfstudio's ns-process-data with several cameras: numbers in each frame, applied_transform, a .ply beside it."""
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    poses = np.vstack([applied, [0, 0, 0, 1]]) @ opengl(moved(cameras))
    keys = ["fl_x", "fl_y", "cx", "cy", "k1", "k2", *(["k3", "k4"] if model == "OPENCV_FISHEYE" else ["p1", "p2"])]
    values = [*intrinsics(cameras, "PINHOLE"), *(LENSES[model] if model == "OPENCV_FISHEYE" else [0.0] * 4)]
    lens = {"w": cameras.width, "h": cameras.height, **dict(zip(keys, values, strict=True)), "camera_model": model}
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": pose.tolist(), "colmap_im_id": i + 1, **lens}
        for i, (name, pose) in enumerate(zip(cameras.names, poses, strict=True))
    ]
    return write(path, {"frames": frames, "applied_transform": applied.tolist(), "ply_file_path": "sparse_pc.ply"})


def blender(path: Path, cameras: Cameras) -> Path:
    """As the synthetic scenes of NeRF: a field of view, no size, names without ending."""
    angle = 2 * np.arctan(cameras.width / 2 / cameras.Ks[0, 0, 0])
    frames = [
        {"file_path": f"./train/r_{int(name)}", "rotation": 0.01, "transform_matrix": pose.tolist()}
        for name, pose in zip(cameras.names, opengl(moved(cameras)), strict=True)
    ]
    return write(path, {"camera_angle_x": angle, "frames": frames})


def opengl(viewmats: np.ndarray) -> np.ndarray:
    """Poses [C,4,4] that take a camera with y up and z backward to the world."""
    return np.linalg.inv(viewmats) * np.array([1, -1, -1, 1])


def write(path: Path, content: dict) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path
