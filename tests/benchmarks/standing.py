"""Do people stand on the floor, wherever they are put; and how fast is a film of several drawn?

    python -m tests.benchmarks.standing soles RUN --motion jesse_dance.bvh [--truth COURTYARD] [--json out.json]
    python -m tests.benchmarks.standing speed SCENE PERSON PERSON PERSON --motion jesse_dance.bvh [--json out.json]

RUN is the folder of a finished pipeline, such as work/kitchen/default. `soles` puts its own person on 32 places up to 3 m from
where they were filmed, doing the motion and what they did in the clip, and measures the lowest sole over the floor there, in
the pictures in which the motion itself has a sole down: the median height of the solid Gaussians of the scene within 0.25 m,
where there are ten and half of them agree within 2 cm (elsewhere they cannot tell), or the true floor of a clip with truth
(z = 0 in cameras.json). `speed` draws pictures of 640x360 with three people, each placed, skinned, clothed and with a
shadow, and says what memory that took.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from stages.avatar.motion.placing import mean_up
from stages.contract import peak_memory
from stages.filming.cameras import cameras_of
from stages.filming.cast import Actor, cast
from stages.filming.setting import load_setting
from stages.filming.shoot import Shoot
from stages.filming.spec import Film, Person
from stages.formats.facts import Listing, read_facts
from stages.formats.ground import read_ground
from stages.formats.poses import read_poses
from stages.formats.splats import read_scene
from stages.records import Cameras
from tests.benchmarks.host import summary, tell, use_threads
from tests.made.truth import Similarity, align

RINGS, WAYS = (0.75, 1.5, 2.25, 3.0), 8  # m from where they were filmed, and directions
AROUND, SOLID, LEAST, LAYER = 0.25, 0.3, 10, 0.15  # m, opacity, Gaussians and m: what counts as the floor at a place
CLOSE = 0.02  # m
FPS = 30.0


def lowest(actor: Actor) -> np.ndarray:
    """The lowest point [P,3] m of the soles in each pose of a motion."""
    points, _ = actor.soles.at(actor.global_orient, actor.body_pose, actor.transl)
    low = (points @ actor.turn[:, 1]).argmin(1)
    return points[np.arange(len(points)), low]


def leaps(actor: Actor) -> np.ndarray:
    """How far the motion itself has both soles over its floor [P], m."""
    placed = actor.placed
    return actor.soles.at(placed.global_orient, placed.body_pose, placed.transl)[0][..., 1].min(1)


def similarity(run: Path, truth: Path) -> Similarity:
    """What takes the run's world to the truth's."""
    facts = json.loads((truth / "cameras.json").read_bytes())
    listing = read_facts(run / "frames" / "frames.json", Listing)
    place = {frame.name: frame.index for frame in listing.frames}
    true = {frame["index"]: np.array(frame["camera_from_world"]) for frame in facts["frames"]}
    setting = load_setting(Film(scene=run, people=[Person(avatar=run)]), "cpu")
    assert setting.clip is not None
    found = setting.clip.world_cameras
    views = np.stack([true[place[name]] for name in found.names])
    return align(found, Cameras(found.names, views, found.Ks, found.width, found.height))


def soles(run: Path, motion: str, truth: Path | None) -> dict[str, Any]:
    """Heights of the lowest soles over the floor at all places, m, by motion; and how far the mean body leans."""
    ground, scene = read_ground(run / "smpl" / "ground.json"), read_scene(run / "train" / "scene.npz")
    solid = scene.means[scene.opacities > SOLID]
    flat, high = (solid - ground.point) @ ground.turn[:, [0, 2]], (solid - ground.point) @ ground.up
    flat, high = flat[np.abs(high) < LAYER], high[np.abs(high) < LAYER]
    told = None if truth is None else similarity(run, truth)
    turns = read_poses(run / "train" / "body.npz").global_orient
    found: dict[str, Any] = {"lean of the mean body, degrees": np.degrees(np.arccos(mean_up(turns) @ ground.up))}
    if told is not None:
        found["floor off level, degrees"] = np.degrees(np.arccos(abs((told.R @ ground.up)[2])))
    for name in (motion, "clip"):
        heights, flying, places = [], [], 0
        for ring in RINGS:
            for angle in np.arange(WAYS) * 2 * np.pi / WAYS:
                at = (ring * float(np.sin(angle)), ring * float(np.cos(angle)))
                actor = cast(Person(avatar=run, motion=name, at=at), "x", ground, FPS, "cpu")
                flying.append(leaps(actor) > CLOSE)
                feet = lowest(actor)[~flying[-1]]
                truly = None if told is None else told.to_truth(feet)[:, 2]
                over = over_scene(feet, ground.point, ground.turn, flat, high) if truly is None else truly
                over = over[np.isfinite(over)]
                places += len(over) > 0
                heights.append(over)
        every = np.concatenate(heights)
        found[Path(name).stem] = {
            "places": places,
            "pictures": len(every),
            "in the air by the motion": float(np.concatenate(flying).mean()),
            f"within {100 * CLOSE:g} cm": float((np.abs(every) < CLOSE).mean()),
            "cm, at 5, 25, 50, 75, 95 %": (100 * np.quantile(every, [0.05, 0.25, 0.5, 0.75, 0.95])).round(2).tolist(),
        }
    return found


def over_scene(feet: np.ndarray, point: np.ndarray, turn: np.ndarray, flat: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Heights [P] of feet [P,3] over the scene's Gaussians around them; NaN where these are too few or disagree."""
    at, height = (feet - point) @ turn[:, [0, 2]], (feet - point) @ turn[:, 1]
    found = np.full(len(feet), np.nan)
    for i, place in enumerate(at):
        near = np.linalg.norm(flat - place, axis=1) < AROUND
        if near.sum() >= LEAST:
            below, middle, above = np.quantile(high[near], [0.25, 0.5, 0.75])
            if max(above - middle, middle - below) < CLOSE:
                found[i] = height[i] - middle
    return found


