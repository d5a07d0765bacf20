"""A work folder with a clip that looks as if `hugs run` had finished it: the tiny clip, its body not at the origin, as SMPL's."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hugs_cli.cache.fingerprint import FORMAT, Code, content_digest
from hugs_cli.cache.workspace import Stamp
from hugs_cli.film import MODULE
from hugs_cli.options import CODE_MEMORY
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, write_splats
from tests.made import tiny

STAGES = ("frames", "sfm", "smpl", "survey", "train")


def make(folder: Path, clip: str = "clip", shift: tuple[float, float, float] = (0.01, -0.225, 0.03)) -> Path:
    """Write CLIP.mp4 and work/CLIP/default with the results that others draw from; returns the folder of links."""
    made = tiny.make(folder / f"made_{clip}")
    move_pelvis(made, np.array(shift))
    listing = json.loads((made["frames"] / "frames.json").read_bytes())
    listing["video"]["path"] = f"{clip}.mp4"
    (made["frames"] / "frames.json").write_text(json.dumps(listing))
    store, links = folder / f"work/{clip}/store", folder / f"work/{clip}/default"
    links.mkdir(parents=True)
    (folder / "work" / CODE_MEMORY).write_text(code_memory())
    (folder / f"{clip}.mp4").write_text(f"pixels of {clip}")
    film = {"video": content_digest(folder / f"{clip}.mp4")}
    for name in STAGES:
        shutil.copytree(made[name], store / f"{name}-01234567")
        (links / name).symlink_to(f"../store/{name}-01234567")
        stamp(name, inputs=film).write(store / f"{name}-01234567")
    return links


@cache
def code_memory() -> str:
    """What a run leaves of the code that draws, which takes a second to look into."""
    code = Code()
    code.digests(MODULE)
    return json.dumps({"format": FORMAT, "modules": code.used})


def stamp(stage: str, key: str = "", **facts: Any) -> Stamp:
    """A stamp of a result, of nothing in particular."""
    made_of = {"seed": 0, "code": {}, "params": {}, "inputs": {}, "content": "", "files": {}, "seconds": 1.0} | facts
    machine = {"host": "h", "device": "cpu", "system": "s", "processors": 1, "versions": {}}
    return Stamp(stage, key, **made_of, made="2026-01-01T00:00:00+00:00", peak_memory_bytes=0, machine=machine)


def move_pelvis(made: dict[str, Path], shift: np.ndarray) -> None:
    """The same clip by a body whose pelvis is `shift` m from where it was at rest."""
    model = read_body_model(made["smpl"] / "body_model.npz")
    write_body_model(made["smpl"] / "body_model.npz", replace(model, v_template=model.v_template + shift))
    avatar = read_avatar(made["train"] / "avatar.npz")
    moved = replace(avatar, means=avatar.means + shift, joints=avatar.joints + shift)
    write_splats(made["train"] / "avatar.npz", moved)
    for path in (made["smpl"] / "body.npz", made["train"] / "body.npz"):
        poses = read_poses(path)
        write_poses(path, replace(poses, transl=poses.transl - shift))
