"""The family of synthetic clips that the body fit is measured on: one line of a table each.

Half of them are for `setting` constants, half are `asked` once per change of code. In either half every kind of motion,
and in both the same spread of cameras and people.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FPS, FRAMES = 10.0, 32
LONG, SHORT = 512, 384
"""Sides of the pictures, px."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
CRATE: Box = ((0.1, 0.4, 1.0), (0.3, 0.4, 0.15))
TRUNK: Box = ((0.2, 0.35, -0.9), (0.25, 0.35, 0.15))
CHAIR: Box = ((0.0, 0.21, -0.32), (0.24, 0.21, 0.2))


@dataclass(frozen=True)
class Shot:
    """One clip. Lengths in m, angles in degrees; the camera stands along +z from the person and the floor is y = 0."""

    name: str
    half: Literal["setting", "asked"]
    motion: str
    """A row of `motions.MOTIONS`, a formula of avatar/motion/formulas.py, or a file of the folder of captured motions."""
    height: float
    """Of the camera, and `aim`, the height at which it looks, give its pitch."""
    distance: float
    aim: float
    lens: float
    """Focal length in mm of a picture whose long side is 36 mm."""
    path: Literal["arc", "sideways", "forward", "jitter", "little", "still"]
    reach: float = 0.0
    """How far the path goes: degrees around the person, or m."""
    wide: bool = False
    roll: float = 0.0
    facing: float = 0.0
    """Where the person looks at the first frame, degrees to the left of the camera (of the walk's own way, for walks)."""
    stature: float = 1.72
    heavy: float = 0.0
    """From -2, thin, to 2."""
    child: bool = False
    """Made smaller as a whole, with a larger head, instead of by the body's shapes."""
    follow: float = 0.0
    """Share of the person's own way that the camera goes along with, and always looks along."""
    clothing: float = 0.0
    wears: tuple[str, ...] = ()
    """Garments that swing, rows of `tests.made.synthetic.wardrobe.MAKERS`."""
    sole: float = 0.0
    """m of the soles of shoes; 0: bare feet."""
    boxes: tuple[Box, ...] = ()
    """Middle and half sizes, where the person looks along +z."""
    start: float = 0.0
    """Where in a captured motion the clip begins, s."""
    slope: float = 0.0
    """Of the floor, which rises ahead of somebody who looks along +z by plan, degrees."""
    ride: float = 0.0
    """m/s at which a board carries the person along +x, over the same floor."""
    fps: float = FPS
    frames: int = FRAMES
    plain: bool = False
    """Shirt and trousers of one colour each, the same before and behind."""


