"""Landmarks and outlines by BlazePose; its networks are tried on the kitchen clip."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.contract import StageError
from stages.estimators import assets
from stages.estimators.person.blazepose import COUNT, LOOKS, NAMES, BlazePose, anchors, refine
from stages.estimators.person.crops import Roi, crop, to_picture

at = {name: i for i, name in enumerate(NAMES)}


def moved(image, matrix, size):
    """Warp a picture by a [2,3] that takes px to px, pixel centres at halves."""
    matrix = matrix.copy()
    matrix[:, 2] += matrix[:, :2].sum(1) / 2 - 0.5
    return cv2.warpAffine(image, matrix, size, flags=cv2.INTER_AREA, borderValue=(90, 90, 90))


def test_names_and_anchors():
    assert len(NAMES) == COUNT == 33 == len(set(NAMES)) and NAMES[24] == "right_hip"
    grid = anchors()
    assert grid.shape == (2254, 2) and grid.min() > 0 and grid.max() < 1
    assert np.allclose(grid[:3], [[0.5 / 28, 0.5 / 28]] * 2 + [[1.5 / 28, 0.5 / 28]])
    assert np.allclose(grid[1568], 0.5 / 14) and np.allclose(grid[-1], 6.5 / 7)


def test_a_roi_points_its_up_at_the_given_point():
    for top in ([50, 20], [90, 60], [50, 100], [10, 60], [80, 30]):
        roi = Roi.around(np.array([50.0, 60.0]), np.array(top, float))
        center, up = to_picture(np.array([[0.5, 0.5], [0.5, 0.0]]), roi)
        direction = np.array(top) - [50, 60]
        assert np.allclose(center, [50, 60]) and np.allclose(up - center, direction * 1.25)


def test_a_crop_is_exact_to_a_tenth_of_a_pixel():
    """A linear ramp in the picture, cut out turned and shrunk, has the values that the crop's matrix says."""
    y, x = np.mgrid[:400, :500] + 0.5
    ramp = np.stack([x / 2, y / 2, 0 * x], 2).astype(np.float32)
    for roi in (Roi(240, 200, 100, 0.4), Roi(251.3, 190.7, 256, -0.2), Roi(250, 200, 260.5, 0.0)):
        for side in (256, 64, 40):
            cut = crop(ramp, roi, side, cv2.BORDER_REPLICATE)
            v, u = np.mgrid[:side, :side] + 0.5
            want = to_picture(np.stack([u, v], 2).reshape(-1, 2) / side, roi).reshape(side, side, 2)
            inside = (want > 20).all(2) & (want[..., 0] < 480) & (want[..., 1] < 380)
            assert np.abs(cut[..., :2] * 2 - want)[inside].max() < 0.1


def test_refining_finds_a_peak_between_cells():
    y, x = np.mgrid[:64, :64]
    heat = np.exp(-((x - 20.3) ** 2 + (y - 31.6) ** 2) / 4)[..., None].astype(np.float32)
    assert np.allclose(refine(np.array([[21.0, 31.0]]) / 64, heat) * 64, [[20.3, 31.6]], atol=0.1)
    far = np.array([[2.0, 0.5]])
    assert np.array_equal(refine(far, heat), far)
    faint = np.array([[21.0, 31.0]]) / 64
    assert np.array_equal(refine(faint, heat * 0.4), faint)


def test_without_the_networks_it_says_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    assert not assets.present("pose_detection.tflite")
    with pytest.raises(StageError, match="not on this machine") as error:
        BlazePose()
    assert "hugs doctor --fetch" in error.value.hint


def test_nobody_is_seen_in_an_empty_room(blazepose):
    rng = np.random.default_rng(0)
    empty = [np.full((200, 300, 3), 128, np.uint8), rng.integers(0, 256, (200, 300, 3), dtype=np.uint8)]
    assert blazepose.track(empty) == [None, None] and blazepose.track([]) == []


@pytest.mark.slow
def test_the_kitchen_man_is_followed(blazepose, kitchen):
    images = list(kitchen.values())
    poses = blazepose.track(images)
    assert all(pose is not None and pose.presence > 0.9 for pose in poses)
    first = poses[0]
    assert np.abs(first.xy[at["nose"]] - [238, 155]).max() < 15  # read off the picture by eye
    assert first.xy[at["left_shoulder"], 0] > first.xy[at["right_shoulder"], 0]  # he faces us
    ankles = first.xy[[at["left_ankle"], at["right_ankle"]], 1]
    assert (np.abs(ankles - 627) < 25).all() and first.visibility.min() > 0.5
    heights = [np.ptp(pose.world[:, 1]) for pose in poses]
    assert min(heights) > 1.3 and max(heights) < 2.0


