"""The smpl stage on a made clip: poses imported from other programs' files, poses estimated, and clear refusals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages import smpl
from stages.avatar.body.rotations import rotvec_from_matrix
from stages.avatar.body.smpl import Body
from stages.avatar.body.smpl_rest import smpl_rest
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.avatar.motion.placing import Soles
from stages.contract import Job, StageError
from stages.estimators.bodyfit import reporting
from stages.estimators.bodyfit.evidence import STAND_INS, model_landmarks
from stages.estimators.bodyfit.floor import floor_of
from stages.estimators.bodyfit.inputs import of_person, read_inputs, touch
from stages.estimators.bodyfit.resting import carry_over
from stages.estimators.bodyfit.seen_landmarks import follow
from stages.estimators.person import blazepose
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import write_cameras
from stages.formats.facts import Listing, read_facts
from stages.formats.given_fits.record import SMPLX_PELVIS
from stages.formats.ground import read_ground
from stages.formats.images import write_image, write_mask
from stages.formats.landmarks import NAMES, write_landmarks
from stages.formats.points import write_points
from stages.formats.poses import read_poses
from stages.gestures import FACE_NAMES
from stages.records import BodyPoses
from tests.made import bodyfit_clips, landmark_files
from tests.made.possible import impossible
from tests.made.said import any_holds, holds
from tests.made.smplx import made_smplx

MODEL = read_body_model()
WIDTH, HEIGHT = bodyfit_clips.WIDTH, bodyfit_clips.HEIGHT
LIMBS = [4, 5, 7, 8, 16, 17, 18, 19, 20, 21]
ASIDE = 1.3


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A clip of 16 frames as the frames and sfm stages leave it: (clip, frames folder, sfm folder)."""
    clip = bodyfit_clips.make(MODEL, frames=16, betas=(0.0,))
    root = tmp_path_factory.mktemp("clip")
    frames, sfm = root / "frames", root / "sfm"
    for folder in (frames, sfm / "images", sfm / "masks"):
        folder.mkdir(parents=True)
    listing = [
        {"name": n, "index": int(n), "time_s": float(t)} for n, t in zip(clip.cameras.names, clip.times, strict=True)
    ]
    video = {"path": "clip.mp4", "frames": len(listing)}
    (frames / "frames.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "video": video, "frames": listing})
    )
    (sfm / "sfm.json").write_text(json.dumps({"verdict": "moving", "distortion": {"max_shift_px": 0.0}}))
    write_cameras(sfm / "cameras.npz", clip.cameras)
    write_points(sfm / "points.ply", clip.points, np.zeros((len(clip.points), 3), np.uint8))
    blank = np.zeros((bodyfit_clips.HEIGHT, bodyfit_clips.WIDTH, 3), np.uint8)
    for name, mask in zip(clip.cameras.names, clip.masks(), strict=True):
        write_image(sfm / "images" / f"{name}.png", blank)
        write_mask(sfm / "masks" / f"{name}.png", mask)
    return clip, frames, sfm


def run(folder, frames, sfm, settings=None, **sources):
    said = []
    folder.mkdir(exist_ok=True)
    smpl.run(Job(out=folder, emit=said.append), smpl.Params(**settings or {}), frames=frames, sfm=sfm, **sources)
    facts = json.loads((folder / "smpl.json").read_text())
    assert not impossible(facts, bodyfit_clips.WIDTH, bodyfit_clips.HEIGHT)
    return read_poses(folder / "body.npz"), facts, said


def test_what_is_not_finite_is_not_known():
    assert [reporting.known(value) for value in (0.12345, np.nan, np.inf, -np.inf)] == [0.1235, None, None, None]
    assert reporting.mean_known(np.array([1.0, np.nan, np.inf, 3.0])) == 2
    assert reporting.mean_known(np.array([np.inf])) is None


