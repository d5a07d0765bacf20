"""How like the Gaussians the mesh of avatar.glb is, drawn by three.js: outline and LPIPS.

    python -m tests.benchmarks.mesh work/clip/default [avatar.npz ...] [--pictures FOLDER] [--json out.json]

Of a result or an avatar file: from eight sides standing, and in three new poses, against the Gaussians' own pictures; of a
result also in its held-out frames, mesh and Gaussians each against the clip's picture cut out by its mask. Outlines are coverage
from one half on; LPIPS is over white in the box of the person, and in the whole picture as `lpips_whole`. How much of it is the
outline: `lpips_sharp` is of the Gaussians' own picture cut sharp at coverage one half, `lpips_soft` of the mesh's with the
Gaussians' coverage.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
from stages.avatar.drawing.cast import Moment
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.takes import hung
from stages.avatar.drawing.turntable import around, standing
from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import over_white, person_crop
from stages.avatar.motion.formulas import MOTIONS
from stages.avatar.motion.takes import FPS, SECONDS, take_of
from stages.avatar.rasterize import Camera
from stages.avatar.surface.mesh import surface_of
from stages.estimators.assets import fetch
from stages.filming.clip_cast import load_cast
from stages.formats.exchange.avatar_glb import write_avatar_glb
from stages.formats.images import write_image
from stages.formats.splats import read_avatar
from stages.records import Avatar
from tests.made.three_page import FINER, opened

NEW = {"walk_in_place": 20, "jumping_jacks": 45, "squats": 30}  # motion -> its picture


class Shot(NamedTuple):
    """A picture that is asked: its kind, which pose, by which camera; the clip's own over white and its mask, if any."""

    kind: str
    pose: int
    camera: Camera
    clip: np.ndarray | None = None
    mask: np.ndarray | None = None


def sides(person: PosedAvatar) -> Iterator[Shot]:
    """Eight sides of each of the four poses, of which the first stands."""
    for pose, kind in enumerate(["standing", *NEW]):
        for camera in around(person.splats(pose).means.numpy(), 8):
            yield Shot(kind, pose, camera)


def poses(avatar: Avatar) -> PosedAvatar:
    """Standing, and the new poses."""
    parts = [standing()]
    for name, picture in NEW.items():
        turns, bends, places = (part.numpy()[picture] for part in MOTIONS[name](SECONDS, FPS))
        parts.append((turns, bends, places))
    return PosedAvatar.of(load_avatar(avatar), *(np.stack(part) for part in zip(*parts)))


