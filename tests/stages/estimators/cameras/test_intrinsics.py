"""Focal length and lens as evidence: kept where the clip fixes them, held near what cameras have where it does not."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see stages/estimators/cameras/colmap.py

import numpy as np
import pycolmap
import pytest

from stages.avatar.cameras.pinhole import look_at
from stages.contract import Job
from stages.estimators.cameras import colmap_lens
from stages.estimators.cameras.colmap import Model, refine
from stages.estimators.cameras.colmap_lens import lens_covariance
from stages.estimators.cameras.intrinsics import USUAL_FOCAL, Prior, settle, usual, weigh
from tests.made.said import holds

WIDTH, HEIGHT, FOCAL = 960, 540, 760.0


def model_of(degrees: float, points: int, noise: float = 0.25, views: int = 16) -> pycolmap.Reconstruction:
    """A model of `points` seen by all of `views` cameras on an arc of that many degrees, adjusted with a free lens."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[1.2 * WIDTH, 480, 270, 0.0], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    spots = rng.uniform([-2.2, -1.2, -1.0], [2.2, 1.2, 1.0], (points, 3))
    seen = []
    for i, angle in enumerate(np.radians(np.linspace(-degrees / 2, degrees / 2, views)), 1):
        view = look_at(
            np.array([4 * np.sin(angle), 0.1 * np.sin(3 * i), 4 * np.cos(angle)]), np.zeros(3), np.array([0, 1.0, 0])
        )
        local = spots @ view[:3, :3].T + view[:3, 3]
        seen.append(local[:, :2] / local[:, 2:] * FOCAL + [480, 270] + rng.normal(0, noise, (points, 2)))
        image = pycolmap.Image(name=f"{i:06d}.png", camera_id=1, image_id=i, keypoints=seen[-1])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view[:3]))
    for k, spot in enumerate(spots):
        track = pycolmap.Track()
        for i in range(views):
            track.add_element(i + 1, k)
        model.add_point3D(spot, track)
    pycolmap.bundle_adjustment(model)
    return model


def lens_of(model: pycolmap.Reconstruction) -> tuple[float, float]:
    focal, _, _, k = next(iter(model.cameras.values())).params
    return float(focal), float(k)


def settled(tmp_path, model: pycolmap.Reconstruction) -> tuple[dict, list[str]]:
    said: list[str] = []
    facts = settle(Job(tmp_path, emit=lambda event: said.append(event.get("text", ""))), Model(model), WIDTH, HEIGHT)
    return facts, said


def test_a_camera_that_travels_keeps_the_lens_it_found(tmp_path):
    model = model_of(40, 200)
    for image in model.images.values():
        for point in image.points2D:
            x = (point.xy - [480, 270]) / FOCAL
            point.xy = x * (1 + 0.02 * (x @ x)) * FOCAL + [480, 270]
    pycolmap.bundle_adjustment(model)
    before, poses = lens_of(model), Model(model).poses
    facts, said = settled(tmp_path, model)
    assert lens_of(model) == before and not said and facts["focal_spread_px"] < 0.02 * FOCAL
    assert before[0] == pytest.approx(FOCAL, rel=0.01) and before[1] == pytest.approx(0.02, abs=0.004)
    assert all((poses[name] == pose).all() for name, pose in Model(model).poses.items())


def test_a_camera_that_hardly_travels_is_held_near_what_cameras_have(tmp_path):
    model = model_of(0.3, 60, noise=0.5)
    free = lens_of(model)
    facts, said = settled(tmp_path, model)
    held = lens_of(model)
    assert abs(held[0] - FOCAL) < 2 * facts["focal_spread_px"] and abs(held[1]) <= abs(free[1])
    assert facts["free_focal_px"] == free[0] and facts["focal_spread_px"] > 0.02 * FOCAL
    assert len(said) == 1 and holds(said[0], f"{free[0]:.0f} px", "sfm.focal")
    assert Model(model).error < 2, "poses and points follow the lens that is held"


def test_what_the_file_tells_holds_a_lens_that_the_clip_does_not_fix(tmp_path):
    model = model_of(0.3, 60, noise=0.5)
    told = Prior(FOCAL * 1.02, 0.05, "EXIF")
    facts = settle(Job(tmp_path), Model(model), WIDTH, HEIGHT, told)
    assert lens_of(model)[0] == pytest.approx(told.focal, rel=0.03) and facts["focal_spread_px"] < 0.06 * FOCAL
    assert holds(told.said, "775 px", 39, "EXIF")


def test_the_stated_error_holds_where_the_clip_fixes_the_lens():
    model = model_of(12, 200)
    (focal, k), covariance = lens_of(model), lens_covariance(model)
    likely = weigh(focal, k, covariance, WIDTH, usual(WIDTH))
    assert abs(likely.focal - FOCAL) < 2 * likely.focal_spread and abs(likely.k) < 2 * likely.k_spread


