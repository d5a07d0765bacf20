"""Path-traced clips: somebody in a yard in the sun, with soft shadows and the light that walls and floor throw back.

Importing this module needs `pip install mitsuba`. Every seed is another person, another yard and another way of filming.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import torch

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras.pinhole import pinhole
from stages.formats.body_model import read_body_model
from stages.records import BodyModel
from stages.synthetic import person
from stages.synthetic.files import write_clip
from stages.synthetic.room import make_room
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import ClipEffects, Course, distort, gains, margin, to_linear, to_srgb
from tests.made.synthetic.passers import Passer
from tests.made.synthetic.wardrobe import make_garments
from tests.made.yard import yard

mi.set_variant("scalar_rgb")

WIDTH, HEIGHT, FRAMES, FPS = 360, 640, 60, 12.0
EFFECTS = ClipEffects(exposure=0.05, white_balance=0.04, lens=-0.04, motion_blur=0.7)
BLURRED = 14, 15, 37, 38  # frames in which the shutter is open; in the others it is not
MOMENTS = 5  # of a blurred frame
RAYS, BOUNCES = 64, 5  # a pixel
FINE = 3  # triangles along the edge of one, for colours: about 5 mm
EDGE = 3  # points along a pixel's edge that tell the mask
BRIGHT = 0.42, 60  # what percentile of the first frame's light becomes so much


def make(folder: Path, seed: int, wears: Sequence[str]) -> Path:
    """Write the clip of a seed and its truth into `folder`, as `hugs demo` does; returns the video's path."""
    rng, model = np.random.default_rng([seed, 99]), read_body_model()
    room, betas = make_room(rng), rng.uniform(-1.6, 1.6, 10)
    garments = make_garments(wears, model, betas, np.random.default_rng([seed, 2]))
    tracer = Tracer(model, room, betas, pinhole(HEIGHT, WIDTH, HEIGHT), EFFECTS, garments=garments, seed=seed)
    viewmats = synthetic.camera_path(FRAMES, FPS, "moving", rng)
    orient, pose = person.make_motion(FRAMES, FPS, rng)
    gain = gains(EFFECTS, FRAMES, np.random.default_rng([seed, 1]))
    frames = tracer.views(viewmats, orient, pose, WIDTH, HEIGHT, lambda done: None, gain=gain, fps=FPS)
    orient, pose = person.novel_poses()
    tracer.effects = EFFECTS.scene_only()
    novel = tracer.views(synthetic.novel_cameras(len(pose)), orient, pose, WIDTH, HEIGHT, lambda done: None)
    return write_clip(folder, synthetic.SyntheticClip(frames, novel, betas, FPS))


