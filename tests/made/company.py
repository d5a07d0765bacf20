"""The tiny clip with a second person: the first one's avatar in other colours, a step aside and nearer, who hides them at times."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import together
from stages.formats.cameras import read_cameras
from stages.formats.ground import read_ground
from stages.formats.images import write_image, write_mask
from stages.formats.people import folder_of
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.records import Effects
from stages.smpl import draw_fits
from tests.made import tiny
from tests.made.learned import draw, load_learned

ASIDE = np.array([0.75, 0.0, -0.3])  # m in a world with y down
INKS = [1, 2, 0]


def make(folder: Path) -> dict[str, Path]:
    """The folders of all stages up to train, as `tiny.make`; in frame `tiny.EMPTY` only the second is there."""
    folders = tiny.make(folder)
    sfm, smpl, train = folders["sfm"], folders["smpl"], folders["train"]
    first, scene, poses = (
        read_avatar(train / "avatar.npz"),
        read_scene(train / "scene.npz"),
        read_poses(train / "body.npz"),
    )
    second = replace(first, sh0=first.sh0[:, INKS])
    theirs = replace(poses, transl=poses.transl + ASIDE, confidence=np.ones(len(poses.names)))
    for stage in (smpl, train):
        folder_of(stage, 2).mkdir(parents=True)
        write_poses(folder_of(stage, 2) / "body.npz", theirs)
    shutil.copy(smpl / "smpl.json", folder_of(smpl, 2) / "smpl.json")
    write_splats(folder_of(train, 2) / "avatar.npz", second)
    people = [load_learned(one, scene, Effects()) for one in (first, second)]
    cameras = read_cameras(sfm / "cameras.npz")
    for k in (1, 2):
        (sfm / "people" / str(k) / "masks").mkdir(parents=True)
    for i, name in enumerate(cameras.names):
        there = [
            learned.person((body.global_orient[i], body.body_pose[i], body.transl[i]))
            for learned, body in zip(people, (poses, theirs), strict=True)
        ]
        if i == tiny.EMPTY:
            there[0] = there[0]._replace(opacities=0 * there[0].opacities)
        viewmat = cameras.viewmats[i].copy()
        viewmat[:3, 3] *= tiny.WORLD_FROM_SFM
        camera = Camera.of(viewmat, cameras.Ks[i], tiny.WIDTH, tiny.HEIGHT)
        write_image(sfm / "images" / f"{name}.png", to_uint8(draw(together(there), people[0].scene, camera)[0]))
        white = [
            one._replace(sh=0 * one.sh + (0.5 if k == j else -0.5) / tiny.SH_C0)
            for j in (0, 1)
            for k, one in enumerate(there)
        ]
        shares = [draw(together(white[2 * j : 2 * j + 2]), None, camera)[0][..., 0] for j in (0, 1)]
        write_mask(sfm / "masks" / f"{name}.png", to_uint8(draw(together(there), None, camera)[1]))
        for k, share in enumerate(shares, 1):
            write_mask(sfm / "people" / str(k) / "masks" / f"{name}.png", to_uint8(share))
    draw_fits(sfm, smpl, read_ground(smpl / "ground.json"))
    return folders