FAMILY = (
    Shot("turn_level", "setting", "turn", 1.35, 2.2, 0.9, 26, "arc", 55, stature=1.74),
    Shot("away_tele", "setting", "walk_away", 1.6, 7.6, 0.9, 85, "jitter", stature=1.90, heavy=1, roll=2),
    Shot("toward_loose", "setting", "walk_toward", 1.5, 4.6, 0.9, 45, "sideways", 0.8, clothing=0.05, stature=1.62,
         heavy=-1, follow=0.3),
    Shot("across_hidden", "setting", "walk_across", 1.7, 3.6, 0.85, 32, "arc", 35, wide=True, roll=-4,
         boxes=(CRATE,)),
    Shot("squat_child", "setting", "squat", 1.5, 2.1, 0.5, 35, "forward", 0.6, child=True, stature=1.18, facing=25),
    Shot("bend_high", "setting", "bend", 2.5, 2.7, 0.75, 28, "arc", 50, stature=1.80, heavy=2, facing=-40),
    Shot("sit_turned", "setting", "sit", 1.2, 2.5, 0.7, 28, "arc", 45, facing=50, stature=1.70, heavy=1.5,
         boxes=(CHAIR,)),
    Shot("kneel_cut", "setting", "kneel", 1.5, 2.0, 1.45, 28, "sideways", 0.7, facing=-30, stature=1.78, roll=5),
    Shot("reach_low", "setting", "reach", 0.4, 2.3, 0.95, 24, "sideways", 1.2, facing=15, stature=1.66, heavy=-2),
    Shot("jacks_still", "setting", "jumping_jacks.bvh", 1.5, 4.0, 1.0, 35, "still", wide=True, facing=20,
         stature=2.05),
    Shot("lie_high", "setting", "lie", 2.2, 2.9, 0.35, 32, "arc", 50, wide=True, facing=70, roll=-6, stature=1.72),
    Shot("dance_rolled", "setting", "aist_dance.npz", 1.0, 3.6, 0.9, 35, "arc", 40, roll=9, stature=1.68, heavy=-1.5,
         start=1.0),
    Shot("turn_down", "asked", "turn_back", 2.2, 2.5, 0.85, 26, "arc", -60, stature=1.60, heavy=2),
    Shot("away_behind", "asked", "walk_away", 1.5, 2.6, 0.9, 28, "forward", 0.4, follow=0.7, stature=1.83, heavy=-1),
    Shot("toward_little", "asked", "walk_toward", 1.7, 6.0, 0.9, 50, "little", stature=1.74, heavy=1),
    Shot("across_hidden_low", "asked", "walk_across", 0.8, 3.8, 0.8, 35, "sideways", 1.0, wide=True, stature=1.86,
         facing=180, boxes=(TRUNK,)),
    Shot("squats_low", "asked", "squats", 0.45, 2.7, 0.75, 35, "arc", 40, facing=-60, stature=1.70, heavy=-2),
    Shot("bend_steep", "asked", "bend", 2.6, 2.2, 0.75, 24, "sideways", 1.0, facing=35, stature=1.76),
    Shot("sit_loose", "asked", "sit", 1.5, 2.9, 0.7, 35, "jitter", facing=-20, clothing=0.06, stature=1.64,
         heavy=0.5, boxes=(CHAIR,), roll=-3),
    Shot("kneel_tele", "asked", "kneel", 1.3, 7.6, 0.95, 85, "arc", 30, wide=True, facing=60, stature=1.95,
         heavy=-0.5),
    Shot("reach_cut", "asked", "reach", 1.3, 2.0, 1.4, 28, "arc", 40, facing=-10, stature=1.80, heavy=1),
    Shot("jump_child", "asked", "jump", 0.8, 2.3, 0.7, 35, "jitter", child=True, stature=1.30, facing=30),
    Shot("lie_low", "asked", "lie", 1.1, 2.8, 0.4, 32, "sideways", 1.2, wide=True, facing=-75, stature=1.45,
         heavy=0.5),
    Shot("dance_still", "asked", "jesse_dance.bvh", 2.0, 4.2, 0.9, 35, "still", wide=True, roll=-8, stature=1.78,
         start=0.6),
    Shot("skirt_toward", "setting", "walk_toward", 1.5, 4.2, 0.85, 45, "arc", 40, stature=1.66, sole=0.02,
         wears=("skirt", "ponytail")),
    Shot("coat_turn", "setting", "turn", 1.7, 2.4, 0.9, 26, "arc", -50, stature=1.80, heavy=0.5, sole=0.03,
         wears=("coat",)),
    Shot("bag_squat", "setting", "squat", 1.3, 2.6, 0.75, 30, "sideways", 1.0, facing=40, stature=1.74, sole=0.035,
         wears=("bag",)),
    Shot("shod_reach", "setting", "reach", 0.9, 2.8, 0.9, 28, "arc", 45, facing=-25, stature=1.77, heavy=-1, sole=0.025),
    Shot("skirt_turn", "asked", "turn_back", 1.4, 2.4, 0.85, 26, "sideways", 1.1, stature=1.70, heavy=-0.5, sole=0.015,
         wears=("skirt", "ponytail")),
    Shot("coat_across", "asked", "walk_across", 1.6, 3.8, 0.85, 32, "arc", 40, wide=True, stature=1.84, sole=0.035,
         wears=("coat",)),
    Shot("bag_bend", "asked", "bend", 1.9, 2.7, 0.75, 30, "jitter", facing=-30, stature=1.64, heavy=1, sole=0.025,
         wears=("bag", "ponytail")),
    Shot("shod_away", "asked", "walk_away", 1.0, 4.5, 0.9, 50, "arc", -35, stature=1.73, sole=0.03),
)  # fmt: skip


