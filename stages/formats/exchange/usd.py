"""USD: Gaussians as ParticleField3DGaussianSplat (OpenUSD 26.03 and newer), still or with a sample a frame.

https://openusd.org. It needs the package usd-core, the extra `usd`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.records import Scene


def check_usd() -> None:
    """StageError where usd-core is missing or older than Gaussians."""
    try:
        found = hasattr(importlib.import_module("pxr.UsdVol"), "ParticleField3DGaussianSplat")
    except ImportError as error:
        raise StageError("writing USD needs usd-core", "pip install 'hugs-avatar[usd]'", [str(error)]) from error
    if not found:
        raise StageError("this usd-core knows no Gaussians", "pip install 'usd-core>=26.3'")


def write_usd(
    path: Path, still: Mapping[str, Scene], moving: Mapping[str, Iterable[Scene]] | None = None, fps: float = 24.0
) -> None:
    """Write Gaussians, y up, metres, as /World/NAME: `still` ones, and `moving` ones with a sample a frame, `fps` a second.

    The frames of one name have the same Gaussians: opacities and colours are the first one's. Moving places, turns and
    scales are half floats. Colours are what was captured: lights do not change them.
    """
    Gf, Sdf, Usd, UsdGeom, UsdVol, Vt = (
        importlib.import_module(f"pxr.{part}") for part in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdVol", "Vt")
    )
    path.unlink(missing_ok=True)  # a stage of that name in memory is not written over
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    last = 0
    for name, frames in [(name, [splats]) for name, splats in still.items()] + list((moving or {}).items()):
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path(f"/World/{name}"))
        for number, splats in enumerate(frames):
            time = Usd.TimeCode.Default() if name in still else Usd.TimeCode(number)
            _place(field, splats, time, Gf, Vt, half=name not in still)
            last = max(last, number)
            if number == 0:
                field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_f32(splats.opacities)))
                sh = np.concatenate([splats.sh0[:, None], splats.shN], 1)
                field.CreateRadianceSphericalHarmonicsDegreeAttr(round(sh.shape[1] ** 0.5) - 1)
                coefficients = Vt.Vec3fArray.FromNumpy(_f32(sh.reshape(-1, 3)))
                field.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
    if moving:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(last)
    stage.GetRootLayer().Save()


def _place(field: Any, splats: Scene, time: Any, Gf: Any, Vt: Any, half: bool) -> None:
    """Where the Gaussians are, how turned and how large, at one time."""
    means, scales = _f32(splats.means), _f32(splats.scales)
    turns = _f32(splats.quats[:, [1, 2, 3, 0]])  # x y z w
    kind, mark = (np.float16, "h") if half else (np.float32, "")
    for name, array, values in (
        ("Positions", "Vec3", means),
        ("Orientations", "Quat", turns),
        ("Scales", "Vec3", scales),
    ):
        attribute = getattr(field, f"Create{name}{mark}Attr")()
        attribute.Set(getattr(Vt, f"{array}{mark or 'f'}Array").FromNumpy(values.astype(kind)), time)
    if len(means):
        reach = 3 * scales.max(1, keepdims=True)
        corners = (means - reach).min(0), (means + reach).max(0)
        extent = [Gf.Vec3f(*map(float, corner)) for corner in corners]
        field.CreateExtentAttr().Set(Vt.Vec3fArray(extent), time)


def _f32(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
