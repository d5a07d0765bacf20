"""The page of a trained clip: its people and their scene, in their own and in made motions, from the clip's cameras."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from stages.avatar.motion.moves import clip_move, made_moves
from stages.avatar.motion.placing import Soles
from stages.filming.clip_cast import floor_under, with_casters
from stages.formats import viewer
from stages.formats.clip import load_people
from stages.formats.effects import read_effects
from stages.formats.facts import Listing, read_facts
from stages.records import Avatar, Ground, Rig, Scene


def write_clip_page(
    path: Path,
    frames: Path,
    sfm: Path,
    smpl: Path,
    train: Path,
    cast: Sequence[tuple[Avatar, Rig, Soles]],
    scene: Scene | None,
    ground: Ground,
) -> list[str]:
    """Write the page of a clip whose stages left these folders, and say what it does not hold, in words."""
    people, listing = load_people(sfm, smpl, train), read_facts(frames / "frames.json", Listing)
    clip, gaussians = people[0], sum(len(rig) for _, rig, _ in cast)
    title, made_by = Path(listing.video.path).name, f"hugs {version('hugs-avatar')}"
    around = "none" if scene is None else f"{len(scene):,} Gaussians"
    facts = {
        "Clip": f"{title}: {len(clip.names)} frames of {clip.width}x{clip.height} px",
        ("Person" if len(cast) == 1 else f"{len(cast)} people"): f"{gaussians:,} Gaussians",
        "Scene": around,
        "Result": train.resolve().name,
        "Made by": made_by,
    }
    effects = read_effects(train / "effects.npz")
    times, figures = np.array(listing.times(clip.names)), []
    for one, (avatar, rig, soles) in zip(people, cast, strict=True):
        floor = floor_under(one, rig, ground)
        parts = None if effects.light is None else with_casters(avatar, one.body_model).casters
        moves, sole = [clip_move(one.body, times), *made_moves(floor, soles)], soles.at_rest()
        stand, absent = (ground.turn, floor.point), np.flatnonzero(one.body.confidence <= 0).tolist()
        figures.append(viewer.Figure(rig, avatar.lbs_weights, moves, *stand, sole, parts, absent=absent))
    shown = viewer.Exhibit(
        title=title,
        subtitle=f"{gaussians:,} Gaussians in the {'person' if len(cast) == 1 else 'people'}"
        + ("" if scene is None else f", {len(scene):,} in the scene"),
        facts=list(facts.items()),
        figures=figures,
        scene=scene,
        effects=effects,
        cameras=clip.world_cameras,
        images=clip.images,
        turn=ground.turn,
        spot=ground.point,
        made_by=made_by,
    )
    return viewer.write_viewer(path, shown)
