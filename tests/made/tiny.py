"""What the stages up to train leave of a clip that needs none of them: 8 frames of the free body before a green wall.

The body's front is red, its back blue, its left arm green, its head yellow. The pictures are drawn from the avatar
itself, so at the true poses held-out frames differ from the clip by rounding only. Frame 7, held out, shows nobody.
"""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import DA_POSE, Body, vertex_normals
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.motion.placing import Soles
from stages.avatar.rasterize import Camera
from stages.contract import StageRecord
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import write_cameras
from stages.formats.ground import read_ground, write_ground
from stages.formats.images import write_image, write_mask
from stages.formats.points import write_points
from stages.formats.poses import write_poses
from stages.formats.splats import write_splats
from stages.records import Avatar, BodyPoses, Cameras, Effects, Ground, Scene
from stages.smpl import draw_fits
from tests.made.learned import draw, load_learned

FRAMES, WIDTH, HEIGHT, EMPTY = 8, 96, 128, 7
FOCAL = 100.0
WORLD_FROM_SFM = 2.0  # metres per SfM unit, so that forgetting it is seen
SH_C0 = 0.28209479
RED, BLUE, GREEN, YELLOW = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9], [0.1, 0.7, 0.1], [0.9, 0.9, 0.1]])
LEFT_ARM, HEAD = [16, 18, 20, 22], [15]
STAGES = ("frames", "masks", "sfm", "smpl", "survey", "train")
NAMES = tuple(f"{3 * i:06d}" for i in range(FRAMES))


def colour_of(pixels: np.ndarray) -> np.ndarray:
    """Which of red, blue, green, yellow (0 to 3) each pixel uint8 [...,3] is near to, or -1."""
    away = np.abs(pixels[..., None, :] / 255 - np.stack([RED, BLUE, GREEN, YELLOW])).max(-1)
    return np.where(away.min(-1) < 0.2, away.argmin(-1), -1)


def make_avatar(body_model, every: int = 4) -> Avatar:
    """One opaque Gaussian on every 4th vertex of the body at its canonical pose."""
    body, betas = Body(body_model), torch.zeros(10)
    posed, _ = body(betas, torch.zeros(1, 3), DA_POSE[None], torch.zeros(1, 3))
    front = vertex_normals(body.rest(betas)[0], torch.as_tensor(body_model.faces).long())[:, 2].numpy() > 0
    weights = body_model.lbs_weights
    rgb = np.where(front[:, None], RED, BLUE)
    rgb[weights[:, LEFT_ARM].sum(1) > 0.5] = GREEN
    rgb[weights[:, HEAD].sum(1) > 0.5] = YELLOW
    return Avatar(
        **spots(posed[0].numpy()[::every], rgb[::every], 0.026),
        lbs_weights=weights[::every],
        joints=body.rest(betas)[1].numpy(),
        parents=np.asarray(body_model.parents),
        betas=np.zeros(10),
        canonical_pose=DA_POSE.numpy(),
    )


def make_scene() -> Scene:
    """A wall 4.5 m ahead, dark and grey-green in checks, unlike any colour of the person."""
    x, y = np.meshgrid(np.linspace(-3, 3, 21), np.linspace(-3, 3, 21))
    tone = 0.15 + 0.3 * ((np.arange(21)[:, None] // 2 + np.arange(21) // 2) % 2)
    rgb = tone.reshape(-1, 1) * [0.9, 1.0, 0.95]
    return Scene(**spots(np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.5)], 1), rgb, 0.15))


def spots(means: np.ndarray, rgb: np.ndarray, size: float) -> dict[str, np.ndarray]:
    """Round, nearly opaque Gaussians of one colour each."""
    n = len(means)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    more = {"sh0": (rgb - 0.5) / SH_C0, "shN": np.zeros((n, 0, 3))}
    return {"means": means, "quats": quats, "scales": np.full((n, 3), size), "opacities": np.full(n, 0.97)} | more


def make_poses() -> BodyPoses:
    """A standing body 3 m ahead that turns a little and moves its arms; y is down, so it is turned over about x."""
    turn = np.linspace(-0.4, 0.4, FRAMES)
    orient = (Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_euler("y", turn[:, None])).as_rotvec()
    pose = np.zeros((FRAMES, 69))
    pose[:, 47], pose[:, 50] = -0.6 - turn, 0.6 - turn
    transl = np.stack([0.3 * turn, np.full(FRAMES, -0.2), np.full(FRAMES, 3.0)], 1)
    present = np.arange(FRAMES) != EMPTY
    return BodyPoses(NAMES, np.zeros(10), orient, pose, transl, present.astype(float), WORLD_FROM_SFM)


def make_ground(poses: BodyPoses, body_model) -> Ground:
    """The level floor under the lowest sole, below where the body stands in the middle frame."""
    soles, middle = Soles.of_model(body_model, poses.betas), len(poses) // 2
    points, joints = soles.at(poses.global_orient, poses.body_pose, poses.transl)
    ahead = Rotation.from_rotvec(poses.global_orient[middle]).apply([0, 0, 1])
    point = np.array([joints[middle, 0, 0], points[..., 1].max(), joints[middle, 0, 2]])
    return Ground(point, np.array([0.0, -1, 0]), ahead, WORLD_FROM_SFM, 0.01, 0.01, 40, "made")


