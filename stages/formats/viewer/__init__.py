"""viewer.html: people, their scene and their motions in one file that a browser opens without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from stages.formats.images import evenly, shrink
from stages.formats.viewer.libraries import licences, packed
from stages.formats.viewer.packing import Packer, slopes_in_words
from stages.formats.viewer.staging import background, covered, seen, underfoot
from stages.gestures import FACE_NAMES, FINGER_NAMES, Face, Move
from stages.records import Cameras, Effects, Rig, Scene

ROOM = Path(__file__).parent / "page"
TEMPLATE, STYLE, BOOT, ICONS = "viewer.html", "viewer.css", "boot.js", "icons.json"
MODULES = (
    "arrays.js", "bvh.js", "capture.js", "clip.js", "clothes.js", "controls.js", "dropped.js", "face.js", "fading.js",
    "fingers.js", "floor.js", "hands.js", "headset.js", "light.js", "main.js", "motion.js", "names.js", "pace.js",
    "person.js", "player.js", "retarget.js", "ruler.js", "shading.js", "shadow.js", "skeleton.js", "skin.js", "splats.js",
    "stage.js", "turns.js",
)  # fmt: skip
"""They import each other as hugs/NAME."""
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src data: blob:; worker-src blob: data:; base-uri 'none'; form-action 'none'"
)
"""What the browser lets the page load: only what is in it."""
TEN_BITS = 1023  # of the root of a skinning weight, so that many small ones count; the page divides by the sum
SLIDERS = {
    "Jaw": "jawOpen",
    "Smile": "mouthSmileLeft mouthSmileRight",
    "Pucker": "mouthPucker",
    "Blink": "eyeBlinkLeft eyeBlinkRight",
    "Brows": "browInnerUp browOuterUpLeft browOuterUpRight",
}
"""What a slider is called -> the shapes of the face that it moves."""
LARGEST_SCENE = 400_000  # Gaussians: what phones still draw
PICTURES, SIDE, QUALITY, BYTES = 60, 480, 80, 900_000  # frames shown, px of their longer side, of JPEG, of all of them


@dataclass(frozen=True)
class Figure:
    """One person of a page.

    `weights` [N,24+K] skin the Gaussians of `rig`, rows sum to 1; K: the bones of its clothes. After them stand 30 for fingers,
    where the rig has some: in a `fist` [2,15,3] rad they are closed. All figures have as many `moves`, of the same names and
    lengths. `turn` [3,3] and `spot` [3] m take a motion, y up and facing z, to where the person stands; they are `scale` times as
    large there. `soles`: points [P,3] m of the body at rest, and their weights [P,24]. `parts` cast the shadow: middles [24,3] m
    and covariances [24,3,3] m^2 at rest. `absent` are frames of the first motion that do not show them.
    """

    rig: Rig
    weights: np.ndarray
    moves: Sequence[Move]
    turn: np.ndarray
    spot: np.ndarray
    soles: tuple[np.ndarray, np.ndarray]
    parts: tuple[np.ndarray, np.ndarray] | None
    fist: np.ndarray
    face: Face | None
    scale: float = 1.0
    absent: Sequence[int] = ()


@dataclass(frozen=True)
class Exhibit:
    """All that the page shows. The world is that of the clip, in metres; `turn` [3,3] and `spot` [3] m lead to it from one with
    y up and the floor at 0.

    `cameras` in metres, one a frame of the first motion, and of a clip its frames `images(i)` uint8 [H,W,3]. `effects` have the
    lamp and the light on people. `facts` are names and values in words. `times_fit`: how much larger all is than the clip's run
    made it by bodies alone; None where no run can be told a length.
    """

    title: str
    subtitle: str
    facts: Sequence[tuple[str, str]]
    figures: Sequence[Figure]
    scene: Scene | None
    effects: Effects
    cameras: Cameras
    images: Callable[[int], np.ndarray] | None
    turn: np.ndarray
    spot: np.ndarray
    made_by: str
    times_fit: float | None = None


def write_viewer(path: Path, shown: Exhibit) -> list[str]:
    """Write the page; returns what it lacks, in sentences. The same content gives the same bytes."""
    scene, lacks = shown.scene, _lacks(shown)
    if scene is not None and len(scene) > LARGEST_SCENE:
        lacks.append(f"{len(scene) - LARGEST_SCENE:,} of {len(scene):,} Gaussians of the scene, the least seen.")
        scene = _largest(scene, LARGEST_SCENE)
    packer = _pack(shown, scene)
    modules = {f"hugs/{Path(name).stem}": _text(name) for name in MODULES}
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string(_text(TEMPLATE)).render(
        title=shown.title, subtitle=shown.subtitle, facts=shown.facts, lacks=lacks, made_by=shown.made_by, policy=POLICY,
        style=Markup(_text(STYLE)), boot=Markup(_text(BOOT)), licences=licences(),
        icon={name: Markup(drawn) for name, drawn in json.loads(_text(ICONS)).items()},
        compared=shown.images is not None, sliders=_sliders(shown),
        facts_json=_json(_facts(shown, scene, packer)), modules_json=_json(modules), libraries_json=_json(packed()),
        data=base64.b64encode(packer.data).decode(),
    )  # fmt: skip
    path.write_text(page, encoding="utf-8")
    return lacks


def _pack(shown: Exhibit, scene: Scene | None) -> Packer:
    packer = Packer()
    for number, figure in enumerate(shown.figures):
        _pack_figure(packer, figure, number)
        if shown.effects.shading is not None:
            packer.whole(f"person{number}/facing", np.rint(127.5 * (figure.rig.facing + 1)))
    if scene is not None:
        packer.gaussians("scene", scene, 24)
        invented = np.zeros(len(scene)) if scene.invented is None else scene.invented
        marks = np.stack([seen(scene, shown.cameras), underfoot(scene, shown.turn, shown.spot), invented], 1)
        packer.whole("scene/marks", np.rint(15 * marks))
    Ks = shown.cameras.Ks
    packer.exact("clip/views", shown.cameras.viewmats)
    packer.exact("clip/lenses", np.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], 1))
    return packer


def _pack_figure(packer: Packer, figure: Figure, number: int) -> None:
    rig = figure.rig
    packer.gaussians(f"person{number}", rig, 16)
    limbs = figure.weights if rig.fingers is None else figure.weights[:, : -len(FINGER_NAMES)]
    packer.whole(f"person{number}/weights", _roots(limbs), 16)
    packer.exact(f"person{number}/joints", rig.joints)
    if rig.slopes is not None:
        packer.whole(f"person{number}/cloth", rig.slopes.rows[:, None], 32)
        packer.whole(f"person{number}/slopes", slopes_in_words(rig.slopes), 32)
    clothes, parts = vars(rig.clothes) if rig.clothes else {}, figure.parts or ()
    for name, values in {**clothes, **dict(zip(("middles", "covariances"), parts))}.items():
        packer.exact(f"person{number}/{name}", values)
    for i, move in enumerate(figure.moves):
        packer.exact(f"motion{number}.{i}/rotvecs", move.rotvecs)
        packer.exact(f"motion{number}.{i}/steps", move.steps)
        if rig.fingers is not None and move.hands is not None:
            packer.scaled(f"motion{number}.{i}/hands", move.hands.reshape(len(move.hands), -1), 16)
        if figure.face is not None and move.face is not None:
            packer.scaled(f"motion{number}.{i}/face", move.face, 16)
    for name, values in zip(("points", "weights"), figure.soles, strict=True):
        packer.exact(f"soles{number}/{name}", values)
    _pack_gestures(packer, figure, f"person{number}")


def _pack_gestures(packer: Packer, figure: Figure, name: str) -> None:
    """Fingers and face, where the figure has some."""
    fingers, face = figure.rig.fingers, figure.face
    if fingers is not None:
        shares = figure.weights[:, -len(FINGER_NAMES) :]
        rows = np.flatnonzero(shares.any(1))
        packer.whole(f"{name}/gloved", rows[:, None], 32)
        packer.whole(f"{name}/shares", _roots(shares[rows]), 16)
        packer.exact(f"{name}/fingers", np.concatenate([fingers.joints, fingers.tips]))
        packer.exact(f"{name}/lying", fingers.shape)
        packer.exact(f"{name}/fist", figure.fist)
    if face is not None:
        packer.whole(f"{name}/mien", face.rows[:, None], 32)
        packer.around(f"{name}/moves", face.moves.reshape(len(face.moves), -1).T)


def _roots(weights: np.ndarray) -> np.ndarray:
    return np.rint(np.sqrt(np.asarray(weights, np.float64)) * TEN_BITS)


def _sliders(shown: Exhibit) -> dict[str, str]:
    """SLIDERS that move anybody's face, and a fist, if anybody has fingers."""
    faces = [figure.face.moves for figure in shown.figures if figure.face is not None]
    moving = {name for moves in faces for name, shape in zip(FACE_NAMES, moves, strict=False) if np.any(shape)}
    found = {name: shapes for name, shapes in SLIDERS.items() if moving & set(shapes.split())}
    return found | ({"Fist": "fist"} if any(figure.rig.fingers is not None for figure in shown.figures) else {})


