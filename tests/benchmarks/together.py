"""Do people look as if they were there: their shadows, and their colours, in another clip's scene, against the truth.

    python -m tests.benchmarks.together shadow WORK [--seeds 7 8] [--steps 1000] [--json out.json]
    python -m tests.benchmarks.together colour [--seeds 30 31 ... 37] [--json out.json]

`shadow` trains tiny clips with true inputs, puts the person of each into the room of the next one, and compares with the room
drawn with that person in it (stages.synthetic, as its clips are): pixels beside the person, with no shadow and with the one
that was learned of the room's own person. What no shadow loses is its squared error less that of the trained room alone.

`colour` makes clips by cameras of known exposure and tint, and compares the person's pixels as the scene's camera shows them
with those of their own clip, left as they are and matched. Rooms are those of the demo clip or, harder, painted and lit by
chance, every second one outdoors; or, where nothing tells a camera from paint, every second one all of one colour, as a lawn
or a wall. A camera multiplies displayed values or, as real ones, light.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages import survey, train
from stages.avatar.cameras.pinhole import pinhole
from stages.avatar.rasterize import Camera
from stages.contract import Job
from stages.filming.cast import Actor, cast
from stages.filming.colours import gain_between, look_of_clip
from stages.filming.picture import draw_picture
from stages.filming.setting import Setting, load_setting
from stages.filming.spec import Film, Person
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.images import read_image, read_mask
from stages.formats.poses import read_poses
from stages.records import BodyPoses, Cameras
from stages.synthetic import clip as synthetic
from stages.synthetic import person
from stages.synthetic.effects import ClipEffects, to_linear, to_srgb
from stages.synthetic.files import write_views
from stages.synthetic.room import Room, make_room
from tests.benchmarks.effect_models import PARAMS, SIZE, inputs
from tests.benchmarks.host import tell
from tests.made.truth import align, in_result_world, psnr

DARKNESS = 0.5  # of the true shadows
RIM = 4  # px around the person that belong to nobody
PLACES = ((0.0, 0.0), (-0.5, 0.3), (0.45, -0.4))  # m in the room: x, z
EXPOSURE, TINT = 0.35, 0.12  # log: standard deviations of the cameras' gains, and of red and blue beside green
ROUNDING = 0.25  # of 255: what pictures are rounded by
PICTURES = 8  # of a clip whose colours are measured


def run_of(work: Path, seed: int, steps: int) -> Path:
    """The folder of a trained clip with shadows; made once."""
    place = work / f"shadow_seed{seed}"
    inputs(place, seed=seed, effects=ClipEffects(shadow=DARKNESS))
    folders = {name: place / name for name in ("frames", "masks", "sfm", "smpl", "survey", "train")}
    if not (folders["train"] / "avatar.npz").exists():
        for name in ("survey", "train"):
            folders[name].mkdir(exist_ok=True)
        before = {name: folders[name] for name in ("frames", "masks", "sfm", "smpl")}
        survey.run(Job(folders["survey"], seed=seed), survey.Params(), **before)
        made = {name: folders[name] for name in ("sfm", "smpl", "survey")}
        train.run(Job(folders["train"], seed=seed), train.Params(steps=steps, **PARAMS), **made)
    return place


def true_pictures(folder: Path, room_seed: int, seed: int, darkness: float) -> None:
    """Write the person of one clip in the room of another: pictures, masks, cameras and bodies."""
    model, rng, own = read_body_model(), np.random.default_rng(room_seed), np.random.default_rng(seed)
    room, _ = make_room(rng), make_room(own)
    betas, width, height = own.uniform(-0.8, 0.8, 10), SIZE["width"], SIZE["height"]
    K = pinhole(synthetic.FOCAL * height, width, height)
    renderer = synthetic._Renderer(model, room, betas, K, ClipEffects(shadow=darkness))
    orient, pose = person.novel_poses()
    views = synthetic.novel_cameras(len(pose))
    steps = np.array([(x, 0.0, z) for x, z in PLACES])[np.arange(len(pose)) % len(PLACES)]
    transl = person.pose_body(renderer.body, betas, orient, pose)[0] + steps
    write_views(folder, renderer.views(views, orient, pose, width, height, lambda n: None, transl=transl), betas)


def moved(actor: Actor, poses: BodyPoses) -> Actor:
    """The actor in these poses of the film's world, one a picture."""
    return replace(
        actor, global_orient=poses.global_orient, body_pose=poses.body_pose, transl=poses.transl, first=0, loop=False
    )


