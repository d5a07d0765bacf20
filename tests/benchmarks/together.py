"""Do people look as if they were there: their shadows, and their colours, in another clip's scene, against the truth.

    python -m tests.benchmarks.together shadow WORK [--seeds 7 8] [--steps 1000] [--json out.json]
    python -m tests.benchmarks.together colour FOLDER [--half setting] [--json out.json]

`shadow` trains tiny clips with true inputs, puts the person of each into the room of the next one, and compares with the room
drawn with that person in it (stages.synthetic, as its clips are): pixels beside the person, with no shadow and with the one
that was learned of the room's own person. What no shadow loses is its squared error less that of the trained room alone.

`colour` takes the family of clips of tests.benchmarks.fit, from FOLDER, shows each as a camera of known exposure and tint does, and
compares the person's pixels as the scene's camera shows them with those of their own clip, left as they are and matched. Rooms
are as they were; or, where nothing tells a camera from paint, each thing in them painted by chance, or the person's or the
scene's all of one colour. A camera multiplies displayed values or, as real ones, light.
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
from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.rasterize import Camera
from stages.contract import Job
from stages.filming.cast import Actor, cast
from stages.filming.colours import look_of_clip, match
from stages.filming.setting import Setting, load_setting
from stages.filming.spec import Film, Person
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.images import read_image, read_mask, shrink
from stages.formats.poses import read_poses
from stages.records import BodyPoses, Cameras
from stages.synthetic import person
from stages.synthetic.files import write_views
from stages.synthetic.room import make_room
from tests.benchmarks.effect_models import PARAMS, SIZE, inputs
from tests.benchmarks.host import tell
from tests.made.family.table import shots
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import ClipEffects, to_linear, to_srgb
from tests.made.truth import align, in_result_world, psnr

DARKNESS = 0.5  # of the true shadows
FIRST = {"setting": 30, "asked": 60}  # seed of the cameras
RIM = 4  # px around the person that belong to nobody
PLACES = ((0.0, 0.0), (-0.5, 0.3), (0.45, -0.4))  # m in the room: x, z
EXPOSURE, TINT = 0.35, 0.12  # log: standard deviations of the cameras' gains, and of red and blue beside green
ROUNDING = 0.25  # of 255: what pictures are rounded by
PICTURES, SIDE, THINGS = (
    8,
    128,
    10,
)  # of a clip whose colours are measured; their longer side in px; colours of its room


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
    renderer = synthetic.Renderer(model, room, betas, K, ClipEffects(shadow=darkness))
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
        _, alone = Cast([actor], None, FrameEffects()).at(i).picture(camera)
        body = (read_mask(truth["lit"] / "masks" / f"{name}.png") > 0) | (alone > 0.02)
        free = cv2.dilate(body.astype(np.uint8), np.ones((2 * RIM + 1,) * 2)) == 0
        for arm, shadow in arms.items():
            image, _ = Cast([actor], setting.splats, FrameEffects(shadow)).at(i).picture(camera)
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
        """The person's pixels [N,3]."""
        return self.pictures[self.masks > 250]


def shown(pixels: np.ndarray, gain: np.ndarray, of_light: bool) -> np.ndarray:
    """Pixels uint8 as a camera with this `gain` [3] shows them: of displayed values, or `of_light` before they are."""
    values = pixels / 255
    values = to_srgb(to_linear(values) * gain) if of_light else values * gain
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def filmed(folder: Path) -> Shown:
    """A few pictures of a clip of the family, small."""
    files = sorted((folder / "images").iterdir())
    files = [files[i] for i in np.linspace(0, len(files) - 1, PICTURES).round().astype(int)]
    masks = [np.repeat(read_mask(folder / "masks" / file.name)[..., None], 3, 2) for file in files]
    small = [np.stack([shrink(one, SIDE) for one in every]) for every in ([read_image(file) for file in files], masks)]
    return Shown(small[0], small[1][..., 0])


