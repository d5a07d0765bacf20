"""COLMAP's mappers and models through pycolmap: with `colmap_features` and `colmap_lens` the only module that imports it.

pycolmap must come after something that loads the system zlib: imported first, its own static copy answers for the
system's and the next PNG write aborts the process.
"""

from __future__ import annotations

import math
import zlib  # noqa: F401  before pycolmap, see above
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from stages.avatar.cameras import lens
from stages.formats.given_cameras.record import Lens, possible_errors, widest_angles

SEED = 1  # of every random draw of a mapper
TRACKS = 100  # longest tracks a frame to map with; all take three times as long, and are as far off once refined
TOLERANCE = 3e-4  # of the cost: smaller changes end the global mapper's adjustments; 1e-4 takes 20 % longer
STRAY = 2.03  # times the middle point's error: Cauchy's 2.385 standard deviations; farther matches hardly pull
LEAST_STRAY = 0.1  # px: finer than SIFT's places are
CLOSER = 3e-4  # of the cost: where `adjust_again` ends
ADJUSTMENTS = 8  # bundle adjustments of the global mapper, of which each gets this part of its time
DENSE = 200  # frames; up to so many, the solver takes each pair of frames to share points: nearly all do
CLOSE_ANGLE, CLOSE_INLIERS = 4.0, 30  # degrees, matches; COLMAP begins with 16 and 100, and halves them if no pair fits


@dataclass(frozen=True)
class Model:
    """One reconstruction, and the numbers by which its quality is judged."""

    reconstruction: pycolmap.Reconstruction

    @property
    def registered(self) -> int:
        """Number of frames with a pose."""
        return self.reconstruction.num_reg_images()

    @property
    def focal(self) -> float:
        """Focal length of the shared camera in px."""
        return float(next(iter(self.reconstruction.cameras.values())).params[0])

    @property
    def lenses(self) -> dict[str, np.ndarray]:
        """Focal length, cx, cy (px) and k of each frame with a pose [4], by the frame's name."""
        images, cameras = self.reconstruction.images.values(), self.reconstruction.cameras
        return {image.name.removesuffix(".png"): cameras[image.camera_id].params for image in images if image.has_pose}

    @property
    def points(self) -> int:
        """Number of points; a camera that hardly travels can get poses without any, at an error of 0."""
        return self.reconstruction.num_points3D()

    @property
    def errors(self) -> np.ndarray:
        """Reprojection errors of the points [P] px."""
        camera, points = next(iter(self.reconstruction.cameras.values())), self.reconstruction.points3D.values()
        return possible_errors(np.array([point.error for point in points]), camera.width, camera.height)

    @property
    def error(self) -> float:
        """Mean reprojection error in px."""
        return float(self.errors.mean()) if self.points else 0.0

    @property
    def middle_error(self) -> float:
        """Median of the points' reprojection errors in px."""
        return float(np.median(self.errors))

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """Camera from world [3,4] of each frame with a pose, by the frame's name."""
        images = (image for image in self.reconstruction.images.values() if image.has_pose)
        return {image.name.removesuffix(".png"): image.cam_from_world().matrix() for image in images}

    def placed_frames(self, names: list[str]) -> np.ndarray:
        """Which of the frames have a pose [C] bool."""
        poses = self.poses
        return np.array([name in poses for name in names])

    def facts(self) -> dict:
        """What sfm.json says of every model that was made."""
        return {
            "registered": self.registered,
            "points": self.points,
            "reprojection_px": round(self.error, 4),
            "focal_px": round(self.focal, 3),
        }


def map_incremental(
    database: Path,
    images: Path,
    out: Path,
    fixed_focal: bool,
    registered: Callable[[], None],
    limit: float,
    close: bool = False,
) -> list[Model]:
    """Every model that COLMAP's incremental mapper makes; `registered()` is called for each frame it places.

    `close` lets it start with two frames that see their points at CLOSE_ANGLE and share CLOSE_INLIERS of them. After
    `limit` seconds it stops with what it has.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1  # more threads sum in another order
    options.ba_refine_focal_length = not fixed_focal
    options.max_runtime_seconds = math.ceil(limit)
    if close:
        options.mapper.init_min_tri_angle, options.mapper.init_min_num_inliers = CLOSE_ANGLE, CLOSE_INLIERS
    out.mkdir()
    models = pycolmap.incremental_mapping(database, images, out, options, next_image_callback=registered)
    return [Model(model) for model in models.values()]


def map_global(database: Path, images: Path, out: Path, count: int, fixed_focal: bool, limit: float) -> list[Model]:
    """Every model that COLMAP's global mapper (GLOMAP) makes of `count` frames in about `limit` seconds at most."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    options.decompose_relative_pose = False  # the matches have them
    options.mapper.track_required_tracks_per_view = TRACKS
    options.mapper.ba_num_iterations = 1  # two more do not change a pose by a thousandth of the path
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = not fixed_focal
    adjustment.ceres.solver_options.function_tolerance = TOLERANCE
    adjustment.ceres.solver_options.max_solver_time_in_seconds = limit / ADJUSTMENTS
    if count <= DENSE:
        adjustment.ceres.solver_options.linear_solver_type = "DENSE_SCHUR"  # type: ignore[assignment]  # takes names
    out.mkdir()
    models = pycolmap.global_mapping(database, images, out, options)
    return [Model(model) for model in models.values()]