def _facts(shown: Exhibit, scene: Scene | None, packer: Packer) -> dict[str, Any]:
    """What the modules need beside arrays."""
    effects, cameras = shown.effects, shown.cameras
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = shown.turn.T, -shown.turn.T @ shown.spot
    shadow = None
    if effects.light is not None and all(figure.parts is not None for figure in shown.figures):
        names = ("darkness", "softness", "density", "size")
        shadow = {name: getattr(effects, name) for name in names} | {"light": np.asarray(effects.light).tolist()}
    return {
        "title": shown.title,
        "timesFit": shown.times_fit,
        "arrays": packer.table,
        "antialias": shown.figures[0].rig.antialias if scene is None else scene.antialias,
        "world": world.ravel().tolist(),
        "background": background([figure.rig for figure in shown.figures]),
        "people": [
            {
                "parents": np.asarray(figure.rig.parents).tolist(),
                "absent": list(figure.absent),
                "stand": {
                    "turn": figure.turn.ravel().tolist(),
                    "spot": figure.spot.tolist(),
                    "scale": figure.scale,
                },
            }
            for figure in shown.figures
        ],
        "shadow": shadow,
        "shading": None if effects.shading is None else np.asarray(effects.shading).tolist(),
        "motions": [{"name": move.name, "fps": move.fps} for move in shown.figures[0].moves],
        "clip": {
            "names": cameras.names,
            "size": [cameras.width, cameras.height],
            "middle": len(cameras) // 2,
            "pictures": _pictures(shown),
        },
    }


