"""What a film is written as: films of pieces that are kept, pictures, and files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.drawing.takes import hung
from stages.avatar.motion.takes import take_of
from stages.avatar.splats.factor import factored
from stages.avatar.splats.sh import with_gain
from stages.avatar.splats.turn import OVER, turned
from stages.avatar.surface.mesh import NoSurfaceError, surface_of
from stages.contract import StageError
from stages.filming.cast import Actor
from stages.filming.parts import Parts, spans
from stages.filming.shoot import Shoot
from stages.formats.exchange.film_glb import Stand, write_film_glb
from stages.formats.exchange.limits import held
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.spz import write_spz
from stages.formats.exchange.usd import write_usd
from stages.formats.images import write_image
from stages.formats.video import join_videos, write_alpha_video, write_video
from stages.records import Mesh, Scene, Take

MESH = 10_000, 1024  # triangles and px of the texture of each person of a .glb
PIECE = 2.0  # s of film that are drawn and kept as one
S = TypeVar("S", bound=Scene)
SPLATS: dict[str, Callable[[Path, Scene], dict[str, int]]] = {".ply": write_ply, ".spz": write_spz}


def film(shoot: Shoot, out: Path, parts: Parts, alone: bool, progress: Callable[[int], None]) -> bool:
    """The film, or the people `alone` with alpha; whether it was made. What was drawn before is kept, piece by piece.

    `progress` hears of each picture that is done.
    """
    pieces, done = list(spans(shoot.count, max(1, round(PIECE * shoot.fps)))), 0
    keys = [shoot.made_of(piece) for piece in pieces]

    def shot(piece: range, done: int) -> Iterator[np.ndarray]:
        for number, picture in enumerate(shoot.pictures(piece, alone), start=1):
            yield picture
            progress(done + number)

    def make(out: Path) -> None:
        nonlocal done
        paths = []
        for piece, key in zip(pieces, keys, strict=True):
            path = parts.piece(out.suffix, key, shoot.fps)
            if not path.is_file():
                if alone:
                    write_alpha_video(path, shot(piece, done), shoot.fps)
                else:
                    write_video(path, shot(piece, done), shoot.fps)
            done += len(piece)
            progress(done)
            paths.append(path)
        join_videos(out, paths, shoot.fps)

    made = parts.bring(out, make, keys, shoot.fps, alone)
    for key in keys:
        parts.piece(out.suffix, key, shoot.fps)  # kept for the next run
    return made


def still(shoot: Shoot, folder: Path, seconds: float, parts: Parts) -> bool:
    """A picture at a second of the film, named after it; whether it was made."""
    number = shoot.where(seconds)
    out = folder / f"{seconds:07.3f}.png"
    return parts.bring(out, lambda part: write_image(part, shoot.picture(number)), shoot.made_of([number]))


def check_splats(out: Path) -> None:
    """StageError unless the file's ending is that of one of SPLATS."""
    if out.suffix.lower() not in SPLATS:
        raise StageError(f"cannot write {out}", "give a .ply or an .spz", [f"it ends in {out.suffix!r}"])


def splats(shoot: Shoot, out: Path, seconds: float, parts: Parts) -> tuple[bool, list[str]]:
    """People and scene as one set of Gaussians, y down as viewers take it; whether it was made, and what was then held at
    the format's limits.
    """
    number, said = shoot.where(seconds), []

    def make(part: Path) -> None:
        whole = joined([factored(one) for one in shoot.at(number).sets])
        down = whole if shoot.setting.ground.up[1] < 0 else turned(whole, OVER)
        said.extend(held(out.name, SPLATS[out.suffix.lower()](part, down)))

    return parts.bring(out, make, shoot.made_of([number])), said


def joined(sets: list[Scene]) -> Scene:
    """Sets of Gaussians as one, with as many colours as the richest has."""
    most = max(one.shN.shape[1] for one in sets)
    rich = [np.pad(one.shN, ((0, 0), (0, most - one.shN.shape[1]), (0, 0))) for one in sets]
    names = ("means", "quats", "scales", "opacities", "sh0")
    rows: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in sets]) for name in names}
    return Scene(**rows, shN=np.concatenate(rich), antialias=sets[-1].antialias)


def usd(shoot: Shoot, out: Path, parts: Parts, progress: Callable[[int], None]) -> bool:
    """The scene and the people with a sample a picture, y up, floor at 0; whether it was made."""
    ground = shoot.setting.ground

    def poses(actor: Actor, before: int) -> Iterator[Scene]:
        for number in range(shoot.count):
            with torch.no_grad():
                posed = factored(actor.splats(number))
            yield turned(posed, ground.turn.T, ground.point)
            progress((before * shoot.count + number + 1) // len(shoot.cast))

    def make(part: Path) -> None:
        scene = shoot.setting.scene
        here = {} if scene is None else {"scene": turned(scene, ground.turn.T, ground.point)}
        write_usd(part, here, {actor.name: poses(actor, i) for i, actor in enumerate(shoot.cast)}, shoot.fps)

    return parts.bring(out, make, shoot.made_of(range(shoot.count)), shoot.fps, shoot.names)


def glb(shoot: Shoot, out: Path, parts: Parts) -> bool:
    """Skinned people with their motions, and the scene's Gaussians, y up, floor at 0; whether it was made."""
    ground, scene = shoot.setting.ground, shoot.setting.scene

    def make(part: Path) -> None:
        figures = []
        for actor in shoot.cast:
            figures.append((actor.name, actor.rig, mesh_of(actor), take(shoot, actor), stand(shoot, actor)))
        write_film_glb(part, figures, None if scene is None else turned(scene, ground.turn.T, ground.point))

    return parts.bring(out, make, shoot.made_of(range(shoot.count)), shoot.fps, shoot.names)


def in_gain(splats: S, gain: tuple[float, float, float]) -> S:
    """A rig or an avatar in the colours of the film."""
    as_learned = torch.as_tensor(np.concatenate([splats.sh0[:, None], splats.shN], 1))
    sh = with_gain(as_learned, torch.tensor(gain)).numpy()
    return replace(splats, sh0=sh[:, 0], shN=sh[:, 1:])


def mesh_of(actor: Actor) -> Mesh:
    """An actor's surface in the colours of the film; StageError where their Gaussians form none."""
    try:
        return surface_of(in_gain(actor.record, actor.gain), *MESH)
    except NoSurfaceError as error:
        raise StageError(f"the Gaussians of {actor.name} make no mesh", "leave the .glb out", [str(error)]) from error


def stand(shoot: Shoot, actor: Actor) -> Stand:
    """Where an actor's motion begins, seen from the film's floor."""
    ground = shoot.setting.ground
    place = (actor.place - ground.point) @ ground.turn
    return place.tolist(), Rotation.from_matrix(ground.turn.T @ actor.turn).as_quat().tolist(), actor.scale


def take(shoot: Shoot, actor: Actor) -> Take:
    """What an actor does in the film, on a floor at height 0."""
    rows, placed = [actor.row(number) for number in range(shoot.count)], actor.placed
    pelvis = placed.transl[rows] + actor.soles.joints[0]
    times, hands = np.arange(shoot.count) / shoot.fps, None if placed.hands is None else placed.hands[rows]
    return hung(actor.baked, take_of("film", times, placed.global_orient[rows], placed.body_pose[rows], pelvis, hands))