def test_no_evidence_gives_what_cameras_have_and_much_gives_what_was_found():
    nothing, much = np.diag([1e12, 1e6]), np.diag([1e-4, 1e-8])
    nowhere, found = (weigh(1810.0, 1.4, covariance, 960, usual(960)) for covariance in (nothing, much))
    assert nowhere.focal == pytest.approx(USUAL_FOCAL * 960, rel=1e-3) and nowhere.k == pytest.approx(0, abs=1e-3)
    assert found.focal == pytest.approx(1810) and found.k == pytest.approx(1.4, abs=1e-4)


@pytest.mark.parametrize("bad", [None, np.zeros((2, 2)), np.full((2, 2), np.inf)])
def test_a_lens_whose_error_cannot_be_computed_is_kept_and_said(tmp_path, monkeypatch, bad):
    model = model_of(10, 30, views=4)
    before = lens_of(model)
    monkeypatch.setattr(colmap_lens, "lens_covariance", lambda model: bad)
    facts, said = settled(tmp_path, model)
    assert facts == {} and lens_of(model) == before and "could not be computed" in said[0]


@pytest.mark.parametrize("bad", [np.diag([np.nan, 1]), np.diag([-1.0, 1]), np.zeros((2, 2))])
def test_what_is_no_covariance_is_refused(bad):
    with pytest.raises(ValueError, match="no covariance"):
        weigh(800.0, 0.0, bad, 960, usual(960))


def test_halves_of_a_clip_that_disagree_widen_the_error(tmp_path, monkeypatch):
    model = model_of(40, 200)
    monkeypatch.setattr(colmap_lens, "half_focals", lambda model: (700.0, 900.0))
    facts, _ = settled(tmp_path, model)
    assert facts["focal_spread_px"] >= 100


def test_halves_of_a_clip_without_a_zoom_agree_and_few_pictures_have_none():
    first, second = colmap_lens.half_focals(model_of(40, 200))
    assert first == pytest.approx(FOCAL, rel=0.02) and second == pytest.approx(FOCAL, rel=0.02)
    assert colmap_lens.half_focals(model_of(40, 60, views=8)) is None


def off_the_arc(model: pycolmap.Reconstruction, degrees: float) -> float:
    """How far the centres of `model_of`'s cameras lie from where they were taken, after the best similarity: rms."""
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, model.num_reg_images()))
    true = np.stack([4 * np.sin(angles), 0.1 * np.sin(3 * np.arange(1, len(angles) + 1)), 4 * np.cos(angles)], 1)
    found = np.array([model.images[i].projection_center() for i in range(1, len(angles) + 1)])
    sim = pycolmap.estimate_sim3d(found, true)
    return float(np.sqrt(((sim * found - true) ** 2).sum(1).mean()))


def test_matches_that_move_pull_the_cameras_hardly_once_they_are_refined():
    """One point in four goes along with a shadow, by 2 px there and back: too little to be thrown out."""
    model = model_of(20, 160, noise=0.05)
    alone = off_the_arc(model, 20)
    for image in model.images.values():
        for k in range(0, len(image.points2D), 4):
            image.points2D[k].xy = image.points2D[k].xy + 2 * np.sin(image.image_id * np.array([0.4, 0.5]))
    huber = pycolmap.BundleAdjustmentOptions()
    huber.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    pycolmap.bundle_adjustment(model, huber)
    pulled, twin = off_the_arc(model, 20), pycolmap.Reconstruction(model)
    refine(Model(model), fixed_focal=False)
    assert pulled > 5 * alone and off_the_arc(model, 20) < 0.5 * pulled
    assert lens_of(model)[0] == pytest.approx(FOCAL, rel=0.005)
    refine(Model(twin), fixed_focal=False)
    assert all((pose == Model(twin).poses[name]).all() for name, pose in Model(model).poses.items()), "the same bytes"
    assert all(point.error == twin.points3D[i].error for i, point in model.points3D.items())


def test_a_focal_length_that_is_known_stays_when_a_model_is_refined():
    model = model_of(20, 60)
    before = lens_of(model)[0]
    for image in model.images.values():
        image.points2D[0].xy = image.points2D[0].xy + [40 * (-1) ** image.image_id, 0]
    refine(Model(model), fixed_focal=True)
    assert lens_of(model)[0] == before
    worst = max(model.points3D.items(), key=lambda item: item[1].error)[0]
    assert worst == 1 and model.points3D[1].error > 5, "errors are those of the refined model"


def test_a_lens_that_cannot_be_told_from_none_is_none(tmp_path):
    model = model_of(40, 200)
    free = lens_of(model)
    facts, said = settled(tmp_path, model)
    focal, k = lens_of(model)
    assert 0 < abs(free[1]) < 2 * facts["k_spread"] and k == 0 and facts["free_k"] == free[1]
    assert abs(focal - FOCAL) < abs(free[0] - FOCAL) and len(said) == 1 and "distortion" in said[0]
