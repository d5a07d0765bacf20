"""Every tool's file, made from the synthetic clip's truth, comes back where and how the body was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.estimators.bodyfit.frames import join_frames
from stages.estimators.bodyfit.given import import_fit
from stages.estimators.bodyfit.person import choose_person
from stages.estimators.bodyfit.placing import place_in_world
from stages.formats.given_fits.recognize import read_smpl_fit
from stages.formats.given_fits.record import SmplFit
from stages.records import Cameras
from tests.made import fits
from tests.made.datasets import TURN, UNITS
from tests.made.said import holds
from tests.made.truth import joints_of

ROUNDED = ("ROMP v1 video", "ROMP v1 tracks", "ROMP v1 pictures", "EasyMocap")  # half precision, three decimals


@pytest.fixture(scope="module")
def truth():
    return fits.make_truth()


def placed(truth, path):
    """The fit in `path` as poses of the person in the world, and what choosing them said."""
    cameras = Cameras(truth.names, truth.viewmats, truth.views.Ks, *truth.size)
    fit, frames = join_frames(read_smpl_fit(path, truth.size), fits.inputs_of(truth, truth.model).listing)
    fit, frames, said = choose_person(fit, frames, cameras, list(truth.views.masks), truth.model)
    names = tuple(truth.names[i] for i in frames)
    poses = place_in_world(fit, names, truth.viewmats[frames], truth.views.Ks[frames], truth.model, 1 / UNITS)
    return poses, frames, {**said, "joints2d": fit.joints2d}


def degrees(a, b):
    turns = (Rotation.from_rotvec(np.reshape(v, (-1, 3))) for v in (a, b))
    return np.degrees((next(turns).inv() * next(turns)).magnitude()).max()


@pytest.mark.parametrize("tool", fits.FILES)
def test_each_tool_comes_back_where_the_person_was(truth, tmp_path, tool):
    poses, frames, said = placed(truth, fits.write(tool, fits.contents(tool, truth), tmp_path))
    assert frames.tolist() == list(range(len(truth)))
    joints, wanted = joints_of(poses, truth.model), truth.world_joints()
    pose, shown = truth.views.body_pose, poses.body_pose
    if tool in ("GVHMR", "PromptHMR"):  # they have no hands
        joints, wanted, pose, shown = joints[:, :22], wanted[:, :22], pose[:, :63], shown[:, :63]
    turned = (TURN * Rotation.from_rotvec(truth.views.global_orient)).as_rotvec()
    error = np.linalg.norm(joints[:, 0] - wanted[:, 0], axis=-1).max()
    limbs = np.linalg.norm((joints - joints[:, :1]) - (wanted - wanted[:, :1]), axis=-1).max()
    angle = max(degrees(poses.global_orient, turned), degrees(shown, pose))
    print(f"{tool}: pelvis {1000 * error:.4f} mm, joints about it {1000 * limbs:.4f} mm, {angle:.5f} degrees")
    if tool in ROUNDED:
        assert error < 1e-3 and limbs < 1e-3 and angle < 0.1
    else:
        assert error < 1e-6 and limbs < 1e-6 and angle < 1e-4
    assert said["overlap"] > 0.7
    others = [share for who, share in said["people"].items() if who != said["person"]]
    assert all(share < 0.5 * said["overlap"] for share in others)


def reprojected(truth, poses):
    """Pixels [N,24,2] of the placed body's joints by the clip's cameras."""
    views = rescale_viewmats(truth.viewmats, poses.world_from_sfm)
    return project(joints_of(poses, truth.model), views, truth.views.Ks)[0]


@pytest.mark.parametrize(
    "tool,focal,most,middle",
    [
        # px on a person of 76 px: exactly where the tool's focal length is true, else up to what perspective does to arms
        ("GVHMR", lambda t: t.focal, 1e-3, 1e-3),
        ("TRAM", lambda t: t.focal, 1e-3, 1e-3),
        ("PromptHMR", lambda t: t.focal, 1e-3, 1e-3),
        ("WHAM", lambda t: np.hypot(*t.size), 5.0, 0.5),
        ("PHALP", lambda t: 5000 / 256 * max(t.size), 15.0, 1.5),
        ("simple-romp video", lambda t: fits.WEAK, 15.0, 1.5),
    ],
)
def test_world_joints_reproject_onto_the_tools_own(truth, tmp_path, tool, focal, most, middle):
    poses, _, said = placed(truth, fits.write(tool, fits.contents(tool, truth), tmp_path))
    theirs = truth.tool_joints(focal(truth))
    off = np.linalg.norm(reprojected(truth, poses) - theirs, axis=-1)[:, : 22 if tool in ("GVHMR", "PromptHMR") else 24]
    print(f"{tool}: {off.max():.4f} px at most, {np.median(off):.4f} px in the middle")
    assert off.max() < most and np.median(off) < middle
    if tool == "PHALP":
        known = ~np.isnan(said["joints2d"][..., 0])
        assert known.sum(1).tolist() == [14] * len(truth)
        np.testing.assert_allclose(said["joints2d"][known], theirs[known], atol=1e-3)


def test_a_body_beside_the_optical_axis_is_seen_from_the_same_side(truth):
    """A tool with a far camera sees a person at the picture's side from the front; ours, being near, from the side."""
    pan = Rotation.from_euler("y", 20, degrees=True)
    turned = replace(
        truth, orient=(pan * Rotation.from_rotvec(truth.orient)).as_rotvec(), pelvis=pan.apply(truth.pelvis)
    )
    viewmats = truth.viewmats.copy()
    viewmats[:, :3] = pan.as_matrix() @ truth.viewmats[:, :3]
    theirs, place = replace(turned, viewmats=viewmats), []
    orient, pelvis = theirs.seen_by(fits.WEAK)
    center = np.tile(np.array(truth.size) / 2, (len(truth), 1))
    fit = SmplFit("a", "a", np.tile(truth.betas, (len(truth), 1)), orient, truth.views.body_pose, pelvis - truth.rest)
    far = replace(fit, focal=np.full(len(truth), fits.WEAK), center=center)
    poses = place_in_world(far, truth.names, viewmats, truth.views.Ks, truth.model, 1 / UNITS)
    wanted = theirs.tool_joints(fits.WEAK)
    back = Rotation.from_matrix(viewmats[:, :3, :3]).inv()
    unturned = replace(poses, global_orient=(back * Rotation.from_rotvec(orient)).as_rotvec())
    for given in (poses, unturned):
        pixels = project(joints_of(given, truth.model), rescale_viewmats(viewmats, 1 / UNITS), truth.views.Ks)[0]
        place.append(np.median(np.linalg.norm(pixels - wanted, axis=-1)))
    assert np.linalg.norm(joints_of(poses, truth.model) - truth.world_joints(), axis=-1).max() < 1e-5
    print(f"{place[0]:.3f} px off in the middle, {place[1]:.3f} px unturned")
    assert place[0] < 2.0 and place[1] > 1.5 * place[0]


@pytest.mark.parametrize("aside,least,most", [(0.0, 0.0, 0.03), (0.1, 0.1, 0.3)])
def test_joints_that_the_tool_drew_elsewhere_are_noticed(truth, tmp_path, aside, least, most):
    content = fits.contents("PHALP", truth)
    for entry in content.values():
        entry["2d_joints"] = [joints + np.float32(aside) for joints in entry["2d_joints"]]
    fit = read_smpl_fit(fits.write("PHALP", content, tmp_path), truth.size)
    smpl = replace(truth.model, name="SMPL")  # the tool's own body
    _, facts = import_fit(fit, fits.inputs_of(truth, smpl, moving=False))
    assert least <= facts["tool_joints_off"] < most and facts["person"] == "7"
    assert len(facts["notes"]) == 1 and holds(facts["notes"][0], "1 poses", "predicted")
