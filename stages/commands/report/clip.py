"""What the stages before training have found: frames, outlines, cameras, the body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from stages.commands.report.results import who_of
from stages.formats import page
from stages.formats.images import evenly, read_image, read_mask

if TYPE_CHECKING:
    from stages.formats.clip import Clip
    from stages.formats.facts import Sfm, Smpl
    from stages.formats.page import Figure
    from stages.records import Ground

SHOWN = 6  # pictures of a kind
DOUBTFUL = 3  # frames, at most, that are shown because their pose is doubtful
SMALL = 360  # px, the longer side of pictures that only show what was taken
BLUE, ORANGE, PAPER = (31, 111, 235), (255, 140, 0), (252, 252, 253)
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
    from stages.formats.clip import load_people
    from stages.formats.facts import Smpl, read_facts
    from stages.formats.ground import read_ground
    from stages.formats.people import folder_of, people_of

    ground, numbers = read_ground(smpl / "ground.json"), people_of(sfm)
    overlays: list[Figure] = []
    for one in load_people(sfm, smpl):
        fit = read_facts(folder_of(smpl, one.person) / "smpl.json", Smpl)
        overlays += _overlays(one, ground, fit, who_of(one.person, numbers))
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
    _draw_edge(image, mask)
    return page.picture(_small(image), f"frame {name}, the mask's edge orange")


def _draw_edge(image: np.ndarray, mask: np.ndarray) -> None:
    edges, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, edges, -1, ORANGE, max(1, image.shape[0] // 400))


def _overlays(clip: Clip, ground: Ground, fit: Smpl, who: str) -> Iterator[Figure]:
    """Over evenly spread frames, and doubtful ones, the posed body in blue and the edge of the mask in orange, and the body from
    the side. `who` begins each caption.
    """
    from stages.avatar.cameras.pinhole import camera_centers
    from stages.avatar.kernels.mesh import covered
    from stages.estimators.bodyfit.posed import posed_bodies
    from stages.estimators.bodyfit.side_view import side_view

    doubtful = [name for name in clip.names if name in fit.doubtful]
    names = sorted({*_spread(clip.names), *_spread(doubtful)[:DOUBTFUL]})
    model, chosen = clip.body_model, [clip.names.index(name) for name in names]
    for i, vertices in zip(chosen, posed_bodies(model, clip.body, chosen), strict=True):
        image = clip.images(i).copy()
        inside = covered(vertices, model.faces, clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
        image[inside] = (0.6 * image[inside] + 0.4 * np.array(BLUE)).astype(np.uint8)
        _draw_edge(image, clip.own_mask(i))
        expected = fit.expected_error_mm.get(clip.names[i])
        off = None if expected is None else np.array(expected.along) / 1000
        eye = camera_centers(clip.viewmats[i : i + 1])[0]
        beside = side_view(vertices, model.faces, model.J_regressor @ vertices, off, eye, ground, clip.height)
        frame = f"{who}frame {clip.names[i]}{', doubtful' * (clip.names[i] in doubtful)}"
        caption = f"{frame}: body blue, mask edge orange; beside it from the side, the camera far to the left"
        yield page.picture(np.concatenate([image, beside], 1), caption)


def _rungs(found: Sfm) -> list[str]:
    """A clause for each way in which sfm tried to map the cameras."""
    clauses = []
    for rung in found.rungs:
        best = max((model.registered for model in rung.models), default=0)
        clauses.append(f"{rung.how} {best} of {found.of} frames in the largest of {len(rung.models)} models")
    return clauses