def _pictures(shown: Exhibit) -> list[tuple[int, str]]:
    """Frames spread over the clip, (frame, data: URL) each: at most PICTURES and about BYTES."""
    if shown.images is None:
        return []
    jpegs = [(i, _jpeg(shrink(shown.images(i), SIDE))) for i in evenly(len(shown.cameras), PICTURES)]
    while len(jpegs) > 1 and sum(len(data) for _, data in jpegs) > BYTES:
        jpegs = jpegs[::2]
    return [(i, f"data:image/jpeg;base64,{base64.b64encode(data).decode()}") for i, data in jpegs]


def _jpeg(pixels: np.ndarray) -> bytes:
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"no JPEG of a picture of shape {pixels.shape}")
    return data.tobytes()


def _lacks(shown: Exhibit) -> list[str]:
    """What was learned and the page does not show."""
    found = {
        "Colour of the person that changes with the view.": any(np.any(one.rig.shN) for one in shown.figures),
        "Colour of the scene that changes with the view.": shown.scene is not None and np.any(shown.scene.shN),
        "The person's shadow: there is no scene to fall on.": shown.effects.light is not None and shown.scene is None,
        "Motion blur and rolling shutter of the clip's camera.": shown.effects.shutter or shown.effects.readout,
    }
    return [sentence for sentence, true in found.items() if true]


def _largest(scene: Scene, count: int) -> Scene:
    """The Gaussians that cover most. Their order stays."""
    kept = np.sort(np.argsort(-covered(scene), kind="stable")[:count])
    names = ("means", "quats", "scales", "opacities", "sh0", "shN", "invented")
    rows: dict[str, Any] = {name: values[kept] for name in names if (values := getattr(scene, name)) is not None}
    return replace(scene, **rows)


def _json(value: object) -> Markup:
    """JSON that no HTML parser takes for the end of a script."""
    return Markup(json.dumps(value, separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c"))


def _text(name: str) -> str:
    return (ROOM / name).read_text(encoding="utf-8").rstrip("\n")
