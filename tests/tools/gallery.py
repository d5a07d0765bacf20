"""What comes out, clip by clip: `python -m tests.tools.gallery [NAME=RESULTS ...]` writes docs/gallery/.

Without names it takes what `make table` left: build/table/NAME/CLIP/default. Of each finished run one WebP: above, a frame of the
clip, the avatar from four sides, a motion that the clip has not, the empty scene; below, held-out frames beside what is drawn
for them, the best and the worst of those that `evaluate` shows, by LPIPS of the person.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.formats.images import read_image
from tests.made.command import ROOT
from tests.tools.strip import read_film

PLACE, TABLE = ROOT / "docs" / "gallery", ROOT / "build" / "table"
HEIGHT, WIDTH, GAP, QUALITY = 320, 200, 4, 70  # px of a panel
MOST = 3_000_000  # bytes of all pictures
HEAD = """# Gallery

First row: a frame of the clip, the avatar from four sides, a new motion, the empty scene if there is one.
Second row: two held-out frames, each beside the drawn frame: the best and the worst of those in the report, by LPIPS of the person.
`make gallery` makes these pictures.
"""


def panel(picture: np.ndarray) -> np.ndarray:
    """The middle of a picture uint8 [H,W,3] at the height of a panel, at most as wide as one."""
    height, width = picture.shape[:2]
    columns = min(width, round(WIDTH * height / HEIGHT))
    left = (width - columns) // 2
    cut = np.ascontiguousarray(picture[:, left : left + columns])
    return cv2.resize(cut, (round(columns * HEIGHT / height), HEIGHT), interpolation=cv2.INTER_AREA)


def beside(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Panels of one height in a row, with white between them."""
    gap = np.full((len(panels[0]), GAP, 3), 255, np.uint8)
    return np.concatenate([part for one in panels for part in (one, gap)][:-1], 1)


def sheet(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows below each other, with white between and beside them."""
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, GAP), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)[:-GAP]


def ends(metrics: dict[str, Any], shown: set[str]) -> list[tuple[str, float]]:
    """Best and worst of the frames that are shown, with LPIPS of the person."""
    region = "person_crop" if metrics["heldout"]["person_crop"]["lpips"] is not None else "person_white"
    found = [(row["name"], row[region]["lpips"]) for row in metrics["per_frame"]["heldout"] if row["name"] in shown]
    found = sorted((one for one in found if one[1] is not None), key=lambda one: one[1])
    return [found[0], found[-1]]


def picture(results: Path) -> tuple[np.ndarray, list[tuple[str, float]]]:
    """The sheet of a finished run, and the two held-out frames in it."""
    clip = sorted((results / "frames" / "images").iterdir())
    around, motion, scene = (results / "render" / f"{name}.mp4" for name in ("turntable", "motion", "scene"))
    turns = read_film(around)
    above = [read_image(clip[len(clip) // 2]), *(turns[i * len(turns) // 4] for i in range(4))]
    above += [film[len(film) // 3] for film in (read_film(path) for path in (motion, scene) if path.exists())]
    strips = {path.stem: path for path in (results / "evaluate" / "heldout").glob("*.png")}
    found = ends(json.loads((results / "evaluate" / "metrics.json").read_bytes()), set(strips))
    below = []
    for name, _ in found:
        parts = np.split(read_image(strips[name]), 3, 1)  # the clip, what is drawn, the person alone
        below += [panel(parts[0]), panel(parts[1])]
    return sheet([beside([panel(one) for one in above]), beside(below)]), found


def main(runs: dict[str, Path]) -> None:
    """Write the pictures and the page; SystemExit if they are too large."""
    PLACE.mkdir(exist_ok=True)
    page = [HEAD]
    for name, results in runs.items():
        drawn, ((best, least), (worst, most)) = picture(results)
        if not cv2.imwrite(str(PLACE / f"{name}.webp"), drawn[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
            sys.exit(f"cannot write {PLACE / name}.webp")
        page.append(
            f"**{name}**: frame {best}, LPIPS {least:.3f}; frame {worst}, {most:.3f}\n\n![{name}]({name}.webp)\n"
        )
    (PLACE / "README.md").write_text("\n".join(page))
    size = sum(path.stat().st_size for path in PLACE.glob("*.webp"))
    print(f"{len(runs)} clips, {size / 1e6:.2f} MB in {PLACE}")
    if size > MOST:
        sys.exit(f"at most {MOST / 1e6:g} MB: show fewer clips")


if __name__ == "__main__":
    named = {name: Path(path) for name, _, path in (one.partition("=") for one in sys.argv[1:])}
    found = {path.parents[1].name: path for path in sorted(TABLE.glob("*/*/default")) if (path / "evaluate").exists()}
    main(named or found or sys.exit(f"no finished run in {TABLE}: `make table` first, or NAME=RESULTS"))
