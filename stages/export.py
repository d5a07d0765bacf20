"""Write person and scene in the formats that other programs open."""

from __future__ import annotations

import shutil
from pathlib import Path

from stages import contract
from stages.contract import Job


class Params(contract.Params):
    pass


def run(job: Job, params: Params, *, train: Path) -> None:
    """Write avatar.ply (canonical pose, y up), avatar.npz (skeleton and weights) and scene.ply (world), in metres."""
    from stages.formats.ply import write_ply
    from stages.formats.splats import read_avatar, read_scene

    avatar = read_avatar(train / "avatar.npz")
    bounded = write_ply(job.out / "avatar.ply", avatar)
    shutil.copyfile(train / "avatar.npz", job.out / "avatar.npz")
    said = f"avatar {len(avatar)} Gaussians"
    if (train / "scene.npz").exists():
        scene = read_scene(train / "scene.npz")
        bounded += write_ply(job.out / "scene.ply", scene)
        said += f", scene {len(scene)}"
    job.note(said)
    if avatar.clothes is not None:
        away = 100 * avatar.clothes.largest
        job.note(
            f"clothes that move with the pose (by up to {away:.1f} cm) are in avatar.npz alone: .ply knows no poses"
        )
    if avatar.antialias:
        job.note("learned with antialiasing: viewers must have it on, else what is small looks too strong")
    if bounded:
        job.note(f"{bounded} opacities of 0 or 1 written as logits of +-15")
