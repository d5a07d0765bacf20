"""A film as a page: all its people, each with the film's motion and the made ones, and its camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.avatar.drawing.rig import weights_of
from stages.avatar.motion.gestures import fist
from stages.avatar.motion.moves import made_moves
from stages.contract import version
from stages.filming.cast import Actor
from stages.filming.outputs import in_gain
from stages.filming.parts import Parts
from stages.filming.shoot import Shoot
from stages.formats import viewer
from stages.gestures import Move
from stages.records import Cameras, Effects


def page(shoot: Shoot, out: Path, parts: Parts) -> tuple[bool, list[str]]:
    """Write the page; whether it was made, and what it lacks, in sentences."""
    lacks: list[str] = []

    def make(part: Path) -> None:
        lacks.extend(viewer.write_viewer(part, exhibit(shoot, out.stem)))

    return parts.bring(out, make, shoot.made_of(range(shoot.count)), shoot.fps, out.stem, shoot.names), lacks


def exhibit(shoot: Shoot, title: str) -> viewer.Exhibit:
    """What the page shows."""
    scene, ground, first = shoot.setting.scene, shoot.setting.ground, shoot.cameras[0]
    names = tuple(f"{number:05d}" for number in range(shoot.count))
    views = np.stack([camera.viewmat.double().numpy() for camera in shoot.cameras])
    Ks = np.stack([camera.K.double().numpy() for camera in shoot.cameras])
    around = "none" if scene is None else f"{len(scene):,} Gaussians"
    people = ", ".join(f"{actor.name} ({len(actor.rig):,} Gaussians)" for actor in shoot.cast)
    length = f"{shoot.count} pictures, {shoot.count / shoot.fps:.1f} s"
    made_by = f"hugs {version()}"
    return viewer.Exhibit(
        title=title,
        subtitle=f"{len(shoot.cast)} {'person' if len(shoot.cast) == 1 else 'people'}, {shoot.count / shoot.fps:.1f} s",
        facts=[("Film", length), ("People", people), ("Scene", around), ("Made by", made_by)],
        figures=[figure(shoot, actor) for actor in shoot.cast],
        scene=scene,
        effects=lamp(shoot),
        cameras=Cameras(names, views, Ks, first.width, first.height),
        images=None,
        turn=ground.turn,
        spot=ground.point,
        made_by=made_by,
    )


def figure(shoot: Shoot, actor: Actor) -> viewer.Figure:
    """A person as the page has them."""
    rows = [actor.row(number) for number in range(shoot.count)]
    rotvecs = np.concatenate([actor.global_orient[rows], actor.body_pose[rows]], 1)
    hands, face = (None if part is None else part[rows] for part in (actor.placed.hands, actor.placed.face))
    gestured = any(one.record.fingers is not None for one in shoot.cast)
    own = replace(shoot.setting.ground, point=actor.place, up=actor.turn[:, 1], ahead=actor.turn[:, 2])
    return viewer.Figure(
        rig=in_gain(actor.rig, actor.gain),
        weights=weights_of(actor.record),
        moves=[
            Move("The film", shoot.fps, rotvecs, actor.transl[rows], hands, face),
            *made_moves(own, actor.soles, gestured),
        ],
        turn=actor.turn,
        spot=actor.place,
        soles=actor.soles.at_rest(),
        parts=actor.record.casters,
        fist=fist(),
        face=actor.record.face,
        scale=actor.scale,
    )


def lamp(shoot: Shoot) -> Effects:
    """The film's lamp, and its light on people, as the page takes them."""
    shadow, shading = shoot.setting.shadow, shoot.setting.shading
    bands = None if shading is None else shading.bands.detach().cpu().numpy()
    if shadow is None or shoot.setting.scene is None:
        return Effects(shading=bands)
    return Effects(**shadow.known(), shading=bands)