def world_joints(poses):
    f32 = lambda a: torch.tensor(a, dtype=torch.float32)  # noqa: E731
    parts = (f32(a) for a in (poses.betas, poses.global_orient, poses.body_pose, poses.transl))
    return Body(MODEL)(*parts)[1].numpy()


def camera_fit(clip):
    """The true motion as a program that knows no world writes it: per frame, in the camera."""
    yaw, pose = bodyfit_clips.motion(clip.times)
    zero = torch.zeros(len(yaw), 3)
    rest = Body(MODEL)(torch.zeros(10), zero, torch.tensor(pose, dtype=torch.float32), zero)[1].numpy()
    views = clip.cameras.viewmats.copy()
    views[:, :3, 3] *= clip.scale
    joints = clip.joints @ views[:, :3, :3].mT + views[:, None, :3, 3]
    orient, transl = [], []
    for a, b in zip(rest, joints, strict=True):
        from tests.made.worlds import umeyama

        _, turn, _ = umeyama(a.astype(float), b)
        orient.append(rotvec_from_matrix(torch.tensor(turn)).numpy())
        transl.append(b[0] - a[0])
    arrays = {"betas": np.zeros(10), "global_orient": np.array(orient), "body_pose": pose, "transl": np.array(transl)}
    return arrays | {"body": np.array(MODEL.name)}


def in_sfm(clip, fit):
    """The same in the SfM frame, its unit seen by each frame as `scale` says."""
    pelvis, views = (MODEL.J_regressor @ MODEL.v_template)[0].astype(float), clip.cameras.viewmats
    back = Rotation.from_matrix(views[:, :3, :3]).inv()
    orient = (back * Rotation.from_rotvec(fit["global_orient"])).as_rotvec()
    away = fit["scale"][:, None] * (back.apply(pelvis + fit["transl"]) - pelvis)
    return fit | {"global_orient": orient, "transl": away - back.apply(views[:, :3, 3])}


@pytest.mark.slow
def test_i05_j05_a_fit_in_camera_frames_lands_in_the_world_with_one_scale(folders, tmp_path):
    clip, frames, sfm = folders
    fit = camera_fit(clip)
    kept = np.delete(np.arange(16), [4, 5])
    rows = {key: value if key in ("betas", "body") else value[kept] for key, value in fit.items()}
    np.savez(tmp_path / "fit.npz", names=np.array(clip.cameras.names)[kept], **rows)
    rows = [f"{2 * t},{t}" for t in np.linspace(0, 0.9, 40)]
    (tmp_path / "take.csv").write_text("\n".join(["time,jawOpen", *rows]))
    given = {"smpl_fit": tmp_path / "fit.npz", "face": tmp_path / "take.csv"}
    poses, facts, said = run(tmp_path / "out", frames, sfm, **given)
    opened = poses.face[:, FACE_NAMES.index("jawOpen")]
    np.testing.assert_allclose(opened, np.minimum(clip.times / 2, 0.9), atol=1e-6)
    assert opened.max() > 0.3 and np.count_nonzero(poses.face.any(0)) == 1
    assert poses.world_from_sfm == pytest.approx(clip.scale, rel=0.03)
    error = np.linalg.norm(world_joints(poses) * clip.scale / poses.world_from_sfm - clip.joints, axis=-1)
    assert error[kept].mean() < 0.05
    assert np.flatnonzero(poses.confidence == 0).tolist() == [4, 5]
    assert facts["doubtful"] == [clip.cameras.names[4], clip.cameras.names[5]]
    assert facts["mean_iou"] > 0.9
    ground, floor = read_ground(tmp_path / "out" / "ground.json"), clip.points[:400] * poses.world_from_sfm
    assert np.abs((floor - ground.point) @ ground.up).mean() < 0.012 and ground.points > 250
    assert ground.metres == poses.world_from_sfm and ground.height_error < 0.01
    assert any(holds(event.get("text", ""), "floor", "points of the scene") for event in said)
    assert not (tmp_path / "out" / "landmarks.npz").exists()
    assert (tmp_path / "out" / "body_model.npz").exists()


