"""A camera that zooms while filming or reads its rows one after the other, in a model that COLMAP made without either."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see stages/estimators/cameras/colmap.py
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import camera_centers
from stages.contract import Job
from stages.estimators.cameras import colmap_lens
from stages.estimators.cameras.adjustment import BEHIND, _Solver, adjust, between_knots
from stages.estimators.cameras.changing import KNOTS, model_changes
from stages.estimators.cameras.colmap import Model
from stages.estimators.cameras.intrinsics import usual

WIDTH, HEIGHT, FOCAL, FRAMES = 960, 540, 760.0, 20


def views_at(moments: np.ndarray) -> np.ndarray:
    """viewmats [...,4,4] of a hand that walks past, at moments [...] in frames."""
    at = moments / FRAMES * 2 - 1
    turn = np.stack([20 * at, 3 * np.sin(3 * at), 2 * np.sin(4 * at)], -1).reshape(-1, 3)
    views = np.tile(np.eye(4), (*at.shape, 1, 1))
    views[..., :3, :3] = Rotation.from_euler("yxz", turn, degrees=True).as_matrix().reshape(*at.shape, 3, 3)
    centers = np.stack([1.3 * at, 0.2 * np.sin(3 * at), 0.1 * at**2 - 4], -1)
    views[..., :3, 3] = -(views[..., :3, :3] @ centers[..., None])[..., 0]
    return views


def model_of(zoom: float = 1.0, readout: float = 0.0, points: int = 120, noise: float = 0.2) -> pycolmap.Reconstruction:
    """What COLMAP makes of `points` seen by a camera that zooms by `zoom` and reads a picture in `readout` of a frame."""
    rng = np.random.default_rng(0)
    spots = rng.uniform([-2.2, -1.2, -1.0], [2.2, 1.2, 1.0], (points, 3))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for i in range(FRAMES):
        focal, row = FOCAL * (1 + (zoom - 1) * i / (FRAMES - 1)), np.full(points, HEIGHT / 2)
        for _ in range(5):  # the row says when a point is seen, and that where
            view = views_at(i + readout * (row / HEIGHT - 0.5))
            local = (view[:, :3, :3] @ spots[..., None])[..., 0] + view[:, :3, 3]
            seen = local[:, :2] / local[:, 2:] * focal + [WIDTH / 2, HEIGHT / 2]
            row = seen[:, 1]
        seen = seen + rng.normal(0, noise, seen.shape)
        image = pycolmap.Image(name=f"{i:06d}.png", camera_id=1, image_id=i + 1, keypoints=seen)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(views_at(np.array(float(i)))[:3]))
    for k, spot in enumerate(spots):
        track = pycolmap.Track()
        for i in range(FRAMES):
            track.add_element(i + 1, k)
        model.add_point3D(spot, track, np.array([k % 256, 7, 9], np.uint8))
    pycolmap.bundle_adjustment(model)
    return model


def changes(tmp_path: Path, model: pycolmap.Reconstruction) -> tuple[tuple[Model, dict] | None, str]:
    said: list[str] = []
    job = Job(tmp_path, emit=lambda event: said.append(event.get("text", "")))
    return model_changes(job, Model(model), WIDTH, HEIGHT, usual(WIDTH)), " ".join(said)


def off_path(model: Model) -> float:
    """How far the centres are from where they were, at most, as a share of the path's length."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3] = [pose for _, pose in sorted(model.poses.items())]
    found, true = (camera_centers(v) - camera_centers(v).mean(0) for v in (poses, views_at(np.arange(FRAMES * 1.0))))
    u, s, v = np.linalg.svd(true.T @ found)
    turned = s.sum() / (found**2).sum() * found @ (u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v).T
    return float(np.linalg.norm(turned - true, axis=1).max() / np.linalg.norm(np.diff(true, axis=0), axis=1).sum())


