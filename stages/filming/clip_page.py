"""A clip as a page: its people, each with their own motion and the made ones, and its scene and cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.avatar.drawing.rig import weights_of
from stages.avatar.motion.gestures import fist
from stages.avatar.motion.moves import clip_move, made_moves
from stages.avatar.motion.placing import Soles
from stages.contract import version
from stages.filming.clip_cast import floor_under
from stages.formats import viewer
from stages.formats.clip import Clip, load_people
from stages.formats.effects import read_effects
from stages.formats.facts import Listing, Smpl, read_facts
from stages.records import Avatar, Ground, Rig, Scene


def clip_page(
    frames: Path,
    sfm: Path,
    smpl: Path,
    train: Path,
    cast: list[tuple[Avatar, Rig, Soles]],
    scene: Scene | None,
    ground: Ground,
) -> viewer.Exhibit:
    """What the page of a clip shows; `cast` are its people in their order."""
    people, listing = load_people(sfm, smpl, train), read_facts(frames / "frames.json", Listing)
    clip, gaussians = people[0], sum(len(rig) for _, rig, _ in cast)
    metre = read_facts(smpl / "smpl.json", Smpl).metre
    title, made_by = Path(listing.video.path).name, f"hugs {version()}"
    facts = {
        "Clip": f"{title}: {len(clip.names)} frames of {clip.width}x{clip.height} px",
        ("Person" if len(cast) == 1 else f"{len(cast)} people"): f"{gaussians:,} Gaussians",
        "Scene": "none" if scene is None else f"{len(scene):,} Gaussians",
        "Metre": (f"to ±{100 * metre.error:.0f} %, " if metre.error else "") + (metre.how or "unknown"),
        "Result": train.resolve().name,
        "Made by": made_by,
    }
    effects, times = read_effects(train / "effects.npz"), np.array(listing.times(clip.names))
    lit, gestured = effects.light is not None, any(one.fingers is not None for one, *_ in cast)
    return viewer.Exhibit(
        title=title,
        subtitle=f"{gaussians:,} Gaussians in the {'person' if len(cast) == 1 else 'people'}"
        + ("" if scene is None else f", {len(scene):,} in the scene"),
        facts=list(facts.items()),
        figures=[_figure(one, *parts, ground, times, lit, gestured) for one, parts in zip(people, cast, strict=True)],
        scene=scene,
        effects=effects,
        cameras=clip.world_cameras,
        images=clip.images,
        turn=ground.turn,
        spot=ground.point,
        made_by=made_by,
        times_fit=metre.times_fit,
    )


def _figure(
    clip: Clip, avatar: Avatar, rig: Rig, soles: Soles, ground: Ground, times: np.ndarray, lit: bool, gestured: bool
) -> viewer.Figure:
    """A person as the page has them; `lit`: by a light that casts shadows; `gestured`: someone of the clip has fingers."""
    floor = floor_under(clip, rig, ground)
    return viewer.Figure(
        rig=rig,
        weights=weights_of(avatar),
        moves=[clip_move(clip.body, times), *made_moves(floor, soles, gestured)],
        turn=ground.turn,
        spot=floor.point,
        soles=soles.at_rest(),
        parts=avatar.casters if lit else None,
        fist=fist(),
        face=avatar.face,
        absent=np.flatnonzero(clip.body.confidence <= 0).tolist(),
    )