def make_viewmats() -> np.ndarray:
    """Cameras [C,4,4] in metres, moving sideways by 0.6 m while they look at the person."""
    return np.stack(
        [look_at(np.array([x, 0, 0]), np.array([0, 0, 3.0]), np.array([0, -1, 0])) for x in np.linspace(-0.3, 0.3, 8)]
    )


def make(folder: Path, scene: bool = True) -> dict[str, Path]:
    """Write the folders of all stages up to train; stage name -> folder. Drawn once a process, then copied."""
    shutil.copytree(drawn(scene).name, folder, dirs_exist_ok=True)
    return {name: folder / name for name in STAGES}


@cache
def drawn(scene: bool) -> TemporaryDirectory:
    """A folder with the folders of all stages, which is removed when the process ends."""
    kept = TemporaryDirectory()
    folders = {name: Path(kept.name) / name for name in STAGES}
    pictures = [folders[name] / "images" for name in ("frames", "sfm")]
    masks = [folders[name] / "masks" for name in ("masks", "sfm")]
    for place in (*folders.values(), *pictures, *masks):
        place.mkdir(parents=True)
    sfm, smpl, train = folders["sfm"], folders["smpl"], folders["train"]
    body_model, poses, viewmats = read_body_model(), make_poses(), make_viewmats()
    avatar, wall = make_avatar(body_model), make_scene()
    K = pinhole(FOCAL, WIDTH, HEIGHT)
    in_sfm = viewmats.copy()
    in_sfm[:, :3, 3] /= WORLD_FROM_SFM
    write_cameras(sfm / "cameras.npz", Cameras(NAMES, in_sfm, np.tile(K, (FRAMES, 1, 1)), WIDTH, HEIGHT))
    points = wall.means[::7] / WORLD_FROM_SFM if scene else np.zeros((0, 3))
    write_points(sfm / "points.ply", points, np.full(points.shape, 90, np.uint8))
    for path in (smpl, train):
        write_poses(path / "body.npz", poses)
    write_body_model(smpl / "body_model.npz", body_model)
    write_ground(smpl / "ground.json", make_ground(poses, body_model))
    expected = {name: {"along": [40] * 24, "across": [15] * 24} for name in poses.names[:-1]}
    (smpl / "smpl.json").write_text(json.dumps({"expected_error_mm": expected}))
    write_splats(train / "avatar.npz", avatar)
    if scene:
        write_splats(train / "scene.npz", wall)
    learned = load_learned(avatar, wall, Effects())
    for i, name in enumerate(NAMES):
        human = learned.person((poses.global_orient[i], poses.body_pose[i], poses.transl[i])) if i != EMPTY else None
        camera = Camera.of(viewmats[i], K, WIDTH, HEIGHT)
        image, _ = draw(human, learned.scene, camera)
        mask = draw(human, None, camera)[1] if human else np.zeros((HEIGHT, WIDTH))
        for place in pictures:
            write_image(place / f"{name}.png", to_uint8(image))
        for place in masks:
            write_mask(place / f"{name}.png", to_uint8(mask))
    write_facts(folders, scene)
    draw_fits(sfm, smpl, read_ground(smpl / "ground.json"))
    return kept


def write_facts(folders: dict[str, Path], scene: bool) -> None:
    """The JSON files."""
    video = {"path": "/clips/dance <1>.mp4", "width": WIDTH, "height": HEIGHT, "fps": 30, "frames": 24}
    listed = [{"name": name, "index": 3 * i, "time_s": 3 * i / 30} for i, name in enumerate(NAMES)]
    measures = {"points": {"value": 63, "unit": "", "threshold": 100, "verdict": "few", "frames": []}}
    effect = {"value": 0.21, "unit": "of the light", "threshold": 0.08, "verdict": "darkens", "confidence": 0.5}
    effects = {
        "shadow": effect | {"frames": ["000003"], "on": True},
        "sky": effect | {"value": None, "frames": [], "on": False},
    }
    facts = {
        "frames/frames.json": {"video": video, "width": WIDTH, "height": HEIGHT, "frames": listed},
        "sfm/sfm.json": {"verdict": "moving", "distortion": {"max_shift_px": 0.0}},
        "survey/survey.json": {
            "measures": measures,
            "effects": effects,
            "decisions": {"scene": scene, "exposure": False},
            "starts": {},
        },
        "train/train.json": {
            "steps": 2,
            "exposure": {},
            "effects": {"shadow": {"psnr": 0.5, "psnr_person": 1.25, "seconds": 7.0}},
            "seconds_by_part": {"drawing": 9.0, "other": 3.0},
        },
    }
    for path, value in facts.items():
        (folders["frames"].parent / path).write_text(json.dumps(value))
    rows = ["step,seconds,psnr,ssim,psnr_person,ssim_person,human,scene,memory_bytes"]
    rows += [f"{s},{s * 3},{20 + s},0.9,{18 + s},0.8,1723,441,1000" for s in (1, 2, 4)]
    (folders["train"] / "curve.csv").write_text("\n".join(rows) + "\n")


UPSTREAM = {
    name: StageRecord(1.5 + i, 200 << 20, ("8 frames",), ("the camera <b>barely</b> moved",) if name == "sfm" else ())
    for i, name in enumerate(STAGES)
}
"""The records of all stages up to train, as the engine hands them to a stage."""
