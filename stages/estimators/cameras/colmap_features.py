"""COLMAP's database of features and verified matches, through pycolmap."""

from __future__ import annotations

import os
import zlib  # noqa: F401  before pycolmap, see colmap.py
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from stages.estimators.cameras.colmap import pinhole_params
from stages.estimators.cameras.features import nearest, neighbours, sift
from stages.estimators.cameras.motion import Pair
from stages.formats.images import read_image, read_mask

SEED = 1  # of the trials
MATCH_ERROR, LEAST_ERROR = 0.002, 1.0  # of the longer side, and px: COLMAP's 4 px suit photographs, not 480 px frames
TRIALS = 30, 1.5  # at least, and how many times as many as needed; COLMAP's 100 and 3 find 0.4 % more matches
NO_GEOMETRY = pycolmap.TwoViewGeometry()


def extract(
    database: Path,
    images: Path,
    masks: Path,
    files: list[str],
    features: int,
    camera: list[float],
    model: str = "SIMPLE_RADIAL",
    shared: bool = True,
    extracted: Callable[[int], None] = lambda done: None,
) -> None:
    """SIFT features of `files` in `images` outside the person, into `database`, for one camera, or one a file.

    `masks` holds a file of the same name for each image, 0 = ignore. `camera` has the numbers of its `model` (focal,
    cx, cy, k), or none for COLMAP's guess of 1.2 times the longer side. `extracted(done)` is called after each file.
    """
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = model
    reader.camera_params = ",".join(repr(float(value)) for value in camera)
    mode = pycolmap.CameraMode.SINGLE if shared else pycolmap.CameraMode.PER_IMAGE
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, camera_mode=mode, image_names=files, options=reader)

    def found(file: str) -> tuple[str, np.ndarray, np.ndarray]:
        grey = cv2.cvtColor(read_image(images / file), cv2.COLOR_RGB2GRAY)
        return file, *sift(grey, read_mask(masks / file), features)

    with pycolmap.Database.open(database) as store, one_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
        stored = {image.name: image.image_id for image in store.read_all_images()}
        for done, (file, spots, descriptors) in enumerate(pool.map(found, files), 1):
            store.write_keypoints(stored[file], spots)
            kind = pycolmap.FeatureExtractorType.SIFT
            store.write_descriptors(stored[file], pycolmap.FeatureDescriptors(kind, descriptors))
            extracted(done)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV compute on one thread: where each picture has one already, they get into each other's way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def match(database: Path, overlap: int, growing: bool, side: int) -> None:
    """Match and verify each frame with the next `overlap` frames, or, if `growing`, with those 1, 2, 4, 8 ... later.

    `side` is the frames' longer side in px; it scales the error that a verified match may have.
    """
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)  # on all cores; the mapper takes one
    options.ransac.random_seed = SEED
    options.ransac.min_num_trials, options.ransac.dyn_num_trials_multiplier = TRIALS
    options.ransac.max_error = max(MATCH_ERROR * side, LEAST_ERROR)
    with pycolmap.Database.open(database) as store, ThreadPoolExecutor(os.cpu_count()) as pool:
        images = sorted(store.read_all_images(), key=lambda image: image.name)
        ids, cameras = [image.image_id for image in images], [store.read_camera(image.camera_id) for image in images]
        spots = [store.read_keypoints(i)[:, :2].astype(np.float64) for i in ids]
        descriptors = [store.read_descriptors(i).data for i in ids]

        def matched(pair: tuple[int, int]) -> tuple[np.ndarray, pycolmap.TwoViewGeometry]:
            a, b = pair
            found = nearest(descriptors[a], descriptors[b])
            geometry = pycolmap.estimate_two_view_geometry(cameras[a], spots[a], cameras[b], spots[b], found, options)
            return found, geometry if len(geometry.inlier_matches) >= options.min_num_inliers else NO_GEOMETRY

        pairs = [(a, b) for a, b in neighbours(len(ids), overlap, growing) if not store.exists_matches(ids[a], ids[b])]
        with pycolmap.DatabaseTransaction(store):
            for (a, b), (found, geometry) in zip(pairs, pool.map(matched, pairs), strict=True):
                store.write_matches(ids[a], ids[b], found)
                store.write_two_view_geometry(ids[a], ids[b], geometry)


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


def set_pinholes(database: Path, Ks: np.ndarray) -> None:
    """Give each of a database's cameras, one a file in order, its own pinhole."""
    with pycolmap.Database.open(database) as store:
        for camera, K in zip(sorted(store.read_all_cameras(), key=lambda c: c.camera_id), Ks, strict=True):
            camera.params = pinhole_params(K)
            store.update_camera(camera)