@dataclass
class Tracer(synthetic.Renderer):
    """Draws the person of a seed in their yard; depths are not known."""

    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        rng = np.random.default_rng(self.seed)
        self.clothes, self.off = Dress(self.model, rng), stand_off(self.model, self.clothes.at)
        self.yard, self.exposure = yard(rng), 0.0
        self.share, small = _split(FINE)
        self.small = (small + len(self.share) * np.arange(len(self.faces))[:, None, None]).reshape(-1, 3)
        self.scene: Any = None

    def colors(self) -> np.ndarray:
        """Linear colours [P,3] of all points that `_place` takes."""
        skin = self.clothes(self._between(self.rest[self.skin_faces]))
        worn = [garment.paint(self._between(garment.chart)) for garment in self.garments]
        return to_linear(np.concatenate([skin, *worn]).clip(0, 1))

    def _between(self, corners: np.ndarray) -> np.ndarray:
        """What corners [T,3,C] of triangles have, at the points [P,C] of their small ones."""
        return np.einsum("bk,tkc->tbc", self.share, corners).reshape(-1, corners.shape[-1])

    def stands(self, course: Course, t: float) -> np.ndarray:
        """Vertices [V,3] of person and garments at a moment, with what stands off the body."""
        vertices, count = course.body(t).copy(), len(self.rest)
        vertices[:count] += self.off[:, None] * _normals(vertices[:count], self.skin_faces)
        return vertices

    def light(
        self, course: Course, t: float, K: np.ndarray, width: int, height: int, rays: int, seed: int
    ) -> np.ndarray:
        """Light [H,W,3] that falls on a pinhole's picture at a moment."""
        vertices = self.stands(course, t)
        places, normals = (self._between(part[self.faces]) for part in (vertices, _normals(vertices, self.faces)))
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
        self._place(places, normals)
        to_world = np.linalg.inv(course.viewmat(t)) @ np.diag([-1.0, -1, 1, 1])
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        wide = 2 * math.degrees(math.atan(width / 2 / K[0, 0]))
        camera = {"type": "perspective", "fov": wide, "fov_axis": "x", "near_clip": 0.05, "film": film}
        camera |= {"to_world": mi.ScalarTransform4f(to_world.tolist()), "sampler": {"type": "independent"}}
        path = mi.load_dict({"type": "path", "max_depth": BOUNCES})
        found = np.array(mi.render(self.scene, sensor=mi.load_dict(camera), spp=rays, seed=seed, integrator=path))
        if (lost := ~np.isfinite(found).all(2)).any():
            print(f"{lost.sum()} pixels of a picture are not finite and take its median")
            found[lost] = np.median(found[~lost], 0)
        return found

    def _place(self, places: np.ndarray, normals: np.ndarray) -> None:
        """Put the person's points [P,3] and normals [P,3] into the scene, which is loaded once."""
        flat = {"vertex_positions": places, "vertex_normals": normals}
        if self.scene is None:
            matt = {"type": "principled", "roughness": 0.6, "specular": 0.3}
            matt["base_color"] = {"type": "mesh_attribute", "name": "vertex_color"}
            props = mi.Properties()
            props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": matt})
            mesh = mi.Mesh("person", len(places), len(self.small), props, has_vertex_normals=True)
            mesh.add_attribute("vertex_color", 3, self.colors().astype(np.float32).ravel())
            _set(mi.traverse(mesh), flat | {"faces": self.small})
            self.scene = mi.load_dict(self.yard | {"person": mesh})
        else:
            _set(mi.traverse(self.scene), {f"person.{key}": value for key, value in flat.items()})

    def shoot(
        self, course: Course, i: int, width: int, height: int, passers: Sequence[Passer], gain: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `_Renderer.shoot`; the depth is 1 everywhere."""
        open_for = self.effects.motion_blur if i in BLURRED else 0.0
        times = open_for * ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5) if open_for else np.zeros(1)
        K, wide, tall, pad = self._padded(1, width, height)
        rays = RAYS // len(times)
        light = np.mean([self.light(course, i + t, K, wide, tall, rays, 1000 * i + k) for k, t in enumerate(times)], 0)
        self.exposure = self.exposure or BRIGHT[0] / np.percentile(light.mean(2), BRIGHT[1])
        bright = light * self.exposure * gain
        bright = bright / (1 + 0.25 * bright)  # a soft shoulder
        image = distort(255 * to_srgb(bright.clip(0, 1)), self.effects, self.K, pad)
        K, wide, tall, pad = self._padded(EDGE, width, height)
        seen = np.mean([self._seen(course, i + t, K, wide, tall) for t in times], 0)
        mask = distort(255.0 * seen[..., None], self.effects, self.K * [[EDGE], [EDGE], [1]], pad)
        rounded = image.clip(0, 255).round().astype(np.uint8), synthetic.shrink(mask, EDGE)[..., 0]
        return *rounded, np.ones((height, width), np.float32)

    def _padded(self, more: int, width: int, height: int) -> tuple[np.ndarray, int, int, int]:
        """K, width, height of a picture `more` times as fine with the margin that the lens looks at, and that margin."""
        fine = self.K * np.array([[more], [more], [1]])
        pad = margin(self.effects, fine, width * more, height * more)
        return fine + [[0, 0, pad], [0, 0, pad], [0, 0, 0]], width * more + 2 * pad, height * more + 2 * pad, pad

    def _seen(self, course: Course, t: float, K: np.ndarray, width: int, height: int) -> np.ndarray:
        return self.fill(course, lambda moment: self.stands(course, moment), self.faces, t, K, width, height)[1] >= 0


class Dress(person.Outfit):
    """A T-shirt with a print and stripes, and long trousers, in colours by chance."""

    def __init__(self, model: BodyModel, rng: np.random.Generator):
        super().__init__(model)
        self.inks, self.stripes = rng.uniform(0.08, 0.8, (4, 3)), rng.uniform(18, 40)

    def _shirt(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        color = np.broadcast_to(self.inks[0], (len(x), 3)).copy()
        color[(abs(x) < 0.07) & (abs(y - 0.25) < 0.05) & (z > 0.02)] = self.inks[1]
        color[abs(np.sin(self.stripes * y)) > 0.96] = self.inks[2]
        return color * (1 + 0.06 * np.sin(90 * x + 40 * y + 70 * z))[:, None]

    def _legs(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return 0.6 * self.inks[3] * (1 + 0.12 * np.sin(60 * y + 20 * x) * np.sin(35 * z))[:, None]


def stand_off(model: BodyModel, at: dict[str, np.ndarray]) -> np.ndarray:
    """How far hair, a shirt with folds and soles stand off the skin [V] in m; keypoints are `at` places [3] m at rest."""
    x, y, z = np.asarray(model.v_template, np.float64).T
    head, eye = abs(x) < 0.15, at["left_eye"]
    behind = (z < eye[2] - 0.11) & (y > at["nose"][1] - 0.05)
    hair = ((y - eye[1] - 0.04) / 0.03).clip(0, 1) * head + 0.8 * (behind & head)
    waist, neck = at["left_hip"][1] + 0.05, at["left_shoulder"][1]
    shirt = ((y - waist) / 0.03).clip(0, 1) * ((neck - 0.02 - y) / 0.05).clip(0, 1) * (abs(x) < 0.22)
    folds = 1 + 0.5 * np.sin(38 * y + 25 * x)
    sole = ((at["left_ankle"][1] - 0.01 - y) / 0.03).clip(0, 1)
    return 0.022 * hair.clip(0, 1) + 0.013 * shirt * folds + 0.006 * sole


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    found = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    return found / np.linalg.norm(found, axis=1, keepdims=True).clip(1e-12)


def _split(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A triangle as n*n small ones: shares [B,3] of its corners at their corners, and small triangles [n*n,3]."""
    share = [(n - i - j, i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    row = {(i, j): k for k, (_, i, j) in enumerate(share)}
    small = [(row[i, j], row[i + 1, j], row[i, j + 1]) for i in range(n) for j in range(n - i)]
    small += [(row[i + 1, j], row[i + 1, j + 1], row[i, j + 1]) for i in range(n) for j in range(n - 1 - i)]
    return np.array(share) / n, np.array(small)


def _set(parts: Any, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays into an object that Mitsuba has opened, and let it take them in."""
    for name, array in arrays.items():
        parts[name] = array.astype(np.uint32 if name.endswith("faces") else np.float32).ravel()
    parts.update()