def shadows(work: Path, seeds: list[int], steps: int) -> list[dict[str, Any]]:
    """A row for each person in another one's room."""
    rows, model = [], read_body_model()
    runs = {seed: run_of(work, seed, steps) for seed in seeds}
    for there, own in zip(seeds, seeds[1:] + seeds[:1], strict=True):
        truth = {name: work / f"{own}_in_{there}" / name for name in ("lit", "plain")}
        for name, folder in truth.items():
            if not (folder / "images").exists():
                true_pictures(folder, there, own, DARKNESS if name == "lit" else 0.0)
        scene, run = runs[there], runs[own]
        setting = load_setting(Film(scene=scene, people=[Person(avatar=run)]), "cpu")
        fitted, body = read_poses(run / "train" / "body.npz"), read_body_model(run / "smpl" / "body_model.npz")
        unit = read_poses(scene / "train" / "body.npz").world_from_sfm
        similarity = align(
            read_cameras(scene / "sfm" / "cameras.npz"), read_cameras(scene / "truth" / "cameras.npz"), unit
        )
        cameras, poses = in_result_world(truth["lit"], similarity, fitted, body, model)
        actor = moved(cast(Person(avatar=run, motion="wave"), "a", setting.ground, 30.0, "cpu"), poses)
        rows.append({"person": own, "room": there} | judged(setting, actor, cameras, truth))
        print(json.dumps(rows[-1]), flush=True)
    return rows


def judged(setting: Setting, actor: Actor, cameras: Cameras, truth: dict[str, Path]) -> dict[str, Any]:
    """Errors beside the person: squared, of 255, and of the whole picture in dB."""
    arms = {"none": None, "learned": setting.shadow}
    beside: dict[str, list[float]] = {name: [] for name in (*arms, "room")}
    whole: dict[str, list[float]] = {name: [] for name in arms}
    for i, name in enumerate(cameras.names):
        camera = Camera.of(cameras.viewmats[i], cameras.Ks[i], cameras.width, cameras.height)
        lit, plain = (read_image(folder / "images" / f"{name}.png") for folder in truth.values())
        _, alone = draw_picture(None, None, [actor], i, camera, 0.0)
        body = (read_mask(truth["lit"] / "masks" / f"{name}.png") > 0) | (alone > 0.02)
        free = cv2.dilate(body.astype(np.uint8), np.ones((2 * RIM + 1,) * 2)) == 0
        for arm, shadow in arms.items():
            image, _ = draw_picture(setting.splats, shadow, [actor], i, camera, 0.0)
            drawn = np.rint(image.clip(0, 1) * 255)
            beside[arm].append(float(np.square(drawn - lit)[free].mean()))
            whole[arm].append(psnr(drawn, lit))
            if arm == "none":
                beside["room"].append(float(np.square(drawn - plain)[free].mean()))
    mean = {name: float(np.mean(values)) for name, values in beside.items()}
    back = (mean["none"] - mean["learned"]) / (mean["none"] - mean["room"])
    return {"beside": mean, "won back": back, "dB": {name: float(np.mean(values)) for name, values in whole.items()}}


@dataclass(frozen=True)
class Shown:
    """A clip as one camera shows it, as far as its look is measured."""

    pictures: np.ndarray
    masks: np.ndarray

    @property
    def names(self) -> range:
        return range(len(self.pictures))

    def images(self, i: int) -> np.ndarray:
        return self.pictures[i]

    def mask(self, i: int) -> np.ndarray:
        return self.masks[i]

    def person(self) -> np.ndarray:
        """The person's pixels [N,3], 0..1."""
        return self.pictures[self.masks > 250] / 255


def seen_by(clip: Shown, gain: np.ndarray, of_light: bool) -> Shown:
    """A clip as a camera with this `gain` [3] shows it: of displayed values, or `of_light` before they are."""
    values = clip.pictures / 255
    values = to_srgb(to_linear(values) * gain) if of_light else values * gain
    return Shown(np.rint(values.clip(0, 1) * 255).astype(np.uint8), clip.masks)


