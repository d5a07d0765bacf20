"""What is said of a COLMAP model can be, wherever its points went; few points behind a camera are no reason to doubt all."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see stages/estimators/cameras/colmap.py

import numpy as np
import pycolmap
import pytest

from stages.contract import Job
from stages.estimators.cameras import intrinsics
from stages.estimators.cameras.adjustment import Adjusted, Bundle
from stages.estimators.cameras.check import match_error
from stages.estimators.cameras.colmap import Cloud, Model, posed_model, robust
from stages.estimators.cameras.intrinsics import Intrinsics, compare_halves, spreads
from stages.estimators.cameras.ladder import Matched, Rung
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import Pinholes, write_points
from stages.formats.given_cameras.record import possible_errors
from tests.made.possible import impossible

WIDTH, HEIGHT, POINTS = 320, 240, 200
DIAGONAL = 400.0
"""px of the picture."""
LOST = {  # how many points are moved, and where to
    "behind": (3, [0, 0, -5.0]),
    "half behind": (POINTS // 2 + 1, [0, 0, -5.0]),
    "all behind": (POINTS, [0, 0, -5.0]),
    "in a camera": (3, [0, 0, 0.0]),
    "beside all": (3, [1e6, 0, 1e-6]),
    "infinitely far": (3, [1e200, 0, 1e200]),
    "nowhere": (3, [np.nan, 0, 4.0]),
}


def model_with(moved: int, to: list[float]) -> Model:
    """Three cameras and POINTS points that they see to half a pixel, but for the first few."""
    files, rng = [f"{i:06d}.png" for i in range(3)], np.random.default_rng(0)
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 0, 3] = [0, 0.3, 0.6]
    K = np.array([[300.0, 0, WIDTH / 2], [0, 300, HEIGHT / 2], [0, 0, 1]])
    model = posed_model(files, viewmats, np.tile(K, (3, 1, 1)), WIDTH, HEIGHT)
    xyz = rng.uniform([-1, -1, 4], [1, 1, 6], (POINTS, 3))
    for i, viewmat in enumerate(viewmats, 1):
        local = xyz + viewmat[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * 300 + [WIDTH / 2, HEIGHT / 2] + rng.uniform(-0.5, 0.5, (POINTS, 2))
        model.images[i].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
    xyz[:moved] = to
    for k, place in enumerate(xyz):
        track = pycolmap.Track()
        for i in range(3):
            track.add_element(i + 1, k)
        model.add_point3D(place, track)
    model.update_point_3d_errors()
    return Model(model)


@pytest.mark.parametrize("where", LOST)
def test_the_error_of_a_model_is_possible_wherever_points_are(where, tmp_path):
    moved, to = LOST[where]
    model = model_with(moved, to)
    matched = Matched(tmp_path, tmp_path, tmp_path, 3, WIDTH, 3, 2, True)
    assert not impossible(model.facts(), WIDTH, HEIGHT) and 0 < model.middle_error <= DIAGONAL
    assert 0 < robust(model.reconstruction).ceres.loss_function_scale < 10 * DIAGONAL
    said = Rung("a mapper", [model], 1.0).describe(matched)
    assert max(map(len, said.replace(",", " ").split())) < 20, said
    if moved == 3:
        assert model.middle_error < 1 and model.error < 3 / POINTS * DIAGONAL + 1


def test_a_model_without_points_has_no_error():
    assert Model(posed_model(["a.png"], np.eye(4)[None], np.eye(3)[None], WIDTH, HEIGHT)).error == 0


def test_errors_of_given_points_are_those_that_somebody_computed(tmp_path):
    errors = np.array([-1.0, 0.5, np.nan, 1.34e154, 1.5])
    assert possible_errors(errors, WIDTH, HEIGHT).tolist() == [0.5, DIAGONAL, 1.5]
    one, xyz = np.ones(5), np.random.default_rng(0).uniform(-1, 1, (5, 3)) + [0, 0, 5]
    nothing = np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), lambda name: None
    for these, mean in ((errors, 1.0), (-one, None)):
        cloud = Cloud(np.arange(5), xyz, np.zeros((5, 3), np.uint8), these, 3 * one, one, (np.arange(3),) * 5)
        keep, facts = write_points(Job(tmp_path), Pinholes("moving", [], *nothing, {}, None, cloud), cloud)
        assert facts["reprojection_px"] == mean and keep[0]


@pytest.mark.parametrize("variance", [np.nan, -1.0, 0.0, 1e-12, 1e300, np.inf])
@pytest.mark.parametrize("noise", [1e-3, 0.3, 100.0])
def test_spreads_are_possible_however_little_is_known(variance, noise, monkeypatch):
    bundle = Bundle(np.eye(4)[None], np.zeros((1, 4)), np.log([500.0]), 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        found = spreads(Adjusted(bundle, np.zeros(1), 0.0, variance * np.eye(3), noise), WIDTH)
    assert 0 <= found["focal_spread_px"] <= 500 and 0 <= found["k_spread"] <= 1
    for halves in ((480.0, 1e12), (np.nan, 500.0), (-4e8, np.inf), (490.0, 510.0)):
        monkeypatch.setattr(intrinsics.colmap_lens, "half_focals", lambda model, halves=halves: halves)
        told = compare_halves(model_with(0, [0, 0, 0]), Intrinsics(500.0, 0.0, 5.0, 0.01))
        assert 0 < told["focal_spread_px"] <= 500
    assert told["focal_spread_px"] == pytest.approx(np.hypot(5, 10), abs=1e-3)


def test_matches_are_no_farther_from_their_lines_than_a_picture_is_wide():
    rng, Ks = np.random.default_rng(0), np.tile(np.diag([300.0, 300, 1]), (2, 1, 1))
    pair = [Pair(0, 1, *rng.uniform(0, 240, (2, 50, 2)))]
    for shift in ([0, 0, 0], [1e-200, 0, 0], [0, 0, 1e-300], [1e100, 0, 0], [0, 0, 1.0]):
        viewmats = np.tile(np.eye(4), (2, 1, 1))
        viewmats[1, :3, 3] = shift
        assert 0 <= match_error(pair, viewmats, Ks, DIAGONAL) <= DIAGONAL, shift