def speed(scene: Path, people: list[Path], motion: str, pictures: int) -> dict[str, Any]:
    """Milliseconds of clock and of processor a picture, and memory."""
    use_threads(2)
    each = [Person(avatar=one, motion=motion, at=(0.7 * (i - 1), 0), start=-i) for i, one in enumerate(people)]
    film = Film(scene=scene, people=each, size=(640, 360))
    setting = load_setting(film, "cpu")
    actors = [cast(person, f"p{i}", setting.ground, FPS, "cpu") for i, person in enumerate(each)]
    shoot = Shoot(setting, actors, cameras_of("clip", pictures, FPS, film.size, setting, actors), FPS)
    shoot.picture(0)
    clock, work = [], []
    for number in range(pictures):
        began, worked = time.perf_counter(), time.process_time()
        shoot.picture(number)
        clock.append(1e3 * (time.perf_counter() - began))
        work.append(1e3 * (time.process_time() - worked))
    assert setting.scene is not None
    count = [len(actor.rig) for actor in actors] + [len(setting.scene)]
    rate = 1e3 / summary(clock)["median"]
    return {"Gaussians": count, "ms": summary(clock), "ms of processor": summary(work), "pictures a second": rate,
            "shadow": setting.shadow is not None, "peak memory, GiB": peak_memory() / 2**30}  # fmt: skip


def main() -> None:
    """Print what was measured; write it as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["soles", "speed"])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--motion", required=True)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--pictures", type=int, default=60)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.what == "soles":
        found = {str(run): soles(run, asked.motion, asked.truth) for run in asked.runs}
    else:
        found = speed(asked.runs[0], asked.runs[1:], asked.motion, asked.pictures)
    tell(found, asked.json)


if __name__ == "__main__":
    main()