ODD = (
    Shot("slope_toward", "setting", "reach", 1.4, 2.3, 0.9, 26, "arc", 50, stature=1.74, slope=12),
    Shot("slope_side", "setting", "squat", 1.4, 2.5, 0.8, 28, "arc", 40, facing=90, stature=1.66, heavy=1, slope=12),
    Shot("slope_diag", "setting", "reach", 1.3, 2.5, 0.9, 28, "sideways", 1.0, facing=45, stature=1.70, slope=12),
    Shot("slope_down", "setting", "walk_toward", 1.5, 4.6, 0.9, 45, "sideways", 0.8, stature=1.80, slope=-12),
    Shot("slope_back", "setting", "bend", 1.6, 2.6, 0.8, 28, "arc", 45, facing=180, stature=1.70, slope=12),
    Shot("ride_none", "setting", "reach", 1.4, 3.2, 0.9, 26, "sideways", 0.8, facing=60, stature=1.74),
    Shot("ride_follow", "setting", "reach", 1.4, 3.2, 0.9, 26, "sideways", 0.8, facing=60, stature=1.74, ride=1.5,
         follow=0.9),
    Shot("ride_overtaken", "setting", "reach", 1.4, 3.2, 0.9, 26, "sideways", 0.8, facing=60, stature=1.74, ride=1.5,
         follow=1.5),
    Shot("ride_against", "setting", "reach", 1.4, 3.2, 0.9, 26, "sideways", 0.8, facing=60, stature=1.74, ride=-1.5),
    Shot("ride_pan", "setting", "reach", 1.4, 3.2, 0.9, 26, "sideways", 0.8, facing=60, stature=1.74, ride=1.5),
)  # fmt: skip
"""Clips beside the family, which are only made by name: floors that slope, and somebody who rides over a level one."""

TURNS = (
    Shot("slow_plain", "setting", "turn", 1.4, 2.6, 0.9, 26, "arc", 30, stature=1.74, fps=20, frames=60, plain=True),
    Shot("fast_pattern", "setting", "turn_fast", 1.5, 3.4, 0.9, 32, "still", stature=1.66, fps=30, frames=40),
    Shot("stopping_hair", "setting", "turn_stopping", 1.3, 2.8, 0.9, 28, "sideways", 0.6, stature=1.70, fps=20,
         frames=60, wears=("hair",)),
    Shot("fro_plain", "setting", "turn_fro", 1.5, 4.2, 0.9, 26, "jitter", stature=1.82, fps=60, frames=64, plain=True),
    Shot("fast_hair", "setting", "turn_fast", 1.6, 5.0, 0.9, 26, "arc", 25, stature=1.78, heavy=1, fps=24, frames=40,
         plain=True, wears=("hair",)),
    Shot("fro_pattern", "setting", "turn_fro", 1.2, 2.6, 0.9, 26, "still", facing=40, stature=1.60, fps=25, frames=48),
    Shot("slow_hair", "asked", "turn", 1.6, 3.0, 0.9, 28, "still", facing=90, stature=1.68, fps=30, frames=64,
         plain=True, wears=("hair",)),
    Shot("fast_plain", "asked", "turn_fast", 1.3, 3.6, 0.9, 32, "sideways", 0.8, stature=1.80, fps=60, frames=60,
         plain=True),
    Shot("stopping_plain", "asked", "turn_stopping", 1.7, 4.6, 0.9, 26, "arc", -30, stature=1.62, heavy=-1, fps=24,
         frames=64, plain=True),
    Shot("stopping_pattern", "asked", "turn_stopping", 1.4, 2.7, 0.9, 26, "still", facing=-60, stature=1.76, fps=30,
         frames=64),
    Shot("fro_hair", "asked", "turn_fro", 1.5, 3.2, 0.9, 28, "arc", 30, facing=60, stature=1.70, fps=20, frames=48,
         wears=("hair",)),
    Shot("fast_far", "asked", "turn_fast", 1.6, 6.0, 0.9, 28, "jitter", facing=180, stature=1.86, fps=20, frames=40),
)  # fmt: skip
"""Clips of people who turn on the spot, only made by name: slow, fast, with stops, to and fro."""

KNOWN = FAMILY + ODD + TURNS


def shots(half: str | None = None, names: tuple[str, ...] = ()) -> list[Shot]:
    """The family's clips of that half, or any clips with those names, in the tables' order; ValueError for an unknown name."""
    if unknown := set(names) - {shot.name for shot in KNOWN}:
        raise ValueError(f"no clip {', '.join(sorted(unknown))} in the family")
    known = [shot for shot in KNOWN if shot.name in names] if names else FAMILY
    return [shot for shot in known if half in (None, shot.half)]
