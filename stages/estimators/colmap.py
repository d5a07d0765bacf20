"""COLMAP's features, matches and mappers through pycolmap: the only module that imports it.

pycolmap must come after something that loads the system zlib: imported first, its own static copy answers for the
system's and the next PNG write aborts the process.
"""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see above
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from stages.avatar import lens
from stages.avatar.camera_motion import Pair

SEED = 1  # of every random draw in COLMAP
MATCH_ERROR, LEAST_ERROR = 0.002, 1.0  # of the longer side, and px: COLMAP's 4 px suit photographs, not 480 px frames
CLOSE_ANGLE, CLOSE_INLIERS = 4.0, 30  # degrees, matches; COLMAP begins with 16 and 100, and halves them if no pair fits


@dataclass(frozen=True)
class Model:
    """One reconstruction, and the numbers that tell whether to believe it."""

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
    def points(self) -> int:
        """Number of points; a camera that hardly travels can get poses without any, at an error of 0."""
        return self.reconstruction.num_points3D()

    @property
    def error(self) -> float:
        """Mean reprojection error in px."""
        return self.reconstruction.compute_mean_reprojection_error()

    @property
    def posed(self) -> dict[str, np.ndarray]:
        """Camera from world [3,4] of each frame with a pose, by the frame's name."""
        images = (image for image in self.reconstruction.images.values() if image.has_pose)
        return {image.name.removesuffix(".png"): image.cam_from_world().matrix() for image in images}

    def places(self, names: list[str]) -> np.ndarray:
        """Which of the frames have a pose [C] bool."""
        posed = self.posed
        return np.array([name in posed for name in names])

    def facts(self) -> dict:
        """What sfm.json says of every model that was made."""
        return {
            "registered": self.registered,
            "points": self.points,
            "reprojection_px": round(self.error, 4),
            "focal_px": round(self.focal, 3),
        }


def extract(database: Path, images: Path, masks: Path, files: list[str], features: int, camera: list[float]) -> None:
    """SIFT features of `files` in `images` outside the person, into `database`, for one shared SIMPLE_RADIAL camera.

    `masks` holds a file of the same name for each image, 0 = ignore. `camera` is focal, cx, cy, k, or empty for
    COLMAP's guess of 1.2 times the longer side.
    """
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path, reader.camera_model = str(masks), "SIMPLE_RADIAL"
    reader.camera_params = ",".join(repr(float(value)) for value in camera)
    pycolmap.Database.open(database).close()
    pycolmap.import_images(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, image_names=files, options=reader
    )  # in order, so that identifiers do not depend on which thread is faster
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.sift.max_num_features = False, features
    pycolmap.extract_features(
        database,
        images,
        image_names=files,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def match(database: Path, overlap: int, growing: bool, side: int) -> None:
    """Match and verify each frame with the next `overlap` frames, or, if `growing`, with those 1, 2, 4, 8 ... later.

    `side` is the frames' longer side in px; it scales the error that a verified match may have.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 1  # two threads find other matches from run to run, and no faster
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap, pairing.quadratic_overlap = overlap, growing
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.ransac.max_error = max(MATCH_ERROR * side, LEAST_ERROR)
    pycolmap.match_sequential(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def read_pairs(database: Path, files: list[str]) -> tuple[list[Pair], np.ndarray]:
    """Verified pairs of frames in clip order, and the number of features of each frame [C]."""
    with pycolmap.Database.open(database) as store:
        ids = {image.image_id: files.index(image.name) for image in store.read_all_images()}
        keypoints = {i: store.read_keypoints(i)[:, :2].astype(np.float64) for i in ids}
        pairs = []
        for pair_id, geometry in zip(*store.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            a, b = (keypoints[i][geometry.inlier_matches[:, side]] for side, i in enumerate((first, second)))
            if ids[first] > ids[second]:
                first, second, a, b = second, first, b, a
            if len(a):
                pairs.append(Pair(ids[first], ids[second], a, b))
    counts = np.zeros(len(files), dtype=int)
    for image_id, position in ids.items():
        counts[position] = len(keypoints[image_id])
    return sorted(pairs, key=lambda pair: (pair.first, pair.second)), counts


def map_incremental(
    database: Path, images: Path, out: Path, fixed_focal: bool, registered: Callable[[], None], close: bool = False
) -> list[Model]:
    """Every model that COLMAP's incremental mapper makes; `registered()` is called for each frame it places.

    `close` lets it start with two frames that see their points at CLOSE_ANGLE and share CLOSE_INLIERS of them.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1  # more threads sum in another order
    options.ba_refine_focal_length = not fixed_focal
    if close:
        options.mapper.init_min_tri_angle, options.mapper.init_min_num_inliers = CLOSE_ANGLE, CLOSE_INLIERS
    out.mkdir()
    models = pycolmap.incremental_mapping(database, images, out, options, next_image_callback=registered)
    return [Model(model) for model in models.values()]


def map_global(database: Path, images: Path, out: Path, fixed_focal: bool) -> list[Model]:
    """Every model that COLMAP's global mapper (GLOMAP) makes."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    options.mapper.bundle_adjustment.refine_focal_length = not fixed_focal
    out.mkdir()
    models = pycolmap.global_mapping(database, images, out, options)
    return [Model(model) for model in models.values()]


def points_and_tracks(
    model: pycolmap.Reconstruction,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points of a model: identifiers [P], xyz [P,3], rgb [P,3] uint8, frames that see each [P], mean error px [P]."""
    points = sorted(model.points3D.items())
    return (
        np.array([i for i, _ in points], dtype=np.int64),
        np.array([p.xyz for _, p in points]).reshape(-1, 3),
        np.array([p.color for _, p in points], dtype=np.uint8).reshape(-1, 3),
        np.array([len({e.image_id for e in p.track.elements}) for _, p in points], dtype=int),
        np.array([p.error for _, p in points]),
    )


def triangulation_angles(model: pycolmap.Reconstruction) -> np.ndarray:
    """The widest angle in degrees at which each point of a model is seen, in the order of its identifiers [P]."""
    centers = {i: model.images[i].projection_center() for i in model.reg_image_ids()}
    angles = []
    for _, point in sorted(model.points3D.items()):
        rays = np.array([centers[e.image_id] for e in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        chords = np.linalg.norm(rays[:, None] - rays[None], axis=-1)
        angles.append(np.degrees(2 * np.arcsin(np.clip(chords.max() / 2, 0, 1))))
    return np.array(angles)


def make_pinhole(model: pycolmap.Reconstruction, focal: float) -> None:
    """Replace the model's SIMPLE_RADIAL camera by a centred pinhole of `focal` px, and move its observations along."""
    for camera in model.cameras.values():
        f, cx, cy, k = camera.params
        middle = np.array([camera.width / 2, camera.height / 2])
        for image in model.images.values():
            xy = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            moved = lens.undistort((xy - [cx, cy]) / f, k) * focal + middle
            for point, place in zip(image.points2D, moved, strict=True):
                point.xy = place
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = [focal, focal, *middle]


def empty_model(
    files: list[str], viewmats: np.ndarray, K: np.ndarray, width: int, height: int
) -> pycolmap.Reconstruction:
    """A model with cameras and no points, for a camera that does not travel."""
    model = pycolmap.Reconstruction()
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=1)
    )
    for i, (name, viewmat) in enumerate(zip(files, viewmats, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    return model
