"""Measuring held-out frames: known answers on a clip that was drawn from the avatar itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages import evaluate
from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.model.scene import load_scene
from stages.contract import Job
from stages.filming.clip_cast import posed_as
from stages.formats.clip import load_clip
from stages.formats.images import read_image
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, read_scene
from tests.made import tiny as tiny_clip
from tests.made.networks import fetched
from tests.made.tiny import HEIGHT, STAGES, WIDTH

HELD = 2  # the held-out frame that shows the person


@pytest.fixture(scope="module")
def lpips():
    fetched("lpips_alex.npz")


def run(clip, out, **params):
    def no_constants(word):
        raise AssertionError(f"{word} is no JSON")

    events = []
    inputs = {name: clip[name] for name in ("sfm", "smpl", "train")}
    job = Job(out, seed=5, emit=events.append, upstream=tiny_clip.UPSTREAM)
    evaluate.run(job, evaluate.Params(**params), **inputs)
    return json.loads((out / "metrics.json").read_text(), parse_constant=no_constants), events


@pytest.fixture(scope="module")
def measured(lpips, tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluate")
    return *run(tiny, out, fit_steps=2), out


def test_metrics_hold_what_is_promised(measured):
    metrics, _, _ = measured
    for protocol in ("heldout", "heldout_fitted"):
        assert set(metrics[protocol]) == {"full", "person_crop", "person_white"}
        assert all({"psnr", "ssim", "lpips"} <= set(region) for region in metrics[protocol].values())
    assert metrics["frames"] == 2 and metrics["gaussians"] == {"human": 1723, "scene": 441}
    seconds = metrics["seconds"]
    assert set(seconds) == {*STAGES, "evaluate", "total"} and seconds["train"] == 6.5
    assert seconds["total"] == pytest.approx(sum(v for k, v in seconds.items() if k != "total"), abs=1e-3)
    assert metrics["peak_memory_bytes"] >= 200 << 20 and metrics["device"] == "cpu" and metrics["seed"] == 5
    assert {"python", "torch", "numpy", "pycolmap"} <= set(metrics["versions"])


def test_what_drew_the_clip_scores_as_well_as_bytes_allow(measured):
    held = measured[0]["heldout"]
    assert held["full"]["psnr"] > 55 and held["full"]["ssim"] > 0.999 and held["full"]["lpips"] < 1e-3
    assert held["person_crop"]["psnr"] > 50
    assert held["person_white"]["psnr"] > 25, "the clip's edge of the mask has the wall in it"
    assert held["person_crop"]["lpips"] is None, "under 64 px"


def test_a_frame_without_a_person_counts_only_whole(measured):
    metrics, events, out = measured
    person, empty = metrics["per_frame"]["heldout"]
    assert set(person) == {"name", "full", "person_crop", "person_white"} and set(empty) == {"name", "full"}
    assert empty["full"]["psnr"] > 55, "nobody is drawn into it"
    assert not [e for e in events if e["event"] == "warning"]
    shown = {path.stem: read_image(path) for path in (out / "heldout").glob("*.png")}
    assert set(shown) == {tiny_clip.NAMES[2], tiny_clip.NAMES[7]}
    assert {picture.shape for picture in shown.values()} == {(HEIGHT, 3 * WIDTH, 3)}
    assert (shown[tiny_clip.NAMES[7]][:, 2 * WIDTH :] == 255).all()


def test_without_a_scene_only_the_person_is_measured(lpips, tiny_human, tmp_path):
    metrics, _ = run(tiny_human, tmp_path, fit_steps=0)
    assert metrics["frames"] == 1 and metrics["gaussians"]["scene"] == 0
    held = metrics["heldout"]
    assert set(held["full"].values()) == set(held["person_crop"].values()) == {None}
    assert held["person_white"]["psnr"] > 25 and "heldout_fitted" not in metrics


def test_nothing_held_out_is_said(lpips, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_FIRST", 99)
    metrics, events = run(tiny, tmp_path)
    assert metrics["frames"] == 0 and metrics["heldout"]["full"]["psnr"] is None
    assert any(e["event"] == "warning" and "nothing could be measured" in e["text"] for e in events)


@pytest.mark.slow
def test_pictures_are_shown_of_the_whole_clip(lpips, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_EVERY", 1)
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_FIRST", 0)
    metrics, _ = run(tiny, tmp_path, fit_steps=0)
    assert metrics["frames"] == 8, "and six are shown"
    names = [tiny_clip.NAMES[i] for i in (0, 1, 2, 4, 5, 6)]
    assert sorted(path.stem for path in (tmp_path / "heldout").glob("*.png")) == names


def shot(clip, gain=None, scene=True, **poses):
    train = clip["train"]
    loaded = load_clip(clip["sfm"], clip["smpl"])
    loaded = replace(loaded, body=replace(loaded.body, **poses))
    wall = read_scene(train / "scene.npz") if scene else None
    who = posed_as(loaded, read_avatar(train / "avatar.npz"), "cpu")
    return evaluate.Shot([loaded], Cast([who], wall and load_scene(wall), FrameEffects()), 0, HELD, gain)


@pytest.mark.slow
def test_a_pose_without_a_scene_is_not_fitted_to_where_another_hides_them(tiny):
    moved = []
    for known in (True, False):
        frame = shot(tiny, scene=False)
        hidden = torch.zeros_like(frame.theirs)
        hidden[:, (frame.box[1].start + frame.box[1].stop) // 2 :] = True
        frame.mask = frame.mask * ~hidden[..., 0]
        frame.theirs = hidden & known
        moved.append((evaluate.fit_pose(frame, 20)[2] - frame.pose[2]).norm())
    assert moved[0] < 0.3 * moved[1]


def test_a_wrong_pose_is_fitted_back(tiny):
    truth = read_poses(tiny["smpl"] / "body.npz")
    body_pose = truth.body_pose.copy()
    body_pose[:, 47] += 0.25
    wrong = {
        "global_orient": truth.global_orient,
        "body_pose": body_pose,
        "transl": truth.transl + [0.04, -0.03, 0],
    }
    frame = shot(tiny, **wrong)
    before = frame.pose
    found = evaluate.fit_pose(frame, 40)

    def error(pose):
        return float((frame.draw(frame.posed(*pose))[0].detach() - frame.image).square()[frame.box].mean())

    assert error(found) < error(before) / 4
    assert np.linalg.norm(found[2] - truth.transl[HELD]) < 0.02
    assert abs(found[1][47] - truth.body_pose[HELD, 47]) < 0.18
    np.testing.assert_allclose(before[1], wrong["body_pose"][HELD], atol=1e-6)


def test_fitting_never_makes_it_worse_and_no_steps_change_nothing(tiny):
    frame = shot(tiny)
    assert evaluate.fit_pose(frame, 0) is frame.pose
    found = evaluate.fit_pose(frame, 3)
    np.testing.assert_allclose(found[2], frame.pose[2], atol=1e-6)


def test_exposure_darkens_the_person_not_the_white_around(tiny):
    plain, dark = (shot(tiny, gain).draw(shot(tiny).moment) for gain in (None, [0.5, 0.5, 0.5]))
    torch.testing.assert_close(dark[0], plain[0] * 0.5, atol=1e-5, rtol=0)
    assert (dark[1][0, 0] == 1).all()
    inside = shot(tiny).mask > 0.99
    torch.testing.assert_close(dark[1][inside], plain[1][inside] * 0.5, atol=0.02, rtol=0)


def test_g14_equal_pictures_count_a_hundred_decibels(tiny):
    frame = shot(tiny)
    frame.image = frame.draw(frame.moment)[0]
    found = dict(evaluate._scores(frame, frame.draw(frame.moment), None))
    assert found["full"]["psnr"] == found["full"]["psnr_per_channel"] == evaluate.EQUAL


def test_poses_come_from_training(lpips, tiny, tmp_path):
    """A train/body.npz that is 10 cm off shows in the scores, and fitting brings them back."""
    clip = dict(tiny)
    clip["train"] = tmp_path / "train"
    clip["train"].mkdir()
    for path in tiny["train"].iterdir():
        (clip["train"] / path.name).write_bytes(path.read_bytes())
    poses = read_poses(tiny["train"] / "body.npz")
    write_poses(clip["train"] / "body.npz", replace(poses, transl=poses.transl + [0.05, 0, 0]))
    out = tmp_path / "out"
    out.mkdir()
    metrics, _ = run(clip, out, fit_steps=25)
    held, fitted = (metrics[k]["person_crop"]["psnr"] for k in ("heldout", "heldout_fitted"))
    assert held < 25 and fitted > held + 5


def test_the_person_times_the_mask_is_rated_when_asked_for(lpips, tiny, tmp_path):
    metrics, _ = run(tiny, tmp_path, fit_steps=0, masked=True)
    held = metrics["heldout"]
    assert set(held) == {*evaluate.REGIONS, "masked_full", "masked_crop"}
    assert held["masked_full"]["psnr"] > held["masked_crop"]["psnr"] > 25
    assert held["masked_full"]["lpips"] > held["masked_full"]["lpips_legacy"] > 0
    assert "masked_full" in metrics["protocol"] and metrics["protocol"].startswith("Every 5th")
