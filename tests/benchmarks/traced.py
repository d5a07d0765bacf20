"""What `hugs run` makes of path-traced clips, compared with their truth.

    python -m tests.benchmarks.traced WORK [--seed 11] [--only skirt coat plain] [--json out.json]

Needs `pip install mitsuba`. Somebody in a skirt and with a ponytail, in a long coat and with a bag, or in nothing loose, in a
yard in the sun: 60 frames of 360x640 that are lit as the world is. Hair, shirt and soles stand off the body model, a lens
bends, exposure and white balance drift, four frames are blurred. The video alone goes in, through pipeline `default`; what is
printed is that of `tests.benchmarks.whole`. Each seed is another person in another yard, so that a seed nobody has tried is a
clip that nobody has seen. To make a clip takes a quarter of an hour of two cores.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from tests.benchmarks.whole import WEARS, rate_each
from tests.made.traced import make

CLIPS: dict[str, tuple[str, ...]] = WEARS | {"plain": ()}


def made(folder: Path, name: str, seed: int) -> Path:
    """The folder of a clip and its truth; made once."""
    if not (folder / "clip.mp4").exists():
        make(folder, seed, CLIPS[name])
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--only", nargs="+", choices=CLIPS, default=list(CLIPS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rate_each({name: partial(made, args.work / f"{name}{args.seed}", name, args.seed) for name in args.only}, args.json)


if __name__ == "__main__":
    main()