def heldout(run: Path) -> tuple[PosedAvatar, list[Shot]]:
    """The person of a result in its held-out frames."""
    clips, cast = load_cast(run / "sfm", run / "smpl", run / "train", "cpu")
    clip, person = clips[0], cast.people[0]
    rows = [int(i) for i in np.flatnonzero(clip.heldout) if clip.shows_person(int(i))]
    shots = []
    for pose, i in enumerate(rows):
        mask = torch.as_tensor(clip.own_mask(i) / np.float32(255))
        white = over_white(torch.as_tensor(clip.images(i) / np.float32(255)), mask).numpy()
        camera = Camera.of(clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
        shots.append(Shot("heldout", pose, camera, white, mask.numpy()))
    some = (part[rows] for part in (person.global_orient, person.body_pose, person.transl))
    return PosedAvatar(person.avatar, *some), shots


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Of two outlines [H,W]."""
    a, b = a > 0.5, b > 0.5
    return float((a & b).sum() / max((a | b).sum(), 1))


def measure(
    avatar: Avatar, person: PosedAvatar, shots: list[Shot], lpips: Lpips, pictures: Path | None
) -> dict[str, dict[str, float]]:
    """Means by kind of picture."""
    began = time.process_time()
    mesh = surface_of(avatar)
    spent = time.process_time() - began
    rig = rig_of(avatar)
    asked = [*range(len(person.transl)), -1]  # the last twice: at its end a motion begins again
    turns, bends, places = (part.numpy()[asked].astype(float) for part in _pose(person))
    take = take_of("asked", np.arange(len(asked)) * 1.0, turns, bends, places + rig.joints[0])
    rows: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder, "avatar.glb")
        write_avatar_glb(glb, rig, mesh, [hung(person.avatar, take)])
        size = glb.stat().st_size / 1e6
        with opened(glb, Path(folder)) as page:
            found: dict[str, Any] = {"glb": page.found | {"MB": size, "cpu_s": spent, "said": mesh.said}}
            for number, shot in enumerate(shots):
                drawn = page.picture("asked", float(shot.pose), shot.camera)
                image, alpha = Moment([person.splats(shot.pose)]).picture(shot.camera, 1.0)
                row, strip = compare(drawn, image, alpha, shot, lpips)
                rows.setdefault(shot.kind, []).append(row)
                if pictures and number % 2 == 0:
                    write_image(pictures / f"{shot.kind}{number:03d}.png", to_uint8(strip))
    return found | {
        kind: {key: float(np.mean([row[key] for row in own])) for key in own[0]} for kind, own in rows.items()
    }


def compare(
    drawn: np.ndarray, image: np.ndarray, alpha: np.ndarray, shot: Shot, lpips: Lpips
) -> tuple[dict[str, float], np.ndarray]:
    """Numbers of one picture, and what was compared side by side."""
    truth, mask = (image, alpha) if shot.clip is None or shot.mask is None else (shot.clip, shot.mask)
    box = person_crop(torch.as_tensor(np.maximum(mask, alpha)))
    assert box is not None

    def apart(one: np.ndarray, where: Any = box) -> float:
        cut = [torch.as_tensor(np.ascontiguousarray(part[where])).float().clamp(0, 1) for part in (one, truth)]
        return float(lpips(*cut))

    shown = drawn[..., :3]
    row = {"iou": iou(drawn[..., 3], mask), "lpips": apart(shown), "lpips_whole": apart(shown, np.s_[:])}
    if shot.clip is not None:
        row |= {"gaussians_iou": iou(alpha, mask), "gaussians_lpips": apart(image)}
    else:
        row |= {
            "lpips_sharp": apart(covered(image, alpha, cut(alpha))),
            "lpips_soft": apart(covered(shown, drawn[..., 3], alpha)),
        }
    return row, np.concatenate([part[box] for part in (truth, image, shown)], 1)


def cut(alpha: np.ndarray) -> np.ndarray:
    """Coverage [H,W] of what is covered by one half or more: drawn FINER times finer, and averaged, as the mesh is."""
    height, width = alpha.shape
    fine = cv2.resize(alpha, (FINER * width, FINER * height), interpolation=cv2.INTER_LINEAR) >= 0.5
    return fine.reshape(height, FINER, width, FINER).mean((1, 3))


def covered(image: np.ndarray, had: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """A picture [H,W,3] over white whose coverage was `had` [H,W], with the coverage `alpha`; colours beyond are the nearest."""
    colours = (image - 1 + had[..., None]) / np.maximum(had, 1e-3)[..., None]
    near = distance_transform_edt(had < 0.5, return_distances=False, return_indices=True)
    return colours[tuple(near)] * alpha[..., None] + 1 - alpha[..., None]


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with np.load(fetch("lpips_alex.npz")) as weights:
        lpips = Lpips(weights)
    found = {}
    for path in args.results:
        avatar = read_avatar(path / "train" / "avatar.npz" if path.is_dir() else path)
        person = poses(avatar)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
        shots = list(sides(person))
        if path.is_dir():
            clip, more = heldout(path)
            shots += [shot._replace(pose=shot.pose + len(person.transl)) for shot in more]
            both = (torch.cat(parts) for parts in zip(_pose(person), _pose(clip)))
            person = PosedAvatar(person.avatar, *both)
        with torch.no_grad():
            found[str(path)] = measure(replace(avatar), person, shots, lpips, args.pictures)
        print(json.dumps({str(path): found[str(path)]}, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


def _pose(person: PosedAvatar) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return person.global_orient.float(), person.body_pose.float(), person.transl.float()


if __name__ == "__main__":
    main()