def test_where_the_scene_shows_no_floor_it_is_guessed_and_that_is_said(folders, tmp_path):
    clip, frames, sfm = folders
    bare = tmp_path / "sfm"
    bare.mkdir()
    for path in sfm.iterdir():
        (bare / path.name).symlink_to(path)
    (bare / "points.ply").unlink()
    write_points(bare / "points.ply", clip.points[400:], np.zeros((len(clip.points) - 400, 3), np.uint8))
    fit = camera_fit(clip) | {"scale": np.full(16, bodyfit_clips.SFM_FROM_WORLD)}
    np.savez(tmp_path / "fit.npz", names=np.array(clip.cameras.names), **in_sfm(clip, fit))
    _, _, said = run(tmp_path / "out", frames, bare, smpl_fit=tmp_path / "fit.npz")
    ground, floor = read_ground(tmp_path / "out" / "ground.json"), clip.points[:400] * clip.scale
    assert ground.points == 0 and "guessed from the bodies" in ground.how
    assert np.abs((floor - ground.point) @ ground.up).mean() < 0.08
    warned = [event["text"] for event in said if event["event"] == "warning"]
    assert any_holds(warned, "no floor", "guessed")


@pytest.mark.slow
def test_i05_j02_a_fit_in_sfm_units_keeps_its_pictures_at_one_scale(folders, tmp_path):
    clip, frames, sfm = folders
    per_frame = bodyfit_clips.SFM_FROM_WORLD * np.linspace(0.95, 1.05, 16)  # depth guesses that waver
    arrays = in_sfm(clip, camera_fit(clip) | {"scale": per_frame})
    np.savez(tmp_path / "fit.npz", names=np.array(clip.cameras.names), **arrays)
    poses, facts, said = run(tmp_path / "out", frames, sfm, smpl_fit=tmp_path / "fit.npz")
    assert poses.world_from_sfm == pytest.approx(clip.scale, rel=1e-6)
    np.testing.assert_allclose(world_joints(poses), clip.joints, atol=2e-3)
    assert any(event["event"] == "warning" and "scale varies" in event["text"] for event in said)
    assert facts["mean_iou"] > 0.95


@pytest.mark.slow
def test_a_given_height_makes_body_floor_and_world_larger_and_nothing_else(folders, tmp_path):
    clip, frames, sfm = folders
    fit = camera_fit(clip) | {"scale": np.full(16, bodyfit_clips.SFM_FROM_WORLD)}
    np.savez(tmp_path / "fit.npz", names=np.array(clip.cameras.names), **in_sfm(clip, fit))
    out, tall = tmp_path / "out", float(np.ptp(MODEL.v_template[:, 1]))
    poses, facts, said = run(out, frames, sfm, {"height": 1.2 * tall}, smpl_fit=tmp_path / "fit.npz")
    assert poses.world_from_sfm == pytest.approx(1.2 * clip.scale, rel=1e-6)
    sized = read_body_model(out / "body_model.npz")
    parts = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    joints = Body(sized)(*(torch.tensor(part, dtype=torch.float32) for part in parts))[1].numpy()
    np.testing.assert_allclose(joints, 1.2 * clip.joints, atol=3e-3)
    ground = read_ground(out / "ground.json")
    assert ground.metres == poses.world_from_sfm and ground.points > 250
    assert facts["stature_m"] == pytest.approx(1.2 * tall, abs=1e-3) and facts["mean_iou"] > 0.95
    assert facts["metre"]["times_fit"] == pytest.approx(1.2) and facts["metre"]["stature_of_fit_m"] == pytest.approx(
        tall, abs=1e-3
    )
    assert any(holds(event.get("text", ""), f"{1.2 * tall:.2f} m of person 1", f"{tall:.2f} m") for event in said)
    assert not any(holds(event.get("text", ""), "unusual shape") for event in said)


