"""Every program's file, made from known places, comes back with them; what is in another order or unit is said or refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.given_landmarks.recognize import read_landmark_file
from stages.formats.landmarks import NAMES
from tests.made import landmark_files as made
from tests.made.said import holds

SIZE = (640, 360)


@pytest.fixture
def points():
    return made.somebody(9)


@pytest.mark.parametrize("program", made.WRITERS)
def test_each_program_comes_back(points, tmp_path, program):
    name, write = made.WRITERS[program]
    given = read_landmark_file(write(tmp_path / name, points), SIZE)
    known = np.isfinite(given.xy).all(-1)
    assert len(given) == 9 and known[:, [NAMES.index(f"left_{p}") for p in ("shoulder", "wrist", "knee")]].all()
    np.testing.assert_allclose(given.xy[known], points[known], atol=1e-5)
    assert (given.confidence > 0.85)[known].all() and not given.confidence[~known].any()
    assert known[0].sum() == {"OpenPose": 21, "OpenPose with hands": 25, "DeepLabCut": 17}.get(program, known[0].sum())
    assert not given.notes


def test_three_dimensions_and_times_of_a_trc(points, tmp_path):
    world = np.concatenate([points, points[..., :1] - 300], -1) / 100
    given = read_landmark_file(made.trc(tmp_path / "a.trc", world, 30.0), SIZE)
    known = np.isfinite(given.world).all(-1)
    assert given.xy is None and known[0].sum() == 17
    np.testing.assert_allclose(given.world[known], world[known], atol=1e-5)
    np.testing.assert_allclose(given.times, np.arange(9) / 30, atol=1e-5)


def test_people_are_told_apart_by_their_ids(points, tmp_path):
    given = read_landmark_file(made.alphapose(tmp_path / "a.json", points, others=(points + 90,)), SIZE)
    assert given.tracks == ("1",) * 9 + ("2",) * 9 and given.names[:2] == ("0", "1")


def test_shares_of_the_picture_become_pixels_and_it_is_said(points, tmp_path):
    given = read_landmark_file(made.blazepose(tmp_path / "a.npy", points, SIZE), SIZE)
    np.testing.assert_allclose(given.xy[0, 11], points[0, 11], atol=1e-9)
    assert any(holds(note, "0 to 1", "640x360") for note in given.notes)


def test_confidences_to_100_and_numbers_that_are_none_are_said(points, tmp_path):
    rows = made.triples("COCO-17", points, 90.0)
    rows[4, 7, :2] = np.nan
    np.save(tmp_path / "a.npy", rows)
    given = read_landmark_file(tmp_path / "a.npy", SIZE)
    assert given.confidence[0, 11] == 0.9 and given.confidence[4, 13] == 0 and np.isnan(given.xy[4, 13]).all()
    assert holds(" ".join(given.notes), "90", "100", "1 of 153")


def test_points_in_no_known_order_or_number_are_refused_with_facts(points, tmp_path):
    shuffled = made.triples("COCO-17", points)[:, np.random.default_rng(1).permutation(17)]
    for rows, words in (
        (shuffled, ("order", "COCO-17", "Human3.6M")),
        (shuffled[:, :11], ("11 points", "17 (COCO-17)")),
    ):
        np.save(tmp_path / "a.npy", rows)
        with pytest.raises(StageError) as error:
            read_landmark_file(tmp_path / "a.npy", SIZE)
        assert holds(" ".join([error.value.problem, *error.value.facts]), *words)


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.json", b"{"),
        ("a.json", b'{"people": 3}'),
        ("a.json", b'[{"frame_id": 0}]'),
        ("a.json", b'[{"image_id": "0.jpg", "keypoints": [1, 2]}]'),
        ("a.json", json.dumps({"keypoints": [[1]], "skeleton": {"a": "nose"}}).encode()),
        ("a.csv", b"scorer,a\nbodyparts,b\ncoords,x\n"),
        ("a.csv", b"\xff\xfe"),
        ("a.trc", b"Frame#\tTime\tLHip\t\t\n"),
        ("a.npy", b"\x93NUMPY"),
        ("a.mp4", b"\0\0"),
    ],
)
def test_what_holds_no_landmarks_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(StageError) as error:
        read_landmark_file(tmp_path / name, SIZE)
    assert name in error.value.problem


def test_individuals_of_a_table_without_all_points_are_left_out_and_named(tmp_path):
    """As DeepLabCut's `single`, which has points of its own."""
    parts = ["left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"]
    columns = [("ann", part, axis) for part in parts for axis in "xy"] + [("single", "ball", axis) for axis in "xy"]
    head = [["individuals", *(who for who, _, _ in columns)], ["bodyparts", *(part for _, part, _ in columns)]]
    rows = [[str(i), *(str(10.0 * k + i) for k in range(len(columns)))] for i in range(3)]
    lines = [*head, ["coords", *(axis for *_, axis in columns)], *rows]
    (tmp_path / "a.csv").write_text("\n".join(map(",".join, lines)))
    given = read_landmark_file(tmp_path / "a.csv", SIZE)
    assert len(given) == 3 and set(given.tracks) == {"ann"}
    (note,) = given.notes
    assert holds(note, "single", "left out")
