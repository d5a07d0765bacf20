import json

import numpy as np
import pytest

from stages import survey
from stages.contract import Job


def gains(frames: int = 30, drift: float = 0.0, step: float = 0.0, hidden: float = 0.4):
    rng = np.random.default_rng(1)
    truth = drift * np.sin(np.linspace(0, 6, frames)) + step * (np.arange(frames) >= frames // 2)
    logs = rng.normal(4.5, 0.4, 400) + truth[:, None] + rng.normal(0, 0.01, (frames, 400))
    logs[rng.random(logs.shape) < 0.1] += 0.7  # a point hidden behind something brighter
    logs[rng.random(logs.shape) < hidden] = np.nan
    return logs, truth - truth.mean()


def test_exposure_gains_survive_hidden_points_and_gaps():
    logs, truth = gains(drift=0.1, step=0.08)
    logs[7] = np.nan
    found = survey.robust_gains(logs)
    seen = np.isfinite(found)
    assert not seen[7] and seen.sum() == 29
    assert np.abs(found[seen] - (truth[seen] - truth[seen].mean())).max() < 0.01


def test_steady_exposure_stays_below_the_threshold():
    found = survey.robust_gains(gains()[0])
    assert found.std() < survey.EXPOSURE_STD / 3 and np.abs(np.diff(found)).max() < survey.EXPOSURE_STEP / 3


def test_too_few_points_are_unknown_not_zero():
    assert np.isnan(survey.robust_gains(np.full((5, 10), 4.0))).all()
    assert np.isnan(survey.robust_gains(np.zeros((5, 0)))).all()


def test_point_colours_leave_out_person_border_and_clipped():
    image = np.full((20, 30, 3), 100, np.uint8)
    image[:, 20:] = 255
    mask = np.zeros((20, 30), np.uint8)
    mask[:, :5] = 255
    pixels = np.array([[12.0, 10], [2, 10], [27, 10], [40, 10], [-3, 5], [12, 10]])
    logs = survey.point_logs(image, mask, pixels, np.array([1.0, 1, 1, 1, 1, -1]))
    assert logs[0] == pytest.approx(np.log(100), abs=1e-3) and np.isnan(logs[1:]).all()


def measures(points=500, iou=0.8, drift="steady"):
    return {
        "points": survey.measure(points, "", 100, "enough"),
        "body_fit": survey.measure(iou, "IoU", 0.95, "good" if iou >= 0.95 else "loose"),
        "exposure_drift": survey.measure(0.03, "std", 0.02, drift),
        "exposure_step": survey.measure(0.01, "log", 0.05, drift),
    }


@pytest.mark.parametrize(
    ("verdict", "points", "setting", "scene"),
    [
        ("moving", 500, "auto", True),
        ("moving", 20, "auto", False),
        ("static camera", 0, "auto", False),
        ("rotation only", 0, "auto", False),
        ("moving", 500, "never", False),
        ("moving", 20, "always", True),
        ("static camera", 0, "always", False),
    ],
)
def test_the_scene_needs_a_moving_camera_and_points(verdict, points, setting, scene):
    decisions, reasons = survey.decide(survey.Params(scene=setting), {"verdict": verdict}, measures(points))
    assert decisions["scene"] is scene
    assert len(reasons) == len(decisions) and reasons[0].startswith("scene " + ("on" if scene else "off"))


def test_exposure_and_refinement_follow_measures_unless_set():
    facts = {"verdict": "moving"}
    decisions, _ = survey.decide(survey.Params(), facts, measures(iou=0.97, drift="drifts"))
    assert decisions == {"scene": True, "pose_refinement": False, "exposure": True}
    forced = survey.Params(exposure="never", pose_refinement="always")
    decisions, reasons = survey.decide(forced, facts, measures(iou=0.97, drift="drifts"))
    assert decisions == {"scene": True, "pose_refinement": True, "exposure": False} and "as set" in reasons[1]


def test_overlap():
    a = np.zeros((4, 4), bool)
    assert survey.overlap(a, a) == 0
    b = a.copy()
    a[:2], b[1:3] = True, True
    assert survey.overlap(a, b) == pytest.approx(1 / 3)


@pytest.fixture
def body_clip(tmp_path):
    """A tiny clip: the free body stands 3 m before a camera; its mask is its own silhouette."""
    from stages.formats.body_model import read_body_model, write_body_model
    from stages.formats.cameras import Cameras, write_cameras
    from stages.formats.clip import load_clip
    from stages.formats.images import write_image, write_mask
    from stages.formats.points import write_points
    from stages.formats.poses import BodyPoses, write_poses

    names, count = ("000000", "000004"), 2
    sfm, smpl = tmp_path / "sfm", tmp_path / "smpl"
    for folder in (sfm / "images", sfm / "masks", smpl):
        folder.mkdir(parents=True)
    Ks = np.tile([[120.0, 0, 48], [0, 120, 64], [0, 0, 1]], (count, 1, 1))
    write_cameras(sfm / "cameras.npz", Cameras(names, np.tile(np.eye(4), (count, 1, 1)), Ks, 96, 128))
    write_points(sfm / "points.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    upside_down = np.tile([np.pi, 0, 0], (count, 1))  # y up to y down
    transl = np.tile([0, 0.0, 3.0], (count, 1))
    poses = BodyPoses(names, np.zeros(10), upside_down, np.zeros((count, 69)), transl, np.ones(count), 1.0)
    write_poses(smpl / "body.npz", poses)
    write_body_model(smpl / "body_model.npz", read_body_model())
    for name in names:
        write_image(sfm / "images" / f"{name}.png", np.full((128, 96, 3), 90, np.uint8))
        write_mask(sfm / "masks" / f"{name}.png", np.zeros((128, 96), np.uint8))
    for name, drawn in zip(names, survey.outlines(load_clip(sfm, smpl), [0, 1]), strict=True):
        assert 0.05 < drawn.mean() < 0.5
        write_mask(sfm / "masks" / f"{name}.png", drawn.astype(np.uint8) * 255)
    facts = {"verdict": "static camera", "distortion": {"max_shift_px": 0.0}}
    (sfm / "sfm.json").write_text(json.dumps(facts))
    return sfm, smpl


def test_the_stage_on_a_static_clip(body_clip, tmp_path):
    sfm, smpl = body_clip
    events = []
    out = tmp_path / "out"
    out.mkdir()
    survey.run(Job(out, emit=events.append), survey.Params(), frames=tmp_path, masks=tmp_path, sfm=sfm, smpl=smpl)
    found = json.loads((out / "survey.json").read_text())
    assert found["decisions"] == {"scene": False, "pose_refinement": False, "exposure": False}
    assert found["measures"]["body_fit"]["value"] == pytest.approx(1)
    assert found["measures"]["camera_parallax"]["verdict"] == "unknown"
    assert any("static camera" in event.get("text", "") for event in events)
    assert {"value", "unit", "threshold", "verdict", "frames"} == set(found["measures"]["coverage"])