def as_smpl(fit):
    """global_orient, body_pose and pelvis in each camera with which SMPL's body stands where the free body stands."""
    rest = (MODEL.J_regressor @ MODEL.v_template).astype(float)
    orient, pose, way = carry_over(fit["global_orient"], fit["body_pose"], rest, smpl_rest())
    return orient, pose, fit["transl"] + rest[0] + way


def two_in_easymocap(clip, folder):
    """Write a fit of two who do the same, the second where the clip's person is, the first ASIDE m to the right of the camera."""
    orient, pose, pelvis = as_smpl(camera_fit(clip))
    folder.mkdir()
    for i, name in enumerate(clip.cameras.names):
        turned = Rotation.from_rotvec(orient[i]).apply(smpl_rest()[0])
        people = []
        for who, aside in ((0, ASIDE), (1, 0.0)):
            place = pelvis[i] - turned + [aside, 0, 0]
            row = {"Rh": orient[i], "Th": place, "poses": np.append([0, 0, 0], pose[i])}
            people.append({"id": who, "shapes": [[0.0] * 10], **{key: [value.tolist()] for key, value in row.items()}})
        (folder / f"{name}.json").write_text(json.dumps(people))


@pytest.mark.slow
def test_the_body_of_a_gvhmr_file_fills_the_outlines(folders, tmp_path):
    clip, frames, sfm = folders
    orient, pose, pelvis = as_smpl(camera_fit(clip))
    person = {"global_orient": orient, "body_pose": pose[:, :63], "transl": pelvis - SMPLX_PELVIS}
    person |= {"betas": np.zeros((len(orient), 10))}
    content = {"smpl_params_incam": {key: torch.tensor(value).float() for key, value in person.items()}}
    torch.save(content | {"K_fullimg": torch.tensor(clip.cameras.Ks).float()}, tmp_path / "hmr4d_results.pt")
    poses, facts, _ = run(tmp_path / "out", frames, sfm, smpl_fit=tmp_path / "hmr4d_results.pt")
    error = np.linalg.norm(world_joints(poses) * clip.scale / poses.world_from_sfm - clip.joints, axis=-1)[:, LIMBS]
    assert facts["mean_iou"] > 0.85 and facts["doubtful"] == [] and error.mean() < 0.04


@pytest.mark.slow
def test_of_two_people_in_a_folder_of_easymocap_the_masked_one_is_taken(folders, tmp_path):
    clip, frames, sfm = folders
    two_in_easymocap(clip, tmp_path / "fit")
    poses, facts, said = run(tmp_path / "out", frames, sfm, smpl_fit=tmp_path / "fit")
    error = np.linalg.norm(world_joints(poses) * clip.scale / poses.world_from_sfm - clip.joints, axis=-1)
    assert error.mean() < 0.04 and facts["mean_iou"] > 0.85
    assert facts["person"] == "1" and facts["overlap"] > 0.8 and facts["people"]["0"] < 0.3
    texts = [event["text"] for event in said if event["event"] in ("note", "warning")]
    assert any_holds(texts, "person 1", "EasyMocap", "overlap")
    assert any_holds(texts, "EasyMocap", "SMPL", "free body", "body-model")


@pytest.mark.slow
def test_a_fit_of_somebody_else_is_refused_and_a_doubtful_one_is_said(folders, tmp_path):
    clip, frames, sfm = folders
    fit = camera_fit(clip) | {"names": np.array(clip.cameras.names)}
    np.savez(tmp_path / "far.npz", **fit | {"transl": fit["transl"] + [3.0, 0, 0]})
    with pytest.raises(StageError, match="masks"):
        run(tmp_path / "out", frames, sfm, smpl_fit=tmp_path / "far.npz")
    np.savez(tmp_path / "near.npz", **fit | {"transl": fit["transl"] + [0.35, 0, 0]})
    _, facts, said = run(tmp_path / "out", frames, sfm, smpl_fit=tmp_path / "near.npz")
    assert 0.1 < facts["overlap"] < 0.5
    assert any(holds(event.get("text", ""), "overlaps", "masks", "only") for event in said)


