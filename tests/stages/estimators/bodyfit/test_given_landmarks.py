"""Landmarks of a file beside BlazePose's: joined to frames, of the right person, and plain mistakes corrected with a word."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.estimators.bodyfit.given_landmarks import check_landmarks, given_landmarks
from stages.formats.datasets.undistorted import lens_points, opencv_grid
from stages.formats.facts import Frame, Listing, Video
from stages.formats.landmarks import MIRRORED, NAMES
from stages.records import SeenLandmarks
from tests.made import landmark_files as made
from tests.made.said import holds

COUNT, SIZE, FPS = 24, np.array([640, 360]), 12.0
KNOWN = [k for k, name in enumerate(NAMES) if not any(part in name for part in ("inner", "outer", "mouth", "thumb"))]
REST = {
    "nose": (0, -0.62, -0.1), "eye": (0.03, -0.65, -0.08), "ear": (0.07, -0.62, 0), "shoulder": (0.18, -0.45, 0),
    "elbow": (0.3, -0.2, 0.05), "wrist": (0.35, 0.02, -0.1), "pinky": (0.35, 0.1, -0.1), "index": (0.38, 0.1, -0.12),
    "hip": (0.1, 0, 0), "knee": (0.13, 0.45, -0.05), "ankle": (0.13, 0.88, 0), "heel": (0.13, 0.93, 0.04),
    "foot_index": (0.17, 0.95, -0.15),
}  # fmt: skip


@pytest.fixture(scope="module")
def clip():
    """(listing, places [F,33,2] px, 3D [F,33,3] m, BlazePose's tracks with its errors): somebody turns and walks."""
    rest = np.full((33, 3), np.nan)
    for k in KNOWN:
        side, _, part = NAMES[k].partition("_")
        x, y, z = REST[part or side]
        rest[k] = (x if side == "left" else -x, y, z)
    turns = Rotation.from_rotvec(np.linspace(-0.9, 0.9, COUNT)[:, None] * [0, 1, 0]).as_matrix()
    world = rest @ turns.transpose(0, 2, 1)
    xy = 150 * world[..., :2] + np.stack([np.linspace(250, 380, COUNT), 190 + 4 * np.sin(np.arange(COUNT))], 1)[:, None]
    rng = np.random.default_rng(5)
    seen = [
        SeenLandmarks(np.where(np.isfinite(p), p, p[0]) + rng.normal(0, 3, p.shape), np.full(33, 0.9), np.nan_to_num(w))
        for p, w in zip(xy, world, strict=True)
    ]
    frames = tuple(Frame(name=f"{i:06d}", index=i, time_s=i / FPS) for i in range(COUNT))
    video = Video(path="clip.mp4", frames=COUNT, width=640, height=360)
    return Listing(width=640, height=360, video=video, frames=frames), xy, world, seen


def take(clip, path, grid=None, viewmats=None, tracks=None):
    """(places [F,33,2], visibility [F,33], 3D, facts, notes) that come of a file."""
    said = []
    viewmats = np.tile(np.eye(4), (COUNT, 1, 1)) if viewmats is None else viewmats
    merged, facts = given_landmarks(path, clip[0], tracks or clip[3], lambda name: grid, viewmats, said.append)
    parts = [np.stack([getattr(one, key) for one in merged]) for key in ("xy", "visibility", "world")]
    return *parts, facts, " | ".join(said)


def assert_right(clip, xy, visibility, within=1e-3):
    shown = visibility > 0
    assert shown.sum() > 12 * COUNT
    assert np.abs(xy - clip[1])[shown].max() < within


def test_a_good_file_takes_blazeposes_place_and_nothing_is_said(clip, tmp_path):
    xy, visibility, world, facts, said = take(clip, made.alphapose(tmp_path / "a.json", clip[1], "COCO-17"))
    assert_right(clip, xy, visibility)
    hands = [NAMES.index(f"{side}_index") for side in ("left", "right")]
    assert not visibility[:, hands].any() and facts["skeleton"] == "COCO-17" and not said
    np.testing.assert_array_equal(
        world, np.stack([one.world for one in clip[3]])
    )  # a file without 3D leaves BlazePose's


WRONG = {
    "y up": (lambda xy: xy * [1, -1] + [0, 360], "y"),
    "mirrored pictures": (lambda xy: (xy * [-1, 1] + [640, 0])[:, MIRRORED], "mirrored"),
    "swapped sides": (lambda xy: xy[:, MIRRORED], "left and right"),
    "pictures of 1920": (lambda xy: 3 * xy, "1920"),
    "pictures of 480, y up": (lambda xy: 0.75 * (xy * [1, -1] + [0, 360]), "480"),
    "shares": (lambda xy: xy / SIZE, "0 to 1"),
    "shares from the middle, y up": (lambda xy: (2 * xy / SIZE - 1) * [1, -1], "-1 to 1"),
}


@pytest.mark.parametrize("what", WRONG)
def test_plain_mistakes_are_corrected_with_a_word(clip, tmp_path, what):
    spoil, word = WRONG[what]
    xy, visibility, _, _, said = take(clip, made.mmpose(tmp_path / "a.json", spoil(clip[1]), "Halpe-26", 0))
    assert_right(clip, xy, visibility)
    assert holds(said, word) and holds(said, "a.json")


REFUSED = {
    "somebody else": lambda xy: xy * 0.5 + [30, 20] + 60 * np.random.default_rng(2).standard_normal((COUNT, 1, 2)),
    "cut pictures": lambda xy: xy - [60, 0],
    "frames in another order": lambda xy: xy[np.random.default_rng(3).permutation(COUNT)] + [0, 0],
    "squeezed pictures": lambda xy: xy * [0.56, 1],
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_corrected_is_refused_with_numbers(clip, tmp_path, what):
    with pytest.raises(StageError) as error:
        take(clip, made.mmpose(tmp_path / "a.json", REFUSED[what](clip[1]), "Halpe-26", 0))
    assert "a.json" in error.value.problem and "640x360" in " ".join(error.value.facts)


def test_of_several_people_the_one_in_the_picture_is_taken_also_where_ids_change(clip, tmp_path):
    gone = clip[1].copy()
    gone[12:] = np.nan
    back = clip[1].copy()
    back[:12] = np.nan
    path = made.alphapose(tmp_path / "a.json", clip[1] + [190, 10], "Halpe-26", (gone, back))
    xy, visibility, _, facts, said = take(clip, path)
    assert_right(clip, xy, visibility)
    assert facts["frames"] == COUNT and holds(said, "3 people")


def test_depths_of_a_frame_in_which_blazepose_exchanges_sides_follow_the_file(clip, tmp_path):
    tracks = list(clip[3])
    tracks[9] = SeenLandmarks(*(part[MIRRORED] for part in vars(tracks[9]).values()))
    _, _, world, *_ = take(clip, made.mmpose(tmp_path / "a.json", clip[1], first=0), tracks=tracks)
    np.testing.assert_array_equal(world[9], clip[3][9].world)


def test_people_in_an_array_are_told_apart_by_their_place(clip, tmp_path):
    both = np.stack([clip[1] - [150, 0], clip[1]], 1)
    rows = [made.triples("Halpe-26", both[:, k]) for k in (0, 1)]
    np.save(tmp_path / "a.npy", np.stack(rows, 1))
    xy, visibility, _, _, said = take(clip, tmp_path / "a.npy")
    assert_right(clip, xy, visibility)
    assert holds(said, "2 people", "1 is the person")


def test_a_point_of_another_part_of_the_body_is_left_out_by_name(clip, tmp_path):
    spoilt = clip[1].copy()
    spoilt[:, NAMES.index("left_wrist")] = spoilt[:, NAMES.index("right_knee")]
    xy, visibility, _, facts, said = take(clip, made.mmpose(tmp_path / "a.json", spoilt, first=0))
    assert facts["astray"] == ["left_wrist"] and holds(said, "left_wrist")
    assert_right(clip, xy, visibility)


def test_another_frame_rate_is_read_off_between_the_rows(clip, tmp_path):
    even = np.arange(0, COUNT - 0.9, 0.5)
    twice = np.stack(
        [[np.interp(even, np.arange(COUNT), column) for column in part] for part in clip[1].transpose(1, 2, 0)]
    )
    path = made.arrays(tmp_path / "a.npz", twice.transpose(2, 0, 1), fps=np.array(2 * FPS))
    xy, visibility, *_ = take(clip, path)
    assert_right(clip, xy, visibility)
    with pytest.raises(StageError, match="frames"):
        check_landmarks(made.arrays(tmp_path / "b.npz", twice.transpose(2, 0, 1)), clip[0])


@pytest.mark.parametrize("axes", ["the camera's", "z up, a world's", "y up, mirrored"])
def test_three_dimensions_come_in_any_axes(clip, tmp_path, axes):
    views = np.tile(np.eye(4), (COUNT, 1, 1))
    views[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 0.7, COUNT)[:, None] * [0, 1, 0]).as_matrix()
    spoilt = {
        "the camera's": lambda w: w,
        "z up, a world's": lambda w: (w @ views[:, :3, :3]) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T,
        "y up, mirrored": lambda w: w * [1, -1, 1],
    }[axes](clip[2])
    _, visibility, world, facts, said = take(clip, made.trc(tmp_path / "a.trc", 900 * spoilt, FPS), viewmats=views)
    legs = [NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("hip", "knee", "ankle", "elbow")]
    bones = [np.diff(part[:, legs], axis=1) for part in (world, clip[2])]
    np.testing.assert_allclose(*bones, atol=0.02)
    assert facts["3d"] and (said == "") == (axes == "the camera's") and visibility.max() == 0.9


def test_places_with_a_lens_become_those_of_the_pinhole_picture(clip, tmp_path):
    K = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    grid = opencv_grid(K, np.array([-0.2, 0.02, 0, 0, 0]), 640, 360)
    bent = np.stack([np.where(np.isfinite(p), lens_points(np.nan_to_num(p), grid), np.nan) for p in clip[1]])
    xy, visibility, *_ = take(clip, made.mmpose(tmp_path / "a.json", bent, first=0), grid)
    assert np.abs(bent - clip[1])[visibility > 0].max() > 1
    assert_right(clip, xy, visibility, 0.05)


def test_without_anybody_to_compare_with_the_file_is_refused(clip, tmp_path):
    with pytest.raises(StageError) as error:
        take(clip, made.mmpose(tmp_path / "a.json", clip[1], first=0), tracks=[*clip[3][:3], *[None] * (COUNT - 3)])
    assert "compared" in error.value.problem and holds(" ".join(error.value.facts), "3 frames")