@pytest.mark.slow
def test_a_crop_of_the_trunk_is_left_when_the_whole_person_shows(blazepose, kitchen):
    image = next(iter(kitchen.values()))
    whole = blazepose.track([image])[0]
    trunk = whole.next_roi.reframe(0.65, 35, -0.15)  # as after somebody bent
    stuck = blazepose.average_looks(image, trunk)
    assert stuck.presence < whole.presence - 0.005
    found = blazepose.unstuck(image, stuck)
    assert np.abs(found.xy[at["left_ankle"]] - whole.xy[at["left_ankle"]]).max() < 15
    assert blazepose.unstuck(image, whole) is whole  # nothing to mend


def test_crops_resemble_each_other_across_the_turn_of_half_a_circle():
    roi = Roi(100, 100, 50, np.pi - 0.05)
    assert roi.resembles(Roi(103, 100, 52, 0.05 - np.pi), 0.15, 0.2)
    assert not roi.resembles(Roi(103, 100, 52, 0.3 - np.pi), 0.15, 0.2)
    assert not roi.resembles(Roi(108, 100, 50, roi.angle), 0.15, 0.2)
    assert not roi.resembles(Roi(100, 100, 58, roi.angle), 0.15, 0.2)


def test_a_look_that_swaps_sides_is_left_out(blazepose, kitchen, monkeypatch):
    image, plain = kitchen[0], BlazePose.look
    want = blazepose.track([image])[0]
    calls = []

    def swapping(self, image, roi, mirrored=False):
        pose, mask = plain(self, image, roi, mirrored)
        calls.append(roi)
        if len(calls) == 2:
            pose = replace(pose, xy=pose.xy[::-1].copy())
        return pose, mask

    monkeypatch.setattr(BlazePose, "look", swapping)
    got = blazepose.average_looks(image, want.roi)
    assert len(calls) == len(LOOKS) and np.abs(got.xy - want.xy).max() < 4


def test_a_mirrored_look_says_the_same_about_the_picture_as_it_is(blazepose, kitchen):
    roi = blazepose.track([kitchen[0]])[0].roi
    (plain, outline), (mirrored, mirrored_outline) = (blazepose.look(kitchen[0], roi, m) for m in (False, True))
    assert np.linalg.norm(mirrored.xy - plain.xy, axis=1).max() < 0.03 * roi.side
    assert np.linalg.norm(mirrored.world - plain.world, axis=1).mean() < 0.1
    assert ((outline > 0) == (mirrored_outline > 0)).mean() > 0.98
    side = at["left_shoulder"], at["right_shoulder"]
    assert plain.xy[side[0], 0] > plain.xy[side[1], 0] and mirrored.xy[side[0], 0] > mirrored.xy[side[1], 0]


@pytest.mark.slow
def test_a_turned_small_or_late_person_is_found(blazepose, kitchen):
    image = kitchen[0]
    upright = blazepose.track([image])[0]
    quarter = np.array([[0.0, -1.0, 864.0], [1.0, 0.0, 0.0]])  # clockwise
    small = np.array([[0.3, 0.0, 600.0], [0.0, 0.3, 300.0]])
    for matrix, size, px in ((quarter, (864, 480), 15), (small, (1000, 600), 8)):
        pose = blazepose.track([np.full((50, 60, 3), 90, np.uint8), moved(image, matrix, size)])[1]
        want = upright.xy @ matrix[:, :2].T + matrix[:, 2]
        assert np.median(np.hypot(*(pose.xy - want).T)) < px
        assert np.linalg.norm(pose.world - upright.world @ rotation(matrix).T, axis=1).mean() < 0.1


def rotation(matrix):
    full = np.eye(3)
    full[:2, :2] = matrix[:, :2] / np.sqrt(np.linalg.det(matrix[:, :2]))
    return full


@pytest.mark.slow
def test_he_is_found_again_after_a_gap(blazepose, kitchen):
    image = kitchen[0]
    gone = np.full_like(image, 100)
    shifted = np.roll(image, 120, 1)
    poses = blazepose.track([image, gone, gone, shifted, image])
    assert [pose is None for pose in poses] == [False, True, True, False, False]
    assert np.abs((poses[3].xy - poses[0].xy)[:, 0] - 120).mean() < 12
