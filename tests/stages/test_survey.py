"""Stage survey decides on scene and effects by what it measures."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stages import survey
from stages.avatar.kernels.mesh import covered
from stages.contract import Job
from stages.estimators.bodyfit.inputs import touch
from stages.estimators.bodyfit.posed import posed_bodies
from stages.estimators.detectors.every import DETECTORS
from stages.estimators.detectors.finding import compare, unmeasured
from stages.formats.clip import load_people
from stages.formats.facts import Sfm
from tests.made import company, tiny
from tests.made.possible import impossible
from tests.made.said import holds

EFFECTS = {"view_dependence", "exposure", "lens", "rolling_shutter", "motion_blur", "shadow", "clothing"}
EFFECTS |= {"pose_refinement", "camera_refinement", "sky", "transients", "antialias", "shading", "face"}


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
    on, why = survey.decide_scene(setting, verdict, points)
    assert on is scene and (str(points) in why or verdict in why or "no points" in why)


def test_there_is_one_detector_and_one_setting_for_each_effect():
    assert set(DETECTORS) == EFFECTS
    assert set(survey.Params.model_fields) == EFFECTS - {"lens"} | {"scene"}
    assert set(survey.Params().model_dump().values()) == {"auto"}


FINDINGS = {
    "called for": compare(0.3, "px", 0.1, ("yes", "no")),
    "quiet": compare(0.05, "px", 0.1, ("yes", "no")),
    "unknown": unmeasured("px", 0.1, "too dark"),
}


@pytest.mark.parametrize(
    ("setting", "on"),
    [("auto", (True, False, False)), ("always", (True, True, True)), ("never", (False, False, False))],
)
def test_effects_follow_what_is_measured_unless_set_and_unknown_is_off(setting, on):
    entries = [survey.decide(setting, finding) for finding in FINDINGS.values()]
    assert tuple(entry["on"] for entry in entries) == on
    assert {"value", "unit", "threshold", "verdict", "confidence", "frames", "on", "why"} == set(entries[0])
    assert all(entry["why"].startswith("as set") is (setting != "auto") for entry in entries)
    assert entries[2]["value"] is None and entries[2]["confidence"] == 0 and "too dark" in entries[2]["why"]


def test_reasons_name_what_is_on_and_what_could_not_be_measured():
    told = survey.reasons({name: survey.decide("auto", finding) for name, finding in FINDINGS.items()})
    assert holds(told[0], "called for on", "0.3 px", 0.1) and holds(told[1], "unknown off", "dark")
    assert len(told) == 3 and holds(told[2], "off", "quiet")
    hidden = {"face": survey.decide("auto", compare(0.1, "of the frames", 0.5, ("seen", "hidden")))}
    assert survey.reasons(hidden) == ["face off (hidden: 0.1 of the frames, limit 0.5)"]


def test_confidence_grows_with_the_distance_from_the_threshold():
    found = [compare(value, "px", 1.0, ("yes", "no")).confidence for value in (0.0, 0.5, 0.9, 1.0, 1.1, 2.0, 8.0)]
    assert found[3] == 0 and found[1] == found[5] == 0.75
    assert found[0] > found[1] > found[2] > 0 < found[4] < found[5] < found[6] <= 1
    doubtful = compare(5.0, "px", 1.0, ("yes", "no"), also=False)
    assert not doubtful.called_for and doubtful.verdict == "no" and doubtful.confidence == 0.5


def test_what_is_not_finite_was_not_measured():
    for value in (np.nan, np.inf, -np.inf):
        found = compare(value, "px", 1.0, ("yes", "no"), ["a"])
        assert found == unmeasured("px", 1.0, "the measurement failed") and not impossible(found.entry(), 9, 9)
        assert survey.measure(value, "px", 1.0, "good") == survey.measure(None, "px", 1.0, "good")
    assert survey.measure(0.5, "px", 1.0, "good")["verdict"] == "good"


LOST = {"behind": [0, 0, -5.0], "in the camera": [0, 0, 0.0], "in its plane": [5.0, 0, 1e-300], "far": [0, 0, 1e300]}


@pytest.mark.parametrize("where", LOST)
def test_measures_of_cameras_are_possible_wherever_their_points_are(where, body_clip):
    clip = replace(load_people(*body_clip)[0], points=np.tile(LOST[where], (200, 1)))
    facts = Sfm(verdict="moving", distortion={"max_shift_px": 0.0}, reprojection_px=0.5, median_triangulation_deg=2.0)
    found = survey.camera_measures(facts, clip)
    assert not impossible(found, clip.width, clip.height)
    ratio = found["baseline"]["value"]
    assert ratio is None or ratio >= 0, ratio


@pytest.fixture
def body_clip(tmp_path):
    """A tiny clip: the free body stands 3 m before a camera; its mask is its own silhouette."""
    from stages.formats.body_model import read_body_model, write_body_model
    from stages.formats.cameras import write_cameras
    from stages.formats.clip import load_clip
    from stages.formats.images import write_image, write_mask
    from stages.formats.points import write_points
    from stages.formats.poses import write_poses
    from stages.records import BodyPoses, Cameras

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
    clip = load_clip(sfm, smpl)
    for i, name in enumerate(names):
        (body,) = posed_bodies(clip.body_model, clip.body, [i])
        drawn = covered(body, clip.body_model.faces, clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
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
    assert not impossible(found, 96, 128)
    assert found["decisions"] == dict.fromkeys(EFFECTS | {"scene"}, False) and found["starts"] == {}
    assert found["effects"]["pose_refinement"]["value"] == pytest.approx(0)
    assert found["measures"]["camera_parallax"]["verdict"] == "unknown"
    unknown_ones = {name for name, effect in found["effects"].items() if effect["value"] is None}
    assert unknown_ones == EFFECTS - {"pose_refinement"}, "two frames of a camera that stands still show little"
    assert any("static camera" in event.get("text", "") for event in events)
    assert {"value", "unit", "threshold", "verdict", "frames"} == set(found["measures"]["coverage"])
    never = survey.Params(**dict.fromkeys(EFFECTS - {"lens"}, "never"))
    survey.run(Job(out), never, frames=tmp_path, masks=tmp_path, sfm=sfm, smpl=smpl)
    again = json.loads((out / "survey.json").read_text())
    assert all(again[part] == found[part] for part in ("decisions", "starts")), (
        "all that training reads: quiet is never"
    )


@pytest.mark.slow
def test_of_several_people_each_is_looked_at_alone_where_nobody_touches_them(tmp_path):
    made = company.make(tmp_path / "clip")
    people = load_people(made["sfm"], made["smpl"])
    one = survey.apart(people[1], people)
    beside = [touch(people[0].own_mask(i), people[1].own_mask(i)) for i in range(tiny.FRAMES)]
    assert any(beside) and not all(beside), "they hide each other in some frames"
    assert (one.body.confidence == np.where(beside, 0, people[1].body.confidence)).all()
    assert np.array_equal(one.mask(0), people[1].own_mask(0)) and not np.array_equal(one.mask(0), people[1].mask(0))
    low, high, none = (replace(unmeasured("", 1.0, ""), value=v, called_for=bool(v)) for v in (0.1, 0.4, None))
    assert survey.strongest([low, high]) is high and survey.strongest([none, low]) is low
    hidden, small = (
        compare(0.4, "of the frames", 0.5, ("seen", "hidden")),
        compare(30.0, "px", 48.0, ("large", "small")),
    )
    assert survey.strongest([small, hidden]) is hidden, "the nearest to its limit, whatever the unit"
