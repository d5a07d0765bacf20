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
    sizes = f"avatar {len(avatar)} Gaussians"
    if (train / "scene.npz").exists():
        scene = read_scene(train / "scene.npz")
        bounded += write_ply(job.out / "scene.ply", scene)
        sizes += f", scene {len(scene)}"
    job.note(sizes)
    if avatar.clothes is not None:
        away = 100 * avatar.clothes.largest
        job.note(
            f"clothes that move with the pose (by up to {away:.1f} cm) are only in avatar.npz: a .ply has no poses"
        )
    if avatar.antialias:
        job.note("learned with anti-aliasing: enable it in the viewer, or thin parts look too opaque")
    if bounded:
        job.note(f"{bounded} opacities of 0 or 1 written as logits of +-15")
