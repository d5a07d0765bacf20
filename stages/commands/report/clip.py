"""What the stages before training have found: frames, outlines, cameras, the body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from stages.commands.report.results import who_of
from stages.estimators.bodyfit.overlay import BLUE, SHOWN, draw_edge
from stages.formats import page
from stages.formats.images import evenly, read_image, read_mask

if TYPE_CHECKING:
    from stages.formats.facts import Sfm
    from stages.formats.page import Figure

SMALL = 360  # px, the longer side of pictures that only show what was taken
PAPER = (252, 252, 253)
MAP = 560  # px, the longer side of the map of cameras
FAR = 98  # percent of the points are inside the map


def frames(frames: Path) -> dict[str, Any]:
    """The clip's size, and frames spread evenly over it."""
    from stages.formats.facts import Listing, read_facts

    listing = read_facts(frames / "frames.json", Listing)
    names = _spread([frame.name for frame in listing.frames])
    sheet = [page.picture(_small(read_image(frames / "images" / f"{name}.png")), f"frame {name}") for name in names]
    size = (len(listing.frames), listing.width, listing.height)
    return {"size": size, "sheet": sheet}


def outlines(frames: Path, masks: Path) -> dict[str, Any]:
    """The edge of the mask over frames."""
    names = _spread(sorted(path.stem for path in (masks / "masks").glob("*.png")))
    return {"outlines": [_outlined(frames / "images", masks / "masks", name) for name in names], "sheet": None}


def cameras(sfm: Path) -> dict[str, Any]:
    """The path of the camera and the points of the scene from above, and how cameras were mapped."""
    from stages.formats.cameras import read_cameras
    from stages.formats.facts import Sfm, read_facts
    from stages.formats.points import read_points

    path, facts = read_cameras(sfm / "cameras.npz"), read_facts(sfm / "sfm.json", Sfm)
    points, colors = read_points(sfm / "points.ply")
    caption = f"{len(points):,} points of the scene from above, the camera's path blue, its start a ring"
    map_ = page.picture(seen_from_above(path.viewmats, points, colors), caption) if len(points) else None
    return {"map": map_, "rungs": _rungs(facts), "mapper": facts.mapper or "none of them"}


def body(sfm: Path, smpl: Path) -> dict[str, Any]:
    """The fitted body over frames, and from the side; of each person."""
    from stages.formats.facts import Smpl, read_facts
    from stages.formats.people import folder_of, people_of

    people, overlays = people_of(sfm), []
    for person in people:
        folder, who = folder_of(smpl, person), who_of(person, people)
        doubtful = read_facts(folder / "smpl.json", Smpl).doubtful
        for path in sorted((folder / "overlays").glob("*.png")):
            frame = f"{who}frame {path.stem}{', doubtful' * (path.stem in doubtful)}"
            caption = f"{frame}: body blue, mask edge orange; beside it from the side, the camera far to the left"
            overlays.append(page.picture(read_image(path), caption))
    return {"overlays": overlays, "outlines": None}


def seen_from_above(viewmats: np.ndarray, points: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Cameras [C,4,4] and points [P,3] with colours [P,3] uint8, in one world, as a map: uint8 [H,W,3].

    Up is the mean of the cameras' up; the first camera looks to the right. The map ends where FAR percent of the points lie.
    """
    turns, centers = viewmats[:, :3, :3], -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    up = -turns[:, 1].mean(0)
    up /= max(np.linalg.norm(up), 1e-9)
    right = turns[0, 0] - up * (turns[0, 0] @ up)
    right /= max(np.linalg.norm(right), 1e-9)
    axes = np.stack([np.cross(up, right), right])  # the way ahead is to the right on the map
    flat, path = points @ axes.T, centers @ axes.T
    low, high = np.percentile(flat, [100 - FAR, FAR], axis=0)
    low, high = np.minimum(low, path.min(0)), np.maximum(high, path.max(0))
    scale = (MAP - 40) / max(float((high - low).max()), 1e-9)

    def at(places: np.ndarray) -> np.ndarray:
        return np.round((places - low) * scale + 20).astype(int)

    wide, tall = (at(high) + 20).tolist()
    picture = np.full((tall, wide, 3), PAPER, np.uint8)
    inside = ((flat >= low) & (flat <= high)).all(1)
    for (x, y), color in zip(at(flat[inside]).tolist(), colors[inside].tolist(), strict=True):
        cv2.circle(picture, (x, y), 2, color, -1, cv2.LINE_AA)
    cv2.polylines(picture, [at(path).reshape(-1, 1, 2).astype(np.int32)], False, BLUE, 2, cv2.LINE_AA)
    cv2.circle(picture, tuple(at(path[0]).tolist()), 6, BLUE, 2, cv2.LINE_AA)
    return picture


def _spread(names: Sequence[str]) -> list[str]:
    return [names[i] for i in evenly(len(names), SHOWN)]


def _small(image: np.ndarray) -> np.ndarray:
    scale = min(1.0, SMALL / max(image.shape[:2]))
    size = tuple(max(1, round(n * scale)) for n in image.shape[1::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _outlined(images: Path, masks: Path, name: str) -> Figure:
    image, mask = read_image(images / f"{name}.png"), read_mask(masks / f"{name}.png")
    draw_edge(image, mask)
    return page.picture(_small(image), f"frame {name}, the mask's edge orange")


def _rungs(found: Sfm) -> list[str]:
    """A clause for each way in which sfm tried to map the cameras."""
    clauses = []
    for rung in found.rungs:
        best = max((model.registered for model in rung.models), default=0)
        clauses.append(f"{rung.how} {best} of {found.of} frames in the largest of {len(rung.models)} models")
    return clauses
