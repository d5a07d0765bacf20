"""A page of the tiny clip, its person in clothes that swing and in the clip's light, with a shadow on the wall."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import export
from stages.contract import Job
from stages.formats import viewer
from stages.formats.effects import write_effects
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.records import Effects, Scene
from tests.made import tiny
from tests.made.clothes import dress, some_clothes

HAZE = 8  # layers
ROWS = ("means", "quats", "scales", "opacities", "sh0", "shN")
NAME = '<!--<script>window.broken=1</script><img src=x onerror="window.broken=1"> & \u2028.mp4'


def make(folder: Path, scene: bool = True) -> dict[str, Path]:
    """The folders of the stages up to train, and `export`, of the tiny clip with clothes, and a shadow if with `scene`."""
    folders = tiny.make(folder, scene)
    listing = folders["frames"] / "frames.json"
    frames = [{"name": name, "index": int(name), "time_s": int(name) / 30} for name in tiny.NAMES]
    facts = json.loads(listing.read_bytes())
    listing.write_text(json.dumps(facts | {"frames": frames}))
    train = folders["train"]
    person = read_avatar(train / "avatar.npz")
    person = replace(person, lbs_weights=spread(person.lbs_weights))
    write_splats(train / "avatar.npz", dress(person, some_clothes()))
    if scene:
        light = np.array([0.3, -0.2, -0.93])
        shadow: dict[str, Any] = {"darkness": 0.6, "softness": 0.05, "density": 2.0, "size": 0.8}
        light /= np.linalg.norm(light)
        wall = read_scene(train / "scene.npz")  # no two at one depth: which of them is in front is not defined
        rough = wall.means + np.random.default_rng(6).uniform(-0.1, 0.1, wall.means.shape) * [0, 0, 1]
        write_splats(train / "scene.npz", hazy(replace(wall, means=rough)))
        shading = np.random.default_rng(7).normal(0, 0.4, (8, 3))
        write_effects(train / "effects.npz", Effects(light, **shadow, shading=shading))
    folders["export"] = folder / "export"
    folders["export"].mkdir()
    run(folders)
    return folders


def run(folders: dict[str, Path]) -> viewer.Exhibit:
    """Export, again if need be; what the page shows."""
    inputs, shown = {name: folders[name] for name in ("frames", "sfm", "smpl", "train")}, []
    with pytest.MonkeyPatch.context() as patch:
        write = viewer.write_viewer
        patch.setattr(viewer, "write_viewer", lambda path, exhibit: shown.append(exhibit) or write(path, exhibit))
        export.run(Job(folders["export"]), export.Params(formats=["viewer"]), **inputs)
    return shown[0]


def rename(shown: viewer.Exhibit) -> viewer.Exhibit:
    """The same under a name made to break the page, which no file system would allow, wherever a name stands."""
    (figure,) = shown.figures
    first, *others = figure.moves
    named = replace(figure, moves=[replace(first, name=NAME), *others])
    return replace(shown, title=NAME, subtitle=NAME, facts=[(NAME, NAME)], figures=[named])


def spread(weights: np.ndarray) -> np.ndarray:
    """Skinning weights [N,24] as learned ones are: every bone has a little of every Gaussian."""
    return (weights + 4e-4) / (weights + 4e-4).sum(1, keepdims=True)


def hazy(scene: Scene) -> Scene:
    """The scene behind many faint layers, each of which changes a pixel by less than a byte holds."""
    rng, count = np.random.default_rng(7), HAZE * len(scene)
    more = {name: np.tile(part, (HAZE, *[1] * (part.ndim - 1))) for name, part in vars(scene).items() if name in ROWS}
    more["means"] = more["means"] - rng.uniform([-0.1, -0.1, 0.2], [0.1, 0.1, 0.5], (count, 3))
    more |= {"opacities": np.full(count, 0.012), "sh0": np.full((count, 3), 1.7)}
    made = {name: np.concatenate([getattr(scene, name), part]) for name, part in more.items()}
    return replace(scene, **made, invented=made["means"][:, 0] > np.median(scene.means[:, 0]))
