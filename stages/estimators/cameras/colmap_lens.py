"""How well a COLMAP model fixes its lens, the model with another lens, and as a bundle for `adjustment.py` and back."""

from __future__ import annotations

import math
import zlib  # noqa: F401  before pycolmap, see colmap.py

import numpy as np
import pycolmap

from stages.estimators.cameras.adjustment import Bundle, Observations, rolled
from stages.estimators.cameras.colmap import adjust_again, robust

HALF, SOME = 6, 800  # pictures of half a clip at least; points that its focal length is taken from


def lens_covariance(model: pycolmap.Reconstruction) -> np.ndarray | None:
    """Covariance [2,2] of focal length (px) and k of a model's one SIMPLE_RADIAL camera, for points that are 1 px off.

    Poses and points are free as well. None where the equations do not determine it.
    """
    model = pycolmap.Reconstruction(model)  # the adjuster normalises what it holds
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    for i in model.reg_image_ids():
        config.add_image(i)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    camera = next(iter(model.cameras.values()))
    return None if found is None else found.get_other_params_cov(camera.params)


def half_focals(model: pycolmap.Reconstruction) -> tuple[float, float] | None:
    """Focal lengths in px that the first and the second half of a model's pictures have by themselves; None with few."""
    order = _in_order(model)
    found = []
    for half in (order[: len(order) // 2], order[len(order) // 2 :]):
        if len(half) < HALF:
            return None
        part = pycolmap.Reconstruction(model)
        points = sorted(part.point3D_ids())
        for point in set(points) - set(points[:: math.ceil(len(points) / SOME)]):
            part.delete_point3D(point)
        for i in order:
            if i not in half:
                part.deregister_frame(part.images[i].frame_id)
        options = robust(model)
        options.ceres.solver_options.max_num_iterations = 15
        pycolmap.bundle_adjustment(part, options)
        found.append(float(next(iter(part.cameras.values())).params[0]))
    return found[0], found[1]


def hold_lens(model: pycolmap.Reconstruction, focal: float, k: float) -> None:
    """Give a model's one SIMPLE_RADIAL camera this lens, and adjust poses and points to it."""
    for camera in model.cameras.values():
        camera.params = [focal, *camera.params[1:3], k]
    plain = pycolmap.BundleAdjustmentOptions(print_summary=False)  # another lens may be far from the end
    plain.ceres.solver_options.num_threads = 1  # more threads sum in another order
    plain.refine_focal_length = plain.refine_extra_params = False
    pycolmap.bundle_adjustment(model, plain)
    model.update_point_3d_errors()
    options = robust(model)
    options.refine_focal_length = options.refine_extra_params = False
    adjust_again(model, options)


def straighten(model: pycolmap.Reconstruction) -> None:
    """Take the bend out of a model's one SIMPLE_RADIAL camera, and adjust its focal length, poses and points to that."""
    for camera in model.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    options = robust(model)
    options.refine_extra_params = False
    adjust_again(model, options)


def bundle_of(
    model: pycolmap.Reconstruction, size: tuple[int, int], most: int
) -> tuple[Bundle, Observations, list[int]]:
    """The cameras of a model with one SIMPLE_RADIAL lens, in the order of their names, and those of its points seen longest.

    Of these there are `most` at most; also returns the identifiers of the points.
    """
    rows = {i: row for row, i in enumerate(_in_order(model))}
    longest = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))[:most]
    seen: dict[tuple[int, int], np.ndarray] = {}
    for row, (_, point) in enumerate(longest):
        for element in point.track.elements:
            seen.setdefault(
                (row, rows[element.image_id]), model.images[element.image_id].points2D[element.point2D_idx].xy
            )
    viewmats = np.tile(np.eye(4), (len(rows), 1, 1))
    viewmats[:, :3] = [model.images[i].cam_from_world().matrix() for i in rows]
    focal, _, _, k = next(iter(model.cameras.values())).params
    point, frame = np.array(list(seen)).T
    places = np.array([[*point.xyz, 1.0] for _, point in longest])
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    bundle = Bundle(viewmats, places, np.log([focal]), float(k))
    return bundle, Observations(frame, point, np.array(list(seen.values())), size), [i for i, _ in longest]


def model_of(files: list[str], colors: np.ndarray, bundle: Bundle, seen: Observations) -> pycolmap.Reconstruction:
    """A model of the bundle's pictures `files` and points with `colors` [T,3]; a camera for each if the focal length changes.

    What a frame sees is moved to where its middle row's camera sees it.
    """
    new, focals, middle = pycolmap.Reconstruction(), bundle.focals, np.array(seen.size) / 2
    shared = bool((focals == focals[0]).all())
    for i, focal in enumerate(focals[:1] if shared else focals, 1):
        params = [focal, *middle, bundle.k]
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=seen.size[0], height=seen.size[1], params=params, camera_id=i
        )
        new.add_camera_with_trivial_rig(camera)
    still = seen.xy - rolled(bundle, seen)
    place = np.zeros(len(seen.frame), int)
    for i, (file, viewmat) in enumerate(zip(files, bundle.viewmats, strict=True)):
        here = seen.frame == i
        place[here] = np.arange(here.sum())
        image = pycolmap.Image(name=file, camera_id=1 if shared else i + 1, image_id=i + 1, keypoints=still[here])
        new.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    tracks = [pycolmap.Track() for _ in bundle.points]
    for point, frame, index in zip(seen.point, seen.frame, place, strict=True):
        tracks[point].add_element(int(frame) + 1, int(index))
    for place, track, color in zip(bundle.points, tracks, colors, strict=True):
        new.add_point3D(place[:3] / place[3], track, color)
    new.update_point_3d_errors()
    return new


def _in_order(model: pycolmap.Reconstruction) -> list[int]:
    """Identifiers of the pictures with a pose, in the order of their names."""
    return sorted(model.reg_image_ids(), key=lambda i: model.images[i].name)