def behind(clip: Shown, pictures: np.ndarray) -> Shown:
    """The clip with other pictures beside the person."""
    return Shown(
        np.where(clip.masks[..., None] > 5, clip.pictures, np.rint(pictures.clip(0, 255))).astype(np.uint8), clip.masks
    )


def painted(clip: Shown, seed: int) -> Shown:
    """The room with each of its colours (k-means) lighter or darker, and in another tint."""
    rng, flat = np.random.default_rng([seed, 5]), clip.pictures.reshape(-1, 3).astype(np.float32)
    logs = np.log(flat.clip(3) / 255)
    found = np.c_[logs[:, [0]] - logs[:, [1]], logs[:, [2]] - logs[:, [1]], 0.5 * logs.mean(1)[:, None]]
    cv2.setRNGSeed(seed)
    rows = cv2.kmeans(found, THINGS, np.zeros(0), (3, 30, 1e-3), 2, cv2.KMEANS_PP_CENTERS)[1][:, 0]
    paint = rng.uniform(0.55, 1.05, (THINGS, 1)) * np.exp(rng.normal(0, TINT, (THINGS, 3)))
    return behind(clip, (flat * paint[rows]).reshape(clip.pictures.shape))


def of_one_colour(clip: Shown, seed: int) -> Shown:
    """The room all of one colour, lighter and darker as it was."""
    rng = np.random.default_rng([seed, 6])
    paint = rng.uniform(0.4, 1.0) * np.exp(rng.normal(0, 0.3, 3))
    return behind(clip, clip.pictures.mean(-1, keepdims=True) * paint)


def camera_of(seed: int) -> np.ndarray:
    """The gain [3] of a clip's camera, which keeps white within what it can show."""
    light, red, blue = np.random.default_rng([seed, 29]).normal(size=3) * [EXPOSURE, TINT, TINT]
    gain = np.exp(light + np.array([red, 0, blue]))
    return gain / max(1.0, gain.max())


def colours(own: list[Shown], there: list[Shown], first: int, of_light: bool) -> list[dict[str, float]]:
    """Errors of the person's colours, of 255, by how they are matched, for each pair of different clips; seeds from `first`."""
    gains = [camera_of(first + i) for i in range(len(own))]
    looks, lit = (
        [
            look_of_clip(Shown(shown(clip.pictures, gain, of_light), clip.masks))
            for clip, gain in zip(clips, gains, strict=True)
        ]
        for clips in (own, there)
    )
    rows = []
    for i, j in permutations(range(len(own)), 2):
        here, wanted = (shown(own[i].person(), gains[k], of_light) / 255 for k in (i, j))
        arms = {"off": np.ones(3)} | {way: match(looks[i], lit[j], way == "always")[0] for way in ("auto", "always")}
        rows.append({arm: 255 * rms((here * gain).clip(0, 1) - wanted) for arm, gain in arms.items()})
    return rows


def all_colours(folder: Path, half: str) -> dict[str, Any]:
    """What matching does in rooms that are alike, that are painted by chance, and of which one is of one colour."""
    alike = [filmed(folder / shot.name) for shot in shots(half)]
    paint, plain = ([change(clip, i) for i, clip in enumerate(alike)] for change in (painted, of_one_colour))
    kinds = {"alike": (alike, alike), "painted": (paint, paint), "own of one colour": (plain, alike),
             "scene of one colour": (alike, plain)}  # fmt: skip
    return {
        f"{kind}, gain of {what}": told(colours(own, there, FIRST[half], what == "light"))
        for kind, (own, there) in kinds.items()
        for what in ("values", "light")
    }


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
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8])
    parser.add_argument("--half", choices=FIRST, default="setting")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.what == "shadow":
        rows = shadows(asked.work, asked.seeds, asked.steps)
        found: dict[str, Any] = {"rows": rows, "won back": float(np.mean([row["won back"] for row in rows]))}
    else:
        found = all_colours(asked.work, asked.half)
    tell(found, asked.json)


if __name__ == "__main__":
    main()
