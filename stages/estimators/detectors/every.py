"""All detectors by the name of their effect."""

from stages.estimators.detectors import (
    antialias,
    camera_refinement,
    clothing,
    exposure,
    face,
    lens,
    motion_blur,
    pose_refinement,
    rolling_shutter,
    shading,
    shadow,
    sky,
    transients,
    view_dependence,
)

DETECTORS = {
    "lens": lens.detect,
    "exposure": exposure.detect,
    "view_dependence": view_dependence.detect,
    "rolling_shutter": rolling_shutter.detect,
    "camera_refinement": camera_refinement.detect,
    "motion_blur": motion_blur.detect,
    "pose_refinement": pose_refinement.detect,
    "face": face.detect,
    "clothing": clothing.detect,
    "sky": sky.detect,
    "transients": transients.detect,
    "shadow": shadow.detect,
    "shading": shading.detect,
    "antialias": antialias.detect,
}
