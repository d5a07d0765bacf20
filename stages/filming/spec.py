"""What can be asked of a film: the keys of film.yaml, as `hugs compose` checks them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from stages import contract

DAY = 86400.0  # s
Far = Annotated[float, Field(ge=-1e5, le=1e5)]  # m; single precision is 8 mm there
Axis = tuple[Far, Far, Far]
Axes = Literal["y_down", "y_up"]
Matching = Literal["off", "auto", "always"]
Moment = Annotated[float, Field(ge=0, le=DAY)]
Times = Annotated[float, Field(ge=0.01, le=100)]
Side = Annotated[int, Field(gt=0, le=16384)]  # px; H.264 has no larger pictures


class Person(contract.Params):
    avatar: Path
    """The folder of a run, such as work/dance/default, or an exported avatar.npz or avatar_splats.glb."""
    who: int = Field(1, ge=1, le=1000)
    """Which of them, where the run has several people."""
    motion: str = "clip"
    """A .bvh or .npz file; clip: as they moved in their own clip; or made by formula: wave, squats, jumping_jacks,
    walk_in_place; for people with fingers and a face count_to_five, say_a_sentence."""
    face: Path | None = None
    """A .csv of a face capture: a time and the 52 shapes."""
    at: tuple[Far, Far] | None = None
    """Where their motion begins, m on the floor from where the scene's own person stood: to the left, ahead. If not said, the
    scene's own people are where they were, and others at the nearest place that is free, which is told."""
    turn: float = 0.0
    """Degrees to the left, seen from above."""
    start: float = Field(0.0, ge=-DAY, le=DAY)
    """Second of the film at which their motion begins; less than 0: it is under way when the film begins."""
    speed: Times = 1.0
    """Times as fast as it was."""
    loop: bool = False
    """Begin again at the end; else they stand still before and after."""
    scale: Times = 1.0
    """Times as large as they are."""
    colour: Matching | None = None
    """As the film's `colour`, for this person alone."""
    motion_fps: float | None = Field(None, ge=0.1, le=10_000)
    """Frames a second of the motion file, in place of what it says."""
    up: Literal["y", "-y", "z", "-z"] | None = None
    """The axis that points up in the motion file, in place of the direction in which its pelvis points."""


class Floor(contract.Params):
    point: Axis
    """A point of the floor, m, from which `at` counts."""
    up: Axis = (0.0, -1.0, 0.0)
    """Its normal."""
    ahead: Axis = (0.0, 0.0, -1.0)
    """The way that people look who are not turned."""


class Stills(contract.Params):
    folder: Path
    at: list[Moment] = Field(min_length=1)
    """Seconds of the film."""


class Out(contract.Params):
    film: Path | None = None
    """The film, .mp4."""
    alpha: Path | None = None
    """The people alone, with alpha: .mov (ProRes 4444)."""
    stills: Stills | None = None
    """Pictures, .png."""
    page: Path | None = None
    """The page on which all of them move, .html."""
    splats: Path | None = None
    """Scene and people at `moment` as one set of Gaussians, .ply or .spz."""
    glb: Path | None = None
    """People as textured meshes with their motions, and the scene's Gaussians, .glb."""
    usd: Path | None = None
    """The scene, and the people with a sample a picture, .usdc."""


class Film(contract.Params):
    scene: Path | None = None
    """The folder of a run, or a .ply, .spz or .npz of Gaussians; none: over white."""
    gaussians: Path | None = None
    """A file in place of the Gaussians that the run of `scene` trained, in its axes: a scene that was edited."""
    scene_axes: Axes = "y_down"
    """Of a scene, or Gaussians, from a file: y_down, as trainers write them, or y_up: turned by half a turn about x."""
    ground: Floor | None = None
    """The floor of a scene that is a file."""
    people: list[Person] = Field(min_length=1)
    camera: str = "clip"
    """clip: the path of the scene's clip, to and fro. still: the camera of its middle frame. orbit: around the people.
    follow: still, but turning after them. before: one that sees all that they do. auto: still, at the frame that shows people
    best, wider if they need it; where all see backs, before. Or an .npz of cameras, one or one a picture."""
    light: Literal["auto", "above", "off"] = "auto"
    """Shadows and the light on people. auto: as the scene's run has learned or seen them, else shadows from above in even light;
    above: that; off: no shadows, even light."""
    colour: Matching = "off"
    """Match people to the scene's exposure and tint. auto: where the clips differ by more than rooms do, and tell their light."""
    fps: float = Field(30.0, ge=0.1, le=240)
    """Pictures a second."""
    seconds: float | None = Field(None, gt=0, le=DAY)
    """Length of the film; as long as the longest motion if not said."""
    size: tuple[Side, Side] | None = None
    """Width and height, px; those of the scene's clip, or 640x360, if not said."""
    moment: Moment = 0.0
    """Second of the film that `splats` shows."""
    only: Literal["human", "both"] = "both"
    """human: over white; both: in the scene."""
    out: Out = Out()