@pytest.mark.slow
def test_j05_landmarks_become_poses_and_frames_without_a_person_are_named(folders, tmp_path, monkeypatch):
    bodyfit_clips.take_steps(monkeypatch, 50, 30, 60)
    clip, frames, sfm = folders
    monkeypatch.setattr(blazepose.BlazePose, "__init__", lambda self: None)
    monkeypatch.setattr(blazepose.BlazePose, "sightings", lambda self, images, among: [])
    monkeypatch.setattr(blazepose.BlazePose, "track", lambda self, images, start: clip.tracks)
    poses, facts, _ = run(tmp_path / "out", frames, sfm)
    error = np.linalg.norm(world_joints(poses) * clip.scale / poses.world_from_sfm - clip.joints, axis=-1)
    assert error.mean() < 0.05
    assert facts["not_seen"] == [clip.cameras.names[i] for i in (13, 14)]
    assert (poses.confidence[[13, 14]] == 0).all()
    assert facts["mean_iou"] > 0.85 and facts["mean_error_px"] < 15
    with np.load(tmp_path / "out" / "landmarks.npz") as landmarks:
        assert landmarks["xy"].shape == (16, 33, 2) and (landmarks["visibility"][13] == 0).all()


@pytest.mark.slow
def test_landmarks_of_another_program_take_blazeposes_place(folders, tmp_path, monkeypatch):
    bodyfit_clips.take_steps(monkeypatch, 50, 30, 60)
    clip, frames, sfm = folders
    monkeypatch.setattr(blazepose.BlazePose, "__init__", lambda self: None)
    monkeypatch.setattr(blazepose.BlazePose, "sightings", lambda self, images, among: [])
    monkeypatch.setattr(blazepose.BlazePose, "track", lambda self, images, start: clip.tracks)
    (names, regressor), views = model_landmarks(MODEL), rescale_viewmats(clip.cameras.viewmats, clip.scale)
    true, _ = project(regressor @ clip.vertices, views, clip.cameras.Ks)
    points = np.full((16, 33, 2), np.nan)
    for k, name in enumerate(names):
        points[:, [NAMES.index(one) for one in STAND_INS.get(name, (name,))]] = true[:, k, None]
    path = landmark_files.openpose(tmp_path / "keypoints", points * [1, -1] + [0, HEIGHT])
    poses, facts, said = run(tmp_path / "out", frames, sfm, landmarks=path)
    error = np.linalg.norm(world_joints(poses) * clip.scale / poses.world_from_sfm - clip.joints, axis=-1)
    assert error.mean() < 0.05 and facts["mean_error_px"] < 6 and facts["not_seen"] == []
    assert facts["source"] == "keypoints" and facts["landmarks"]["skeleton"] == "OpenPose BODY_25"
    texts = [event["text"] for event in said if event["event"] in ("note", "warning")]
    assert any_holds(texts, "keypoints", "y") and any_holds(texts, "keypoints", "16 of 16")


def test_the_landmarks_by_which_masks_were_made_are_taken_and_nobody_looks_again(folders, tmp_path, monkeypatch):
    clip = folders[0]
    names, tracks = clip.cameras.names, clip.tracks

    def looks_again(self):
        raise AssertionError("BlazePose looks again")

    monkeypatch.setattr(blazepose.BlazePose, "__init__", looks_again)
    known = SimpleNamespace(cameras=clip.cameras, others=())
    write_landmarks(tmp_path / "landmarks.npz", [*names[::-1], "one more"], [*tracks[::-1], tracks[0]])
    taken = follow(tmp_path, known, [])
    assert [one is None for one in taken] == [one is None for one in tracks]
    assert all((a.xy == b.xy).all() for a, b in zip(taken, tracks) if b is not None)
    with pytest.raises(AssertionError, match="looks again"):
        follow(tmp_path / "without", known, [])


