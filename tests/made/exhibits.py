"""A page of the tiny clip, its person in clothes that swing and in the clip's light, with a shadow on the wall."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import export
from stages.avatar.body.joints import HANDS, HEAD, WRISTS
from stages.avatar.drawing.attach import attach
from stages.contract import Job
from stages.formats import viewer
from stages.formats.body_model import read_body_model
from stages.formats.effects import write_effects
from stages.formats.hands import write_hands
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.gestures import HandPoses
from stages.records import Effects, Scene
from tests.made import tiny
from tests.made.clothes import dress, some_clothes

BARE = (HEAD, *WRISTS, *HANDS)
HAZE = 8  # layers
ROWS = ("means", "quats", "scales", "opacities", "sh0", "shN")
NAME = '<!--<script>window.broken=1</script><img src=x onerror="window.broken=1"> & \u2028.mp4'


def make(folder: Path, scene: bool = True, gestured: bool = False) -> dict[str, Path]:
    """The folders of the stages up to train, and `export`, of the tiny clip with clothes, and a shadow if with `scene`.

    `gestured`: the avatar has fingers, which lie a little bent and move in the clip, and a face.
    """
    folders = tiny.make(folder, scene)
    listing = folders["frames"] / "frames.json"
    frames = [{"name": name, "index": int(name), "time_s": int(name) / 30} for name in tiny.NAMES]
    facts = json.loads(listing.read_bytes())
    listing.write_text(json.dumps(facts | {"frames": frames}))
    train = folders["train"]
    person = read_avatar(train / "avatar.npz")
    person = replace(person, lbs_weights=spread(person.lbs_weights))
    person = dress(person, some_clothes(), BARE if gestured else ())
    if gestured:
        body, turns = read_body_model(), some_hands()
        person = attach(person, body, read_hands_face(body), turns[0])
        read, each = np.ones((tiny.FRAMES, 2)), np.full((tiny.FRAMES, 2), 0.01)
        write_hands(folders["smpl"] / "hands.npz", HandPoses(tiny.NAMES, turns, turns[0], read, each, 6000 * each))
    write_splats(train / "avatar.npz", person)
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


def some_hands() -> np.ndarray:
    """Fingers [F,2,15,3] rad of the frames of the tiny clip, bent by some 15 degrees each way."""
    return np.random.default_rng(8).normal(0, 0.25, (tiny.FRAMES, 2, 15, 3))


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