def painted(room: Room, seed: int) -> Room:
    """The room with walls, floor and things lighter or darker, and in other colours."""
    rng, count = np.random.default_rng([seed, 5]), len(room.tints)
    paint = rng.uniform(0.55, 1.05, (count, 1)) * np.exp(rng.normal(0, 0.12, (count, 3)))
    return replace(room, tints=(room.tints * paint).clip(0, 1.1))


def of_one_colour(room: Room, seed: int) -> Room:
    """The room with all that is in it of one colour, lighter and darker as it was."""
    rng = np.random.default_rng([seed, 6])
    paint = rng.uniform(0.4, 1.0) * np.exp(rng.normal(0, 0.3, 3))
    mips = tuple((mip.mean(-1, keepdims=True) * paint).clip(0, 1).astype(np.float32) for mip in room.mips)
    return replace(room, mips=mips, tints=np.ones_like(room.tints))


def filmed(seed: int, kind: str) -> Shown:
    """A few pictures of a clip in a room of its `kind`: demo, painted, or every second one of one colour."""
    model, rng, effects = read_body_model(), np.random.default_rng(seed), ClipEffects()
    room, betas = make_room(rng), rng.uniform(-0.8, 0.8, 10)
    if kind == "painted":
        room, effects = painted(room, seed), ClipEffects(sky=seed % 2)
    if kind == "plain":
        room = of_one_colour(room, seed) if seed % 2 else painted(room, seed)
    renderer = synthetic._Renderer(model, room, betas, pinhole(synthetic.FOCAL * 128, 96, 128), effects)
    viewmats = synthetic.camera_path(PICTURES, 1.0, "moving", rng)
    views = renderer.views(viewmats, *person.make_motion(PICTURES, 1.0, rng), 96, 128, lambda n: None)
    return Shown(views.images, views.masks)


def camera_of(seed: int) -> np.ndarray:
    """The gain [3] of a clip's camera, which keeps white within what it can show."""
    light, red, blue = np.random.default_rng([seed, 29]).normal(size=3) * [EXPOSURE, TINT, TINT]
    gain = np.exp(light + np.array([red, 0, blue]))
    return gain / max(1.0, gain.max())


def colours(seeds: list[int], kind: str, of_light: bool) -> list[dict[str, float]]:
    """Errors of the person's colours, of 255, for each pair of clips, by how they are matched."""
    rows, plain, gains = [], {seed: filmed(seed, kind) for seed in seeds}, {seed: camera_of(seed) for seed in seeds}
    looks = {seed: look_of_clip(seen_by(plain[seed], gains[seed], of_light)) for seed in seeds}
    for own, there in permutations(seeds, 2):
        here, wanted = (seen_by(plain[own], gains[seed], of_light).person() for seed in (own, there))
        arms = {"off": np.ones(3)}
        arms |= {name: gain_between(looks[own], looks[there], name == "always") for name in ("auto", "always")}
        rows.append({arm: 255 * rms((here * gain).clip(0, 1) - wanted) for arm, gain in arms.items()})
    return rows


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def told(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Mean errors of all pairs and of the half that differs most; how many are worse for being matched, and by how much."""
    errors = {arm: np.array([row[arm] for row in rows]) for arm in rows[0]}
    off = errors["off"]
    far, found = off > np.median(off), {}
    for arm, values in errors.items():
        worse = values - off
        found[arm] = {"mean": values.mean(), "mean of the farther half": values[far].mean(),
                      "worse": int((worse > ROUNDING).sum()), "most worse": max(0.0, worse.max())}  # fmt: skip
    return found | {"pairs": len(rows)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["shadow", "colour"])
    parser.add_argument("work", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.what == "shadow":
        if asked.work is None:
            parser.error("shadow needs a WORK folder")
        rows = shadows(asked.work, asked.seeds or [7, 8], asked.steps)
        found: dict[str, Any] = {"rows": rows, "won back": float(np.mean([row["won back"] for row in rows]))}
    else:
        found = {
            f"{kind} rooms, gain of {what}": told(colours(asked.seeds or list(range(30, 38)), kind, what == "light"))
            for kind in ("demo", "painted", "plain")
            for what in ("values", "light")
        }
    tell(found, asked.json)


if __name__ == "__main__":
    main()
