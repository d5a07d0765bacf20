"""The family of clips against itself: each shot shows what its row says, and the measures measure it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.joints import ANKLES, FEET, HEAD
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import camera_centers, pinhole, project
from stages.estimators.bodyfit.balance import mass_and_soles
from stages.formats.body_model import read_body_model
from stages.records import BodyPoses, Cameras
from tests.made.family import film
from tests.made.family.evidence import Truth
from tests.made.family.measures import measured, soles_of, stature
from tests.made.family.motions import MOTIONS
from tests.made.family.shoes import shoes
from tests.made.family.table import FAMILY, FPS, LONG, SHORT, TURNS, shots
from tests.made.synthetic.cloth import worn
from tests.made.truth import joints_of

OWN = [shot for shot in FAMILY if "." not in shot.motion]
TURN_KINDS = {"slow": "turn", "fast": "turn_fast", "stopping": "turn_stopping", "fro": "turn_fro"}
CUT = ("kneel_cut", "reach_cut")


def made(shot):
    """The true body model, poses and cameras of a shot, without its pictures."""
    rng = np.random.default_rng(list(shot.name.encode()))
    model, betas = film.person(shot, rng)
    motion = film.moved(shot, Body(model, dtype=torch.float64), model, betas, None)
    viewmats = film.path(shot, motion[2], rng)
    width, height = (LONG, SHORT) if shot.wide else (SHORT, LONG)
    names = tuple(f"{i:06d}" for i in range(shot.frames))
    Ks = np.tile(pinhole(shot.lens / 36 * LONG, width, height), (shot.frames, 1, 1))
    return model, BodyPoses(names, betas, *motion, np.ones(shot.frames)), Cameras(names, viewmats, Ks, width, height)


def test_both_halves_hold_every_kind_and_the_family_spans_what_the_issue_asks_for():
    halves = [shots("setting"), shots("asked")]
    assert [len(half) for half in halves] == [16, 16]
    assert {shot.name for shot in FAMILY} == {shot.name for half in halves for shot in half}
    kinds = (
        "turn",
        "walk_away",
        "walk_toward",
        "walk_across",
        "squat",
        "bend",
        "sit",
        "kneel",
        "reach",
        "lie",
        "dance",
    )
    for half in halves:
        moved = " ".join(shot.motion for shot in half)
        assert all(kind in moved for kind in kinds)
        assert any("jump" in shot.motion for shot in half)
        assert {"arc", "sideways", "forward", "jitter", "still"} <= {shot.path for shot in half} | {"little"}
        assert sum(shot.path == "still" for shot in half) == 1
        assert (
            any(shot.child for shot in half)
            and any(shot.clothing for shot in half)
            and any(shot.boxes for shot in half)
            and {"skirt", "coat", "bag", "ponytail"} == {name for shot in half for name in shot.wears}
            and sum(shot.sole > 0 for shot in half) == 4
        )
        assert any(shot.name in CUT for shot in half)
    pitches = [np.degrees(np.arctan2(shot.height - shot.aim, shot.distance)) for shot in FAMILY]
    assert min(pitches) < -10 and 35 < max(pitches) < 42
    assert min(shot.height for shot in FAMILY) == 0.4 and max(shot.height for shot in FAMILY) == 2.6
    with pytest.raises(ValueError, match="no clip nobody"):
        shots(None, ("nobody",))


def test_turns_are_of_every_kind_in_either_half_at_20_to_60_frames_a_second():
    for half in ("setting", "asked"):
        own = [shot for shot in TURNS if shot.half == half]
        assert len(own) == 6 and {shot.motion for shot in own} == set(TURN_KINDS.values())
        assert all(shot.motion == TURN_KINDS[shot.name.partition("_")[0]] for shot in own)
        assert {shot.plain for shot in own} == {True, False} and any("hair" in shot.wears for shot in own)
        assert {20, 60} <= {shot.fps for shot in own} and all(20 <= shot.fps <= 60 for shot in own)
    yaw = {name: np.degrees(MOTIONS[name](np.linspace(0, 3, 91)).yaw) for name in TURN_KINDS.values()}
    assert [np.ptp(yaw[name]) for name in TURN_KINDS.values()] == pytest.approx([348, 1080, 360, 110], abs=1)
    assert np.ptp(yaw["turn_stopping"][[18, 29]]) == 0, "stops"


@pytest.mark.slow
@pytest.mark.parametrize("shot", OWN, ids=lambda shot: shot.name)
def test_a_shot_shows_a_person_on_the_floor_whose_standing_feet_stand(shot):
    model, poses, cameras = made(shot)
    assert stature(model, poses) == pytest.approx(shot.stature, abs=2e-3)
    assert abs(poses.betas).max() < 2.5
    soles = soles_of(model, poses)
    low = soles[..., 1].min((1, 2)) - shot.sole
    assert low.min() > -1e-3, "nothing sinks into the floor"
    if shot.motion == "jump":
        assert low.max() > 0.1, "flies"
        assert np.median(low) < 0.03
    else:
        assert low.max() < 0.12 and np.median(low) < 0.03
    if shot.motion in MOTIONS:
        planned = MOTIONS[shot.motion](np.arange(shot.frames) / shot.fps)
        flat = np.maximum(planned.feet[..., 1], planned.heels) + planned.flight[:, None] < 1e-6
        stands = flat[1:] & flat[:-1]
        assert stands.any()
        moved = np.linalg.norm(np.diff(soles.mean(2), axis=0)[..., [0, 2]], axis=-1)
        assert moved[stands].max() < 0.004, "a foot that stands does not slide"
    pixels, depths = project(joints_of(poses, model), cameras.viewmats, cameras.Ks)
    assert depths.min() > 0.5
    inside = ((pixels > 0) & (pixels < [cameras.width, cameras.height])).all(-1)
    if shot.name in CUT:
        assert not inside[:, ANKLES].all() and inside[:, HEAD].mean() > 0.5
    else:
        assert inside.mean() > 0.99


@pytest.mark.slow
def test_shoes_stand_on_the_floor_with_both_feet_as_thick_as_their_soles():
    (shot,) = shots(names=("shod_reach",))
    model, poses, _ = made(shot)
    garment = shoes(model, poses.betas, shot.sole)
    moved = poses.global_orient, poses.body_pose, poses.transl
    (places,) = worn(
        [garment.cloth], Body(model, dtype=torch.float64), model.faces.astype(np.int64), poses.betas, moved, shot.fps
    )
    for side in (places[:, garment.cloth.places[:, 0] > 0], places[:, garment.cloth.places[:, 0] < 0]):
        assert side.shape[1] > 100
        assert side[0, :, 1].min() == pytest.approx(0, abs=1e-3), "before heels rise"
    np.testing.assert_allclose(places[..., 1].min(1), 0, atol=1e-3)
    assert soles_of(model, poses)[0, ..., 1].min() == pytest.approx(shot.sole, abs=1e-3)
    assert len(garment.faces) > 200 and garment.paint(garment.chart[:, 0]).shape == (len(garment.faces), 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slope_toward", "slope_side", "slope_down"])
def test_on_a_slope_feet_are_on_the_floor_and_person_and_camera_upright(name):
    (shot,) = shots(names=(name,))
    model, poses, cameras = made(shot)
    assert np.median(soles_of(model, poses)[..., 1].min((1, 2))) < 0.03
    up = film.upright(shot)[:, 1]
    assert np.degrees(np.arccos(up[1])) == pytest.approx(abs(shot.slope))
    assert np.degrees(abs(np.arcsin(cameras.viewmats[:, 0, :3] @ up))).max() < 1.5
    mass, soles = (part.numpy() for part in mass_and_soles(torch.from_numpy(joints_of(poses, model)).float()))
    bodies = (mass - soles.mean(1)).mean(0)
    assert np.degrees(np.arccos(bodies @ up / np.linalg.norm(bodies))) < 6


@pytest.mark.slow
def test_who_rides_stands_as_who_does_not_and_goes_along_the_floor():
    still, rides = (made(shots(names=(name,))[0]) for name in ("ride_none", "ride_pan"))
    assert still[1].body_pose.shape == rides[1].body_pose.shape
    way = np.diff(joints_of(rides[1], rides[0])[:, FEET], axis=0) * FPS
    np.testing.assert_allclose(way.mean((0, 1)), [1.5, 0, 0], atol=0.03)
    assert np.median(soles_of(rides[0], rides[1])[..., 1].min((1, 2))) < 0.03


@pytest.mark.slow
def test_what_is_off_is_told_with_its_sign():
    """A true body pushed toward the camera, leant toward it, made taller: each column says what was done."""
    model, poses, cameras = made(shots(names=("reach_low",))[0])
    truth = Truth(model, poses, cameras)
    none = measured(poses, model, cameras, True, truth)
    assert none["world"] < 1e-6 and abs(none["lean"]) < 1e-6 and none["slide"] < 1e-6 and abs(none["scale%"]) < 1e-9
    toward = camera_centers(cameras.viewmats) - joints_of(poses, model)[:, 0]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    near = measured(replace(poses, transl=poses.transl + 0.1 * toward), model, cameras, True, truth)
    assert near["along"] == pytest.approx(-10) and near["across"] == pytest.approx(0, abs=1e-6)
    assert near["world"] == pytest.approx(10) and near["pelvis"] == pytest.approx(0, abs=1e-6)
    axis = np.cross([0, 1, 0], toward * [1, 0, 1])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    about = Rotation.from_rotvec(poses.global_orient) * Rotation.from_rotvec([0, np.radians(100), 0])
    faced = poses.global_orient.copy()
    faced[[3, 4]] = about.as_rotvec()[[3, 4]]
    doubted, one = np.ones(len(poses)), replace(poses, global_orient=faced)
    assert none["heading"] < 1e-5
    assert measured(one, model, cameras, True, truth)["heading"] == pytest.approx(100)
    doubted[[3, 4]] = 0
    assert measured(replace(one, confidence=doubted), model, cameras, True, truth)["heading"] < 1e-5
    leant = Rotation.from_rotvec(np.radians(8) * axis) * Rotation.from_rotvec(poses.global_orient)
    bowed = measured(replace(poses, global_orient=leant.as_rotvec()), model, cameras, True, truth)
    assert bowed["lean"] == pytest.approx(8, abs=0.2)
    assert bowed["head-ft"] < -10 and bowed["procr"] == pytest.approx(0, abs=1e-4)
    doubled = replace(cameras, viewmats=cameras.viewmats * np.array([1, 1, 1, 2])[:, None].T)
    scaled = measured(replace(poses, world_from_sfm=0.55), model, doubled, True, truth)
    assert scaled["scale%"] == pytest.approx(10) and scaled["tall%"] == pytest.approx(100 / 1.1 - 100)


@pytest.mark.slow
def test_a_child_has_a_larger_head_and_not_other_shapes():
    child, adult = (
        film.person(shots(names=(name,))[0], np.random.default_rng(0)) for name in ("squat_child", "turn_level")
    )
    free = read_body_model()
    head = free.lbs_weights[:, 15] > 0.99
    sizes = [np.ptp(model.v_template[head, 1]) / np.ptp(model.v_template[:, 1]) for model, _ in (child, adult)]
    assert sizes[0] == pytest.approx(sizes[1] * film.HEAD, rel=0.05)


@pytest.mark.slow
def test_a_true_body_is_measured_as_true_where_the_camera_hardly_travels():
    """The cameras' own centres, 1 mm off on a way of 5 mm, would put it 70 cm away."""
    shot = shots(names=("toward_little",))[0]
    model, poses, cameras = made(shot)
    placed, _, to_truth = film.as_sfm_has_it(shot, cameras, np.zeros((1, 3)), np.random.default_rng(0))
    turn = Rotation.from_matrix(to_truth.R.T)
    joint = joints_of(replace(poses, transl=0 * poses.transl), model)[:, 0]  # about which the body turns
    there = replace(
        poses,
        global_orient=(turn * Rotation.from_rotvec(poses.global_orient)).as_rotvec(),
        transl=(joint + poses.transl - to_truth.t) @ to_truth.R - joint,
        world_from_sfm=to_truth.scale,
    )
    by_cameras = measured(there, model, placed, True, Truth(model, poses, cameras))
    known = measured(there, model, placed, True, Truth(model, poses, cameras, (), to_truth))
    assert by_cameras["world"] > 20
    assert known["world"] < 1e-6 and abs(known["along"]) < 1e-6 and abs(known["tall%"]) < 1e-9