def robust(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentOptions:
    """Options to adjust a model so that matches far off hardly pull, by its own errors; it must begin near the end.

    Shadows and clothes give matches that move. COLMAP's loss (Huber's, 1 px) lets them pull cameras twice as far off; this one
    (Cauchy's) has false ends, but not near the right one. Source: Huber and Ronchetti, Robust Statistics, 2009; Zhang 1997.
    """
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    if model.num_points3D():
        options.ceres.loss_function_scale = max(STRAY * Model(model).middle_error, LEAST_STRAY)
    options.ceres.solver_options.num_threads = 1  # more threads sum in another order
    return options


def adjust_again(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Adjust a model by `robust` options to CLOSER, its points' errors with it."""
    options.ceres.solver_options.function_tolerance = CLOSER
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def refine(model: Model, fixed_focal: bool) -> None:
    """Adjust all cameras and points of a model that a mapper made once more, by `robust`."""
    options = robust(model.reconstruction)
    options.refine_focal_length = not fixed_focal
    adjust_again(model.reconstruction, options)


@dataclass(frozen=True)
class Cloud:
    """Points of a model: `ids` [P], `xyz` [P,3], `rgb` [P,3] uint8, mean `errors` [P] px.

    `lengths` [P] pictures see each, at `angles` [P] degrees at most; `tracks` are the rows of those that are frames.
    """

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    errors: np.ndarray
    lengths: np.ndarray
    angles: np.ndarray
    tracks: tuple[np.ndarray, ...]


def cloud_of(model: pycolmap.Reconstruction, files: list[str]) -> Cloud:
    """The points of a model with tracks as rows of `files`, in the order of their identifiers."""
    row = {name: i for i, name in enumerate(files)}
    rows = {i: row[model.images[i].name] for i in model.reg_image_ids()}
    centers = np.zeros((len(files), 3))
    for i, k in rows.items():
        centers[k] = model.images[i].projection_center()
    points = sorted(model.points3D.items())
    xyz = np.array([p.xyz for _, p in points]).reshape(-1, 3)
    tracks = [np.array(sorted({rows[e.image_id] for e in p.track.elements}), dtype=np.int64) for _, p in points]
    return Cloud(
        ids=np.array([i for i, _ in points], dtype=np.int64),
        xyz=xyz,
        rgb=np.array([p.color for _, p in points], dtype=np.uint8).reshape(-1, 3),
        errors=np.array([p.error for _, p in points]),
        lengths=np.array([len(track) for track in tracks], dtype=int),
        angles=widest_angles(xyz, tracks, centers),
        tracks=tuple(tracks),
    )


def triangulate(
    database: Path,
    images: Path,
    out: Path,
    files: list[str],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    size: tuple[int, int],
) -> pycolmap.Reconstruction:
    """Points from the matches in `database`, with cameras that are known and stay as they are.

    `files` were extracted in this order with model PINHOLE, with one camera a file if `Ks` differ.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    out.mkdir()
    model = posed_model(files, viewmats, Ks, *size)
    return pycolmap.triangulate_points(model, database, images, out, options=options)


def camera_of(lens: Lens) -> pycolmap.Camera:
    """COLMAP's camera for a lens."""
    return pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))


def pinhole_params(K: np.ndarray) -> list[float]:
    """fx, fy, cx, cy of K [3,3]."""
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def make_pinhole(model: pycolmap.Reconstruction, focals: dict[str, float]) -> None:
    """Replace the model's SIMPLE_RADIAL cameras by centred pinholes, and move their observations along.

    `focals` has each picture's new focal length in px by its name; pictures of one camera have the same.
    """
    by_camera = {image.camera_id: focals[image.name] for image in model.images.values() if image.name in focals}
    lenses = {i: tuple(model.cameras[i].params) for i in by_camera}
    for i, focal in by_camera.items():
        camera = model.cameras[i]
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = [focal, focal, camera.width / 2, camera.height / 2]
    for image in model.images.values():
        f, cx, cy, k = lenses[image.camera_id]
        xy = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        focal, _, *middle = model.cameras[image.camera_id].params
        moved = lens.undistort((xy - [cx, cy]) / f, k) * focal + middle
        for point, place in zip(image.points2D, moved, strict=True):
            point.xy = place


def posed_model(
    files: list[str], viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int
) -> pycolmap.Reconstruction:
    """A model with cameras and no points; identifiers count from 1, with one camera in all if all `Ks` are the same."""
    model = pycolmap.Reconstruction()
    shared = bool((Ks == Ks[0]).all())
    for i, K in enumerate(Ks[:1] if shared else Ks, 1):
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=pinhole_params(K), camera_id=i)
        model.add_camera_with_trivial_rig(camera)
    for i, (name, viewmat) in enumerate(zip(files, viewmats, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1 if shared else i, image_id=i)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    return model


def add_points(model: pycolmap.Reconstruction, cloud: Cloud, keep: np.ndarray) -> None:
    """Put points of another model into one with cameras only; without tracks, as their features are missing."""
    for xyz, rgb in zip(cloud.xyz[keep], cloud.rgb[keep], strict=True):
        model.add_point3D(xyz, pycolmap.Track(), rgb)