def test_a_camera_that_does_neither_is_left_alone(tmp_path):
    model = model_of()
    before = next(iter(model.cameras.values())).params.copy()
    found, said = changes(tmp_path, model)
    assert found is None and not said
    assert (next(iter(model.cameras.values())).params == before).all()


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [1.3, 0.8])
def test_a_zoom_while_filming_gives_each_frame_its_own_focal_length(tmp_path, zoom):
    made = model_of(zoom=zoom)
    one = Model(made).focal
    found, said = changes(tmp_path, made)
    assert found is not None and "zooms while filming" in said and "rolling" not in said
    model, facts = found
    true = FOCAL * (1 + (zoom - 1) * np.arange(FRAMES) / (FRAMES - 1))
    focals, ks = np.array([model.lenses[f"{i:06d}"][[0, 3]] for i in range(FRAMES)]).T
    assert abs(one / true.mean() - 1) > 0.1, "one focal length for all is far off"
    assert focals == pytest.approx(true, rel=0.02) and abs(focals.mean() / true.mean() - 1) < 0.01
    assert abs(ks).max() < 0.01 and model.error < 0.4 and off_path(model) < 0.01
    assert facts["first_focal_px"] == pytest.approx(focals[0], abs=0.01) and 0 < facts["focal_spread_px"] < 0.03 * FOCAL
    assert model.points == 120 and (model.reconstruction.points3D[8].color == [7, 7, 9]).all()


def test_a_rolling_shutter_makes_no_lens_up_and_cameras_are_of_the_middle_row(tmp_path):
    made = model_of(readout=0.5)
    free = made.cameras[1].params.copy()
    found, said = changes(tmp_path, made)
    assert found is not None and "rolling shutter" in said and "zooms" not in said
    model, facts = found
    focal, _, _, k = model.lenses["000003"]
    assert (
        facts["readout"] == pytest.approx(0.5, abs=0.02) and focal == pytest.approx(FOCAL, rel=0.01) and abs(k) < 0.005
    )
    assert abs(focal - FOCAL) < abs(free[0] - FOCAL), "without, the focal length is farther off"
    assert model.reconstruction.num_cameras() == 1 and model.error < 0.4, "places are moved to the middle row's time"
    assert off_path(model) < 0.005


@pytest.mark.slow
def test_a_zoom_and_a_rolling_shutter_are_told_apart(tmp_path):
    found, said = changes(tmp_path, model_of(zoom=1.2, readout=0.4))
    assert found is not None and "zooms" in said and "rolling" in said
    assert found[1]["readout"] == pytest.approx(0.4, abs=0.03)


def test_a_point_seen_twice_in_a_frame_counts_once():
    model = model_of(points=40)
    model.points3D[1].track.add_element(1, 5)
    _, seen, points = colmap_lens.bundle_of(model, (WIDTH, HEIGHT), 30)
    assert len(points) == 30 and len(np.unique(np.c_[seen.point, seen.frame], axis=0)) == len(seen.frame) == 30 * FRAMES


def test_between_knots_weights_sum_to_one_and_few_frames_have_all():
    assert between_knots(5, 1) == pytest.approx(np.ones((5, 1)))
    assert between_knots(20, KNOTS).sum(1) == pytest.approx(np.ones(20))
    assert between_knots(2, 3) == pytest.approx(np.array([[1.0, 0, 0], [0, 0, 1]]))


def test_a_bundle_that_is_a_little_off_comes_back_to_the_one_that_was_seen():
    bundle, seen, _ = colmap_lens.bundle_of(model_of(points=60, noise=0.0), (WIDTH, HEIGHT), 60)
    away = replace(bundle, points=bundle.points + 1e-3, log_focal=bundle.log_focal + 0.01, k=0.01)
    found = adjust(away, seen, False, FOCAL, 10.0)
    assert found.off.max() < 0.05 and found.bundle.focals[0] == pytest.approx(FOCAL, rel=2e-3)


def test_a_point_behind_its_camera_costs_as_if_it_were_far_out_of_the_picture():
    bundle, seen, _ = colmap_lens.bundle_of(model_of(points=60, noise=0.0), (WIDTH, HEIGHT), 60)
    points = bundle.points.copy()
    points[7] *= [1, 1, 1, -1]  # seen in the same place, but from behind
    solver, away = _Solver(bundle, seen, False, np.log(FOCAL), 1.0), replace(bundle, points=points)
    there, off = seen.point == 7, solver.errors(away)
    assert there.any() and (off[there] == BEHIND).all() and np.abs(off[~there]).max() < 1
    assert solver.cost(away, off) > solver.cost(bundle, solver.errors(bundle)) + 10 * there.sum()
