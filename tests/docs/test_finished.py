"""Each command of the documents that takes a finished run, or an avatar's file, is run on a small one; its files are there."""

import csv
import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.rig import rig_of
from stages.formats.body_model import read_body_model
from stages.formats.cameras import write_cameras
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.splats_glb import write_splats_glb
from stages.formats.hands_face import read_hands_face
from stages.formats.poses import write_poses
from stages.formats.splats import read_avatar, write_splats
from stages.formats.video import write_video
from stages.gestures import FACE_NAMES
from stages.records import BodyPoses, Cameras
from tests.docs.documents import TAKEN, of_finished_runs
from tests.made import bvh, handed, tiny
from tests.made.documented import PIPELINES, Place

pytestmark = pytest.mark.slow

MADE = {
    "hugs animate dance.mp4 moves.bvh": "dance-moves.mp4",
    "hugs animate --avatar avatar.npz moves.bvh": "avatar-moves.mp4",
    "hugs export dance.mp4 --out assets --formats glb": "assets/avatar.glb",
    "hugs export dance.mp4 --out web --formats spz --spz-axes y_up": "web/avatar.spz",
    "hugs render --avatar avatar.npz --out around/": "around/000.png",
    "hugs compose --init work/kitchen/default work/dance/default": "film.yaml",
    "hugs compose film.yaml": "film.mp4",
}
"""Command -> a file that it promises."""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    """Two finished runs, of dance.mp4 and kitchen.mp4, and the files that the documents name."""
    folder = tmp_path_factory.mktemp("finished")
    file = handed.pipelines(folder)
    stages = json.loads(file.read_text())
    small = {"formats": ["viewer", "glb"], "triangles": 300, "texture": 64}
    needs = {"export": ["frames", "sfm", "smpl", "train"], "evaluate": ["sfm", "smpl", "train"]}
    stages["default"]["stages"] |= {
        "export": {"needs": needs["export"], "module": "stages.export", "params": small},
        "evaluate": {"needs": needs["evaluate"], "module": "stages.evaluate", "params": {"fit_steps": 0}},
    }
    (folder / PIPELINES).write_text(json.dumps(stages))
    body, made = read_body_model(), folder / "made/train/avatar.npz"
    avatar = attach(read_avatar(made), body, read_hands_face(body))
    for path in (made, folder / "avatar.npz"):
        write_splats(path, avatar)
    write_splats_glb(folder / "avatar_splats.glb", rig_of(avatar), [])
    rng = np.random.default_rng(0)
    for clip in ("dance", "kitchen"):
        write_video(folder / f"{clip}.mp4", rng.integers(0, 255, (12, 64, 48, 3), np.uint8), 12)
    files(folder, avatar.joints)
    return Place(folder)


def files(folder: Path, joints: np.ndarray) -> None:
    """Motions, cameras, a face and scenes."""
    local, hips = np.tile(np.eye(3), (4, 24, 1, 1)), np.tile([0.0, 1, 0], (4, 1))
    bvh.write_bvh(folder / "moves.bvh", joints, local, hips, bvh.a_pose())
    still = np.zeros((1, 3))
    write_poses(
        folder / "moves.npz", BodyPoses(("000",), np.zeros(10), still, np.zeros((1, 69)), still, np.ones(1), 1.0)
    )
    ahead = look_at(np.array([0.0, 0, 3]), np.zeros(3), np.array([0.0, 1, 0]))
    cameras = Cameras(("000",), ahead[None], pinhole(100.0, 96, 128)[None], 96, 128)
    for name in ("path.npz", "views.npz"):
        write_cameras(folder / name, cameras)
    with open(folder / "take.csv", "w", newline="") as file:
        csv.writer(file).writerows([["time", *FACE_NAMES], *([0.1 * i, *[0.1] * len(FACE_NAMES)] for i in range(4))])
    for name in ("room.ply", "cleaned.ply"):
        write_ply(folder / name, tiny.make_scene())


def test_each_command_does_what_it_says(place):
    for clip in ("dance", "kitchen"):
        place.hugs(f"hugs run {clip}.mp4")
    found = of_finished_runs()
    assert {line.split()[1] for line in found} == set(TAKEN) and set(MADE) <= set(found)
    for line in found:
        words = shlex.split(line)
        if "--out" in words:
            shutil.rmtree(place.folder / words[words.index("--out") + 1], ignore_errors=True)
        place.hugs(line, *(["--force"] if words[1] in ("animate", "compose") else []))
        assert line not in MADE or (place.folder / MADE[line]).stat().st_size, line
