"""How well a COLMAP model fixes its lens, and the model with another lens."""

from __future__ import annotations

import math
import zlib  # noqa: F401  before pycolmap, see colmap.py

import numpy as np
import pycolmap

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
    order = sorted(model.reg_image_ids(), key=lambda i: model.images[i].name)
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
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.ceres.solver_options.num_threads, options.ceres.solver_options.max_num_iterations = 1, 15
        pycolmap.bundle_adjustment(part, options)
        found.append(float(next(iter(part.cameras.values())).params[0]))
    return found[0], found[1]


def hold_lens(model: pycolmap.Reconstruction, focal: float, k: float) -> None:
    """Give a model's one SIMPLE_RADIAL camera this lens, and adjust poses and points to it."""
    for camera in model.cameras.values():
        camera.params = [focal, *camera.params[1:3], k]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.ceres.solver_options.num_threads = 1  # more threads sum in another order
    pycolmap.bundle_adjustment(model, options)
