"""A film as glTF: people as textured meshes with a motion each, and the scene's Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stages.formats.exchange.avatar_glb import add_figure, start, surface, targets_of
from stages.formats.exchange.glb import Arrays, write_glb
from stages.formats.exchange.skeleton import skeleton_of
from stages.formats.exchange.splats_glb import SPLATS, points
from stages.records import Mesh, Rig, Scene, Take

Stand = tuple[list[float], list[float], float]
"""Where somebody stands: place [3] m, turn as x y z w, and how many times as large they are."""


def write_film_glb(path: Path, figures: Sequence[tuple[str, Rig, Mesh, Take, Stand]], scene: Scene | None) -> None:
    """Write people with a motion each, one animation for all, and a scene of Gaussians; y up, floor at 0.

    Of each person: name, rig, mesh, motion on a floor at height 0, and where they stand.
    """
    arrays, content = Arrays(), start("film")
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for name, rig, mesh, take, (place, quat, scale) in figures:
        stand = {"name": name, "translation": place, "rotation": quat, "scale": [scale] * 3}
        skeleton = skeleton_of(rig)
        primitive = surface(content, mesh, arrays)
        first = add_figure(content, arrays, f"{name} body", skeleton, primitive, stand, list(targets_of(mesh)))
        moves = skeleton.animation(take, arrays, first)
        channels += [channel | {"sampler": channel["sampler"] + len(samplers)} for channel in moves["channels"]]
        samplers += moves["samplers"]
    content["animations"] = [{"name": "film", "samplers": samplers, "channels": channels}]
    if scene is not None:
        content["extensionsUsed"] = [SPLATS]
        content["scenes"][0]["nodes"].append(len(content["nodes"]))
        content["nodes"].append({"name": "scene", "mesh": len(content["meshes"])})
        content["meshes"].append({"name": "scene", "primitives": [points(scene, arrays, {})]})
    write_glb(path, content, arrays)
