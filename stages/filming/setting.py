"""Where a film is set: a trained scene or a file of Gaussians, its floor, its light and the cameras of its clip."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.avatar.effects.frames import load_effects
from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import DARKNESS, Shadow
from stages.avatar.model.scene import load_scene
from stages.avatar.splats.gaussians import Splats
from stages.contract import StageError
from stages.filming.scenes import stood
from stages.filming.spec import Film, Floor
from stages.formats.clip import Clip, load_clip
from stages.formats.effects import read_effects
from stages.formats.exchange.read import lacks, read_any_scene
from stages.formats.facts import Listing, Survey, read_facts
from stages.formats.ground import read_ground
from stages.formats.trained import check_scene
from stages.records import Ground, Scene

DIM, SOFT = 0.3, 0.08  # the share of light that a shadow from above takes, and its blur in m, where no lamp is known


@dataclass(frozen=True)
class Setting:
    """`scene` as arrays, `splats` as tensors, None over white; the `ground` on which people stand, in its world.

    `shadow` is the lamp's, None where none is cast; `shading` the light on people, None: even light. `clip` and the `times`
    [F] s of its frames, where the scene is a run's.
    `facts`: what should be said, in words.
    """

    scene: Scene | None
    splats: Splats | None
    ground: Ground
    shadow: Shadow | None
    clip: Clip | None
    times: np.ndarray
    facts: tuple[str, ...]
    shading: Shading | None = None


def load_setting(film: Film, device: str) -> Setting:
    """Read the film's scene; StageError where it has none, or no floor."""
    nothing = np.zeros(0)
    if film.scene is None:
        return Setting(
            None, None, _floor(Floor(point=(0, 0, 0), up=(0, 1, 0), ahead=(0, 0, 1))), None, None, nothing, ()
        )
    if not film.scene.is_dir():
        if film.ground is None:
            hint = (
                "`ground: {point: [0, 1, 3]}` in the film, in the scene's axes; up and ahead as its people should stand"
            )
            raise StageError(f"the floor of {film.scene} is not given", hint, ["a file of Gaussians has none"])
        ground = _floor(film.ground)
        scene = stood(read_any_scene(film.scene), film.scene_axes, ground)
        if film.only == "human":
            return Setting(None, None, ground, None, None, nothing, ())
        shadow, fact = lamp_of(None, ground, film.light)
        shown = load_scene(scene, device)
        return Setting(
            scene, shown, ground, _on(device, shadow), None, nothing, (*lacks(None, film.scene, scene.antialias), *fact)
        )
    train, sfm, smpl = (film.scene / stage for stage in ("train", "sfm", "smpl"))
    ground, clip = read_ground(smpl / "ground.json"), load_clip(sfm, smpl, train)
    times = np.array(read_facts(film.scene / "frames" / "frames.json", Listing).times(clip.names))
    shading = load_effects(read_effects(train / "effects.npz")).to(device).shading if film.light == "auto" else None
    if film.only == "human":
        return Setting(None, None, ground, None, clip, times, (), shading)
    if film.gaussians is None:
        check_scene(train)
    scene = read_any_scene(film.gaussians or train / "scene.npz")
    scene = stood(scene, film.scene_axes, ground) if film.gaussians else scene
    shadow, fact = lamp_of(film.scene, ground, film.light)
    if ground.points == 0:
        fact = (*fact, f"the floor of {film.scene} is {ground.how}")
    facts = (*lacks(None, film.gaussians, scene.antialias), *fact)
    return Setting(scene, load_scene(scene, device), ground, _on(device, shadow), clip, times, facts, shading)


def _floor(floor: Floor) -> Ground:
    up, ahead = np.array(floor.up, np.float64), np.array(floor.ahead, np.float64)
    across = np.cross(ahead, up)
    if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(up) * np.linalg.norm(ahead):
        facts = [f"up {list(floor.up)}, ahead {list(floor.ahead)}"]
        raise StageError("up and ahead of the ground are parallel", "give two directions", facts)
    up, ahead = (axis / np.linalg.norm(axis) for axis in (up, np.cross(up, across)))
    return Ground(np.array(floor.point, np.float64), up, ahead, 1.0, 0.0, 0.0, 0, "given")


def _on(device: str, shadow: Shadow | None) -> Shadow | None:
    return None if shadow is None else shadow.to(device)


def lamp_of(run: Path | None, ground: Ground, light: str) -> tuple[Shadow | None, tuple[str, ...]]:
    """The shadow that people cast in a run's scene, or in a file's (None): of its lamp and as dark; and what to say of it.

    As training learned it; or towards the lamp that the survey saw; none where it saw that there is none; else from above.
    """
    overhead = Shadow(torch.as_tensor(ground.up).float(), DIM, SOFT).requires_grad_(False)
    if light == "off":
        return None, ()
    if run is None or light == "above":
        return overhead, () if light == "above" else ("no lamp is known in the scene: shadows fall from above",)
    learned = load_effects(read_effects(run / "train" / "effects.npz")).shadow
    if learned is not None:
        return learned, ()
    survey = read_facts(run / "survey" / "survey.json", Survey)
    measured = survey.effects.get("shadow")
    if measured is not None and measured.value is not None and not measured.on:
        return None, ("the scene's survey saw no shadow: none is cast (`light: above` casts one)",)
    start = survey.starts.get("shadow")
    if measured is not None and measured.on and start is not None:
        lamp = torch.as_tensor(start[:3]).float()
        return Shadow(lamp, min(max(start[3], 0.05), DARKNESS)).requires_grad_(False), ()
    return overhead, ("the scene's survey could not see its lamp: shadows fall from above",)