def test_j05_nobody_in_the_clip_is_an_error(folders, tmp_path, monkeypatch):
    _, frames, sfm = folders
    monkeypatch.setattr(blazepose.BlazePose, "__init__", lambda self: None)
    monkeypatch.setattr(blazepose.BlazePose, "sightings", lambda self, images, among: [])
    monkeypatch.setattr(blazepose.BlazePose, "track", lambda self, images, start: [None] * 16)
    with pytest.raises(StageError, match="0 of 16 frames") as error:
        run(tmp_path / "out", frames, sfm)
    assert "--smpl-fit" in error.value.hint


def test_of_several_people_the_one_without_poses_is_named(folders, tmp_path, monkeypatch):
    _, frames, sfm = folders
    (tmp_path / "sfm").mkdir()
    for path in sfm.iterdir():
        (tmp_path / "sfm" / path.name).symlink_to(path)
    for k in (1, 2):
        (tmp_path / "sfm" / "people" / str(k)).mkdir(parents=True)
        (tmp_path / "sfm" / "people" / str(k) / "masks").symlink_to(sfm / "masks")
    monkeypatch.setattr(blazepose.BlazePose, "__init__", lambda self: None)
    monkeypatch.setattr("stages.estimators.person.identities.track_masked", lambda *given: [None] * 16)
    inputs = read_inputs(read_facts(frames / "frames.json", Listing), sfm, None)
    second = of_person(inputs, tmp_path / "sfm", 2)
    with pytest.raises(StageError, match=r"person 2 .* 0 of 16 frames") as error:
        smpl.estimate_poses(Job(out=tmp_path), tmp_path, tmp_path / "sfm", second, None, 1.0)
    assert "--person ID" in error.value.hint


def test_a_plane_that_is_not_what_the_person_stands_on_is_said(tmp_path):
    said = []
    scale = {"initial": 0.5, "how": "standing feet", "floor_refused": 1.1, "floor_spread": 0.08}
    reporting.warn_of_scale(Job(out=tmp_path, emit=said.append), scale)
    (text,) = (event["text"] for event in said)
    assert holds(text, "plane") and holds(text, "1.1 m") and holds(text, 0.5)


def test_a_floor_that_slopes_is_said_with_its_degrees(tmp_path):
    said = []
    scale = {"initial": 0.5, "how": "the body stands on the floor's SfM points", "floor_slope_degrees": 11.6}
    reporting.warn_of_scale(Job(out=tmp_path, emit=said.append), scale)
    (text,) = (event["text"] for event in said)
    assert holds(text, "12 degrees")


def test_one_floor_is_found_under_two_people_whose_soles_have_other_numbers_of_points(folders):
    clip, frames, sfm = folders
    inputs, fit = read_inputs(read_facts(frames / "frames.json", Listing), sfm, None), camera_fit(clip)
    back = Rotation.from_matrix(clip.cameras.viewmats[:, :3, :3]).inv()
    orient = (back * Rotation.from_rotvec(fit["global_orient"])).as_rotvec()
    pelvis = (MODEL.J_regressor @ MODEL.v_template)[0].astype(float)
    known = orient, fit["body_pose"], clip.joints[:, 0] - pelvis, np.ones(len(orient))
    one = BodyPoses(clip.cameras.names, np.zeros(10), *known, world_from_sfm=clip.scale)
    other = replace(one, betas=np.eye(10)[0] * 2)
    assert len({smpl_soles(person).shape for person in (one, other)}) == 2, "or it shows nothing"
    alone, both = floor_of(inputs, (MODEL, one)), floor_of(inputs, (MODEL, one), (MODEL, other))
    np.testing.assert_allclose(both.up, alone.up, atol=0.02)
    assert abs((both.point - alone.point) @ alone.up) < 0.02 and alone.points and both.points
    about = (Rotation.from_rotvec(orient) * Rotation.from_euler("y", 180, degrees=True)).as_rotvec()
    both = floor_of(inputs, (MODEL, one), (MODEL, replace(other, global_orient=about)))
    assert both.ahead @ alone.ahead > 0.99, "the first person's way, whichever way another looks"


