"""Cameras of other pictures that have the size of the frames: what the frames say of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import camera_centers, pinhole, project
from stages.contract import Job, StageError
from stages.estimators.cameras import check
from stages.estimators.cameras.colmap import Cloud
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import Pinholes
from stages.formats.images import write_image, write_mask
from tests.made.matches import FOCAL, FRAMES, HEIGHT, WIDTH, clip
from tests.made.said import holds

SIZE = (WIDTH, HEIGHT)
SPOT = 5  # px: radius of a point in the drawn frames


def affine(across: float, down: float, shift: tuple[float, float] = (0, 0)) -> np.ndarray:
    """What brings pixels of the frames to those of a picture changed about its middle, [2,3]."""
    scale = np.array([across, down])
    return np.column_stack([np.diag(scale), (1 - scale) * SIZE / 2 + np.array(shift) * SIZE])


CHANGES: dict[str, tuple[np.ndarray, int]] = {
    "as given": (affine(1, 1), 0),
    "mirrored": (affine(-1, 1), 0),
    "upside down": (affine(-1, -1), 0),
    "mirrored and upside down": (affine(1, -1), 0),
    "cut to 0.8": (affine(1.25, 1.25), 0),
    "cut to 0.9": (affine(1 / 0.9, 1 / 0.9), 0),
    "cut to 0.8 aside": (affine(1.25, 1.25, (0.1, 0.1)), 0),
    "cut to 0.6": (affine(1 / 0.6, 1 / 0.6), 0),
    "of more": (affine(0.8, 0.8), 0),
    "moved": (affine(1, 1, (0.05, 0.05)), 0),
    "1 frame later": (affine(1, 1), 1),
    "2 frames earlier": (affine(1, 1), -2),
    "9 frames later": (affine(1, 1), 9),
}
"""What happened to the pictures after their cameras were found -> in pixels, and which frame stands for the i-th: i + k."""
NAMED = {
    "mirrored": "mirrored",
    "upside down": "upside down",
    "cut to 0.8": "frames were enlarged",
    "cut to 0.9": "frames were enlarged",
    "of more": "their pictures were enlarged",
    "1 frame later": "frame 1 before",
    "2 frames earlier": "frame 2 after",
}
"""How the warning says it, where it can."""
UNSEEN = ("moved",)
"""What matches alone do not show; docs/inputs.md says so."""


@pytest.fixture(scope="module")
def made() -> tuple[list[Pair], np.ndarray]:
    """Matches, and the true cameras, of a walk."""
    return clip(turn=8, travel=1.2, noise=0.1)


def pinholes(views: np.ndarray) -> Pinholes:
    """True cameras, as from a file."""
    names = [f"{i:06d}" for i in range(FRAMES)]
    return Pinholes("moving", names, views, np.tile(pinhole(FOCAL, *SIZE), (FRAMES, 1, 1)), lambda _: None, {})


def changed(pairs: list[Pair], change: str) -> list[Pair]:
    """The matches of the changed pictures."""
    to, later = CHANGES[change]
    moved = [replace(pair, a=pair.a @ to[:, :2].T + to[:, 2], b=pair.b @ to[:, :2].T + to[:, 2]) for pair in pairs]
    kept = [(pair, pair.first - later, pair.second - later) for pair in moved]
    return [replace(pair, first=i, second=j) for pair, i, j in kept if min(i, j) >= 0 and max(i, j) < FRAMES]


@pytest.fixture
def triangulated(monkeypatch, tmp_path, made) -> Callable[..., list[str]]:
    """Given cameras without points, before these matches; what is said."""
    monkeypatch.setattr(check, "write_ignored", lambda *_: None)
    for name in ("extract", "match"):
        monkeypatch.setattr(check.colmap_features, name, lambda *_, **__: None)
    monkeypatch.setattr(check.colmap, "triangulate", lambda *_: None)

    def run(pairs: list[Pair], views: np.ndarray = made[1]) -> list[str]:
        monkeypatch.setattr(check.colmap_features, "read_pairs", lambda *_: (pairs, None))
        said: list[str] = []
        job = Job(tmp_path, emit=lambda event: said.append(event["text"]) if event["event"] == "warning" else None)
        check.triangulate(job, pinholes(views), SIZE, 512, tmp_path)
        return said

    return run


@pytest.mark.parametrize("change", [change for change in CHANGES if change not in UNSEEN])
def test_matches_of_other_pictures_of_the_same_size_are_said(made, triangulated, change):
    pairs = changed(made[0], change)
    try:
        said = triangulated(pairs)
    except StageError as error:
        said = error.facts
    assert bool(said) == (change != "as given")
    assert change not in NAMED or holds(" ".join(said), NAMED[change])


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize(
    "walk", [{"turn": 0, "travel": 1}, {"turn": 10, "travel": 0.05}, {"turn": 3, "travel": 1, "flat": True}]
)
def test_true_cameras_are_never_said_to_be_others(triangulated, walk, noise):
    pairs, views = clip(**walk, noise=noise, outliers=0.1)
    assert not [text for text in triangulated(pairs, views) if "if " in text]


def test_rough_cameras_are_said_to_be_rough_and_are_taken(made, triangulated):
    turned = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 3 / FOCAL, (FRAMES, 3))).as_matrix()
    views = made[1].copy()
    views[:, :3] = turned @ views[:, :3]
    (said,) = triangulated(made[0], views)
    assert holds(said, "px", "rough") and "if " not in said


def test_cameras_of_another_clip_of_the_same_size_are_said(made, triangulated):
    _, other = clip(turn=20, travel=2, forward=True)
    try:
        assert triangulated(made[0], other)
    except StageError as error:
        assert holds(error.facts[0], "px", "limit")


@pytest.fixture(scope="module")
def drawn(made) -> tuple[Cloud, np.ndarray]:
    """Points with colours, and frames in which each is a spot, [F,H,W,3]."""
    rng, views = np.random.default_rng(1), made[1]
    xyz, grey = rng.uniform([-3, -2, 4], [3, 2, 7], (160, 3)), rng.integers(40, 256, 160)
    frames = np.full((FRAMES, HEIGHT, WIDTH, 3), 20, np.uint8)
    tracks: list[list[int]] = [[] for _ in xyz]
    for i, view in enumerate(views):
        pixels, z = project(xyz, view, pinhole(FOCAL, *SIZE))
        for k in np.argsort(-z):
            cv2.circle(frames[i], tuple(np.rint(pixels[k] - 0.5).astype(int)), SPOT, [int(grey[k])] * 3, -1)
        x, y = np.rint(pixels - 0.5).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < WIDTH) & (y < HEIGHT)
        for k in np.flatnonzero(inside)[frames[i, y[inside], x[inside], 0] == grey[inside]]:
            tracks[k].append(i)
    rgb, zeros = np.repeat(grey[:, None], 3, 1).astype(np.uint8), np.zeros(len(xyz))
    rows = tuple(np.array(track, np.int64) for track in tracks)
    return Cloud(np.arange(len(xyz)), xyz, rgb, zeros, zeros, zeros, rows), frames


@pytest.fixture
def coloured(monkeypatch, made, drawn) -> Callable[..., list[str]]:
    """Given cameras with points, before the changed frames; the warnings."""

    def run(change: str, views: np.ndarray = made[1]) -> list[str]:
        to, later = CHANGES[change]
        to = np.column_stack([to[:, :2], to @ [0.5, 0.5, 1] - 0.5])  # OpenCV counts from the first pixel's centre

        def picture(path: Path) -> np.ndarray:
            picture = drawn[1][(int(path.stem) + later) % FRAMES]
            return cv2.warpAffine(picture, to, SIZE, borderMode=cv2.BORDER_REFLECT)

        monkeypatch.setattr(check, "read_image", picture)
        said: list[str] = []
        job = Job(Path(), emit=lambda event: said.append(event["text"]) if event["event"] == "warning" else None)
        check.compare_colors(job, pinholes(views), drawn[0], SIZE)
        return said

    return run


@pytest.mark.parametrize("change", CHANGES)
def test_points_of_other_pictures_of_the_same_size_are_said(coloured, change):
    said = coloured(change)
    assert len(said) == (change != "as given")
    assert change not in NAMED or holds(said[0], NAMED[change])


def test_points_of_another_clip_of_the_same_size_are_said(made, coloured):
    centers = camera_centers(made[1])
    assert np.ptp(centers, axis=0).max() > 1
    _, other = clip(turn=20, travel=2, forward=True)
    (said,) = coloured("as given", other)
    assert holds(said, "another", "clip")


@pytest.mark.parametrize("film", ["stands", "walks", "tells nothing"])
def test_cameras_that_stand_before_a_film_that_walks_are_said(tmp_path, made, drawn, film):
    """And cameras that turn before one that stands; the others are not, nor any before a wall that shows no corner twice."""
    rng = np.random.default_rng(2)
    few = replace(pinholes(made[1]), names=[f"{i:06d}" for i in range(0, FRAMES, 4)])
    for kind in ("images", "masks"):
        (tmp_path / kind).mkdir()
    for name in few.names:
        shown = drawn[1][int(name) if film == "walks" else 0]
        noise = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
        write_image(tmp_path / "images" / f"{name}.png", noise if film == "tells nothing" else shown)
        write_mask(tmp_path / "masks" / f"{name}.png", np.zeros(SIZE[::-1], np.uint8))
    said: list[str] = []
    job = Job(tmp_path, emit=lambda event: said.append(event["text"]))
    for verdict in ("static camera", "rotation only"):
        (tmp_path / verdict).mkdir()
        check.compare_stillness(job, replace(few, verdict=verdict), SIZE, tmp_path / verdict)
    wanted = {"walks": ("stand", "moves"), "stands": ("turn", "stands")}
    assert len(said) == (film in wanted) and all(holds(line, *wanted[film]) for line in said)