def smpl_soles(poses):
    return Soles.of_model(MODEL, poses.betas).at_rest()[0]


@pytest.mark.slow
def test_of_two_masked_people_each_gets_their_own_of_a_fit_in_one_world(folders, tmp_path):
    clip, frames, sfm = folders
    two_in_easymocap(clip, tmp_path / "fit")
    shutil.copytree(sfm, tmp_path / "sfm")
    beside = replace(clip, vertices=clip.vertices + ASIDE * clip.cameras.viewmats[:, None, 0, :3])
    for k, person in ((1, clip), (2, beside)):
        (tmp_path / "sfm" / "people" / str(k) / "masks").mkdir(parents=True)
        for name, mask in zip(clip.cameras.names, person.masks(), strict=True):
            write_mask(tmp_path / "sfm" / "people" / str(k) / "masks" / f"{name}.png", mask)
    first, facts, said = run(tmp_path / "out", frames, tmp_path / "sfm", smpl_fit=tmp_path / "fit")
    second = read_poses(tmp_path / "out" / "people" / "2" / "body.npz")
    theirs = json.loads((tmp_path / "out" / "people" / "2" / "smpl.json").read_text())
    assert facts["person"] == "1" and theirs["person"] == "0" and theirs["mean_iou"] > 0.5
    assert second.world_from_sfm == first.world_from_sfm and theirs["scale"]["how"].startswith("that of the first")
    apart = world_joints(second)[:, 0] - world_joints(first)[:, 0]
    np.testing.assert_allclose(apart, ASIDE * clip.cameras.viewmats[:, 0, :3], atol=0.05)
    assert (
        read_ground(tmp_path / "out" / "ground.json").points
        and not (tmp_path / "out" / "people" / "2" / "ground.json").exists()
    )
    assert [event["text"] for event in said if event.get("text", "").startswith("person 2:")]


def test_a_fit_that_has_one_person_for_two_of_the_masks_is_refused(tmp_path):
    poses = BodyPoses(("0",), np.zeros(10), np.zeros((1, 3)), np.zeros((1, 69)), np.zeros((1, 3)), np.ones(1))
    smpl.check_apart([poses, replace(poses, transl=poses.transl + 1)], tmp_path / "fit.npz")
    smpl.check_apart([poses, poses], None)
    with pytest.raises(StageError, match=r"fit\.npz .*one person.*1 and 2"):
        smpl.check_apart([poses, poses], tmp_path / "fit.npz")


@pytest.mark.slow
def test_where_a_body_has_fingers_the_network_for_them_is_looked_for_before_any_stage_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    np.savez(tmp_path / "SMPLX.npz", **made_smplx())
    write_body_model(tmp_path / "SMPL.npz", replace(read_body_model(), name="SMPL"))
    check = partial(smpl.check, smpl.Params(), video=tmp_path / "clip.mp4")
    check(body_model=tmp_path / "SMPL.npz")
    for own in (None, tmp_path / "SMPLX.npz"):
        with pytest.raises(StageError, match="hand_landmark_full"):
            check(body_model=own)


def test_people_touch_where_their_masks_nearly_meet():
    mask, other = np.zeros((2, 40, 200), np.uint8)
    mask[10:30, 20:60], other[10:30, 64:90] = 255, 255
    assert not touch(mask, other)
    other[10:30, 60:64] = 255
    assert touch(mask, other) and touch(other, mask)
