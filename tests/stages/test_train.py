"""Stage train: what it writes, resumes, refuses, and leaves behind when it breaks down."""

import csv
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages import evaluate, render, train
from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.model.person import Canonical, rest
from stages.avatar.model.scene import load_scene
from stages.contract import Job, StageError, Stopped
from stages.filming.clip_cast import load_cast
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import write_cameras
from stages.formats.clip import load_clip
from stages.formats.effects import SHADOW, read_effects
from stages.formats.failure import read_failure, write_failure
from stages.formats.images import write_image, write_mask
from stages.formats.points import read_points, write_points
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, read_scene
from stages.records import Avatar, BodyPoses, Cameras
from stages.training.beginning.start import build
from stages.training.checkpoint import Checkpoint
from stages.training.files import write
from stages.training.finishing import settle
from stages.training.finishing.bake import SHORT, as_trained, floating, shorten
from stages.training.finishing.depths import snap_to_surface
from stages.training.results import effect_facts, result_of
from stages.training.run import SAVED, Training, begin, finish, learn
from stages.training.step import losses
from stages.training.step.fit import Fit
from stages.training.timing.deadline import Pace
from stages.training.timing.finishing import GAINS, HIDDEN, SETTLING, SHAPING, WRITING, Finishing, finishing_parts
from tests.made.learned import pose_avatar
from tests.made.said import any_holds, holds
from tests.made.training import posed, twin

FRAMES, WIDTH, HEIGHT = 8, 48, 40
DRAWN = ("shadow", "shading", "motion_blur", "rolling_shutter", "camera_refinement")
LEARNED = ("view_dependence", "sky", "transients", "antialias", "clothing")
STARTS = {"shadow": [0.6, 0.0, -0.8, 0.3]}
PARAMS = train.Params(
    steps=8,
    human_points=6_900,
    human_cap=7000,
    scene_cap=60,
    scene_fill=20,
    channels=4,
    resolution=8,
    views_per_decode=2,
    curve_points=2,
)


@pytest.fixture(scope="module", autouse=True)
def untimed():
    """No steps are taken to see what effects cost: tests/stages/training/timing/test_effect_gains.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.training.timing.effect_gains._seconds", lambda fit: 1.0)
        yield


@pytest.fixture(scope="module")
def noises(tmp_path_factory):
    """Folders of sfm, smpl and survey of a clip made of noise: the plumbing is tested here, not the picture."""
    return noise(tmp_path_factory.mktemp("noise"))


@pytest.fixture
def inputs(noises, tmp_path):
    """Those folders, which a test may change."""
    return copied(noises, tmp_path)


def copied(folders, room):
    return {name: shutil.copytree(folder, room / name) for name, folder in folders.items()}


@pytest.fixture(scope="module")
def made(noises, tmp_path_factory):
    """A training by the stage with PARAMS: the folders that it had, itself, and the folder of what it wrote.

    Made once; a test only reads it, or changes a copy of the training.
    """
    room, kept = tmp_path_factory.mktemp("plain"), []
    folders, job = copied(noises, room), fresh(room, "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.training.run.finish", lambda *a: (kept.append(a[0]), finish(*a))[1])
        train.run(job, PARAMS, **folders)
    return folders, kept[0], job.out


@pytest.fixture
def plain(made):
    """What the stage writes with PARAMS."""
    return made[-1]


@pytest.fixture
def impatient(monkeypatch):
    """Four bad steps in a row stop a training."""
    monkeypatch.setattr("stages.training.step.guard.BAD_STEPS", 4)


@pytest.fixture(scope="module")
def affected(noises, tmp_path_factory):
    """Of a training with all effects: the folders that it had, itself, the folder of what it wrote, and what was said."""
    room = tmp_path_factory.mktemp("affected")
    folders, job, said = copied(noises, room), fresh(room, "out"), []
    decide(folders["survey"], **dict.fromkeys((*DRAWN, *LEARNED), True))
    job.emit = lambda event: said.append(event.get("text", ""))
    training = trained(folders, PARAMS.model_copy(update={"scene_cap": 60_000}), job)
    write(job.out, finish(training, job))
    return folders, training, job.out, said


def noise(room):
    rng = np.random.default_rng(0)
    names = tuple(f"{i:06d}" for i in range(FRAMES))
    viewmats = np.tile(np.eye(4), (FRAMES, 1, 1))
    viewmats[:, 2, 3], viewmats[:, 0, 3] = 3, np.linspace(-1, 1, FRAMES)
    Ks = np.tile(np.array([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]), (FRAMES, 1, 1))
    sfm, smpl, survey = (room / n for n in ("sfm", "smpl", "survey"))
    for folder in (sfm / "images", sfm / "masks", smpl, survey):
        folder.mkdir(parents=True)
    write_cameras(sfm / "cameras.npz", Cameras(names, viewmats, Ks, WIDTH, HEIGHT))
    write_points(sfm / "points.ply", rng.uniform(-2, 2, (30, 3)), rng.integers(0, 255, (30, 3), dtype=np.uint8))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[8:32, 16:32] = 255
    for name in names:
        write_image(sfm / "images" / f"{name}.png", rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        write_mask(sfm / "masks" / f"{name}.png", mask)
    body_pose = 0.1 * np.sin(np.arange(FRAMES)[:, None] + np.arange(69))
    still = np.zeros((FRAMES, 3))
    write_poses(smpl / "body.npz", BodyPoses(names, np.zeros(10), still, body_pose, still, np.ones(FRAMES), 1.0))
    write_body_model(smpl / "body_model.npz", read_body_model())
    decide(survey)
    return {"sfm": sfm, "smpl": smpl, "survey": survey}


def decide(survey, **decisions):
    chosen = {"scene": True, "pose_refinement": True, "exposure": False} | decisions
    (survey / "survey.json").write_text(
        json.dumps({"measures": {}, "effects": {}, "decisions": chosen, "starts": STARTS})
    )


def fresh(tmp_path, name: str) -> Job:
    (tmp_path / name).mkdir()
    return Job(out=tmp_path / name)


def stopping(tmp_path, name: str, after: int) -> Job:
    """A job that is asked to stop when `after` steps are done."""
    job = fresh(tmp_path, name)
    job.emit = lambda event: setattr(job, "_stop", job._stop or event.get("done", 0) >= after)
    return job


def begun(inputs, params=PARAMS, job=None) -> Training:
    """A training of those folders before its first step."""
    job = job or Job(inputs["sfm"])
    return begin(train._task(job, params, **inputs), job, None, 0.0)


def trained(inputs, params=PARAMS, job=None) -> Training:
    """A training of those folders that has taken all its steps."""
    training = begun(inputs, params, job)
    learn(training, job or Job(inputs["sfm"]))
    return training


def finished(fit, clip, folder) -> tuple[Avatar, list[str]]:
    """The avatar of a training, and what is warned of."""
    events = []
    say = Finishing(Job(folder, emit=events.append), finishing_parts(1), 0, 0.0)
    avatar = result_of(fit, [clip], [{"seconds": 0.0}], {}, say).people[0][0]
    return avatar, [event["text"] for event in events if event["event"] == "warning"]


def contents(folder) -> dict:
    return {p.name: dict(np.load(p)) for p in folder.glob("*.npz")}


@pytest.mark.slow
def test_l11_outputs_and_the_avatar_needs_no_network(made, held, monkeypatch):
    inputs, training, plain = made
    fit = training.fit
    assert sorted(p.name for p in plain.iterdir()) == [
        "avatar.npz",
        "body.npz",
        "curve.csv",
        "scene.npz",
        "train.json",
    ]
    clip = load_clip(inputs["sfm"], inputs["smpl"], train=plain)
    body = [
        torch.tensor(getattr(clip.body, k)[3], dtype=torch.float32) for k in ("global_orient", "body_pose", "transl")
    ]
    monkeypatch.setattr(settle, "STEPS", 0)
    bare, kept = finished(fit, clip, plain)[0], read_avatar(plain / "avatar.npz")
    parts = {name: part for name, part in vars(kept).items() if name not in ("casters", "normals", "fingers", "face")}
    changed = [name for name, part in parts.items() if not np.array_equal(part, getattr(bare, name))]
    assert all(map(np.array_equal, kept.casters, bare.casters))
    np.testing.assert_allclose(kept.normals, bare.normals, atol=1e-3, err_msg="the file keeps half the digits")
    assert changed == ["means", "scales", "opacities", "sh0"], "what settles"
    baked = pose_avatar(load_avatar(bare), *body)
    with torch.no_grad():
        canonical, _ = fit.people[0].baked()
        stay = ~floating(canonical, fit.people[0].body)
        poses = dict(zip(("global_orient", "body_pose", "transl"), fit.poses(fit.people[0])[:3], strict=True))
        seen = fit.people[0].body._replace(**poses), fit.full._replace(viewmats=fit.cameras()), fit.train
        even, evened = snap_to_surface(Canonical(*(part[stay] for part in canonical)), *seen)
        short, longer = shorten(even, SHORT * fit.people[0].human.initial().scales.amax(1)[stay])
        network = posed(fit, rest(short, fit.people[0].canonical_bones), *body)
    facts, n = json.loads((plain / "train.json").read_text()), len(network.means)
    assert facts["gaussians"]["human"] == len(baked.means) == n + facts["lining"] and facts["lining"] > 0
    assert facts["strays"] == (~stay).sum() < 0.01 * n and facts["snapped"] == evened["snapped"] < 0.6 * n
    assert facts["shortened"] == longer
    covariances = [(splats.axes @ splats.axes.mT)[:n] for splats in (baked, network)]
    held((covariances[0] - covariances[1]).abs().max() / covariances[1].abs().max(), 1e-4)
    held((baked.means[:n] - network.means).abs().max(), 1e-5)
    assert torch.allclose(baked.opacities[:n], network.opacities)
    scene, learned = load_scene(read_scene(plain / "scene.npz")), fit.scene.splats()
    assert torch.allclose(scene.axes, learned.axes, atol=1e-6) and torch.equal(scene.means, learned.means)
    rows = list(csv.DictReader((plain / "curve.csv").open()))
    assert [int(r["step"]) for r in rows] == [4, 8] and float(rows[1]["psnr"]) > 0
    assert 0 < float(rows[0]["seconds"]) < float(rows[1]["seconds"])
    spent = facts["seconds_by_part"]
    assert set(spent) == {"growth", "person's networks", "drawing", "losses", "backward", "optimiser", "other"}
    assert sum(spent.values()) == pytest.approx(facts["seconds"], abs=0.01) and min(spent.values()) >= 0
    assert json.loads((plain / "train.json").read_text())["train_frames"] == [clip.names[i] for i in (0, 1, 3, 4, 5, 6)]


@pytest.mark.slow
def test_a_finished_training_is_kept_where_no_part_of_finishing_works(tmp_path, made, monkeypatch):
    """Effects cannot be timed, what is hidden cannot be filled, and nobody can settle."""
    met, events, training = [], [], replace(made[1], fit=twin(made[1].fit))

    def untimed(fit, frames, far):
        raise FloatingPointError("too many bad steps")

    def unfilled(scene, views, frames, cast):
        met.extend(one for frame in frames for one in cast.at(frame).people)
        raise ValueError("no memory left")

    monkeypatch.setattr("stages.training.run.effect_gains", untimed)
    monkeypatch.setattr("stages.training.results.fill_hidden", unfilled)
    monkeypatch.setattr(losses, "person_only", lambda rendered, *_: torch.nan * rendered.sum())
    monkeypatch.setattr("stages.training.step.guard.BAD_STEPS", 2)  # as many as settling takes
    result = finish(training, Job(tmp_path, emit=events.append))
    assert result.facts["effects"] == {} and result.facts["filled"] == 0
    warned = [event["text"] for event in events if event["event"] == "warning"]
    known = [
        ("not be measured", "bad steps"),
        ("not be filled", "no memory left"),
        ("could not be refined",),
        ("left out",),
    ]
    assert len(warned) == 4 and all(any_holds(warned, *parts) for parts in known), warned
    assert len(met) == len(training.fit.train), "who is there"
    assert all(len(one.means) == len(training.fit.people[0].human) and not one.means.requires_grad for one in met)
    kept = result.people[0][0]
    assert all(np.isfinite(part).all() for part in (kept.means, kept.scales, kept.opacities, kept.sh0))


@pytest.mark.slow
def test_what_effects_gain_is_not_measured_where_nobody_asks(tmp_path, made, monkeypatch):
    def refused(fit, frames, far):
        raise AssertionError("measured")

    monkeypatch.setattr("stages.training.run.effect_gains", refused)
    training = replace(made[1], fit=twin(made[1].fit))
    assert GAINS in dict(training.after)
    training.fit.params = training.fit.params.model_copy(update={"effect_gains": False})
    assert GAINS not in dict(training.after)
    assert finish(training, Job(tmp_path)).facts["effects"] == {}


def same_results(one, other) -> bool:
    a, b = contents(one), contents(other)
    return a.keys() == b.keys() and all(np.array_equal(a[name][key], b[name][key]) for name in a for key in a[name])


@pytest.mark.slow
def test_held_out_frames_and_effects_that_are_off_change_no_byte(tmp_path, inputs, plain):
    write_image(inputs["sfm"] / "images" / "000002.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_mask(inputs["sfm"] / "masks" / "000007.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    decide(inputs["survey"], **dict.fromkeys(LEARNED, False))
    second = fresh(tmp_path, "second")
    train.run(second, PARAMS, **inputs)
    assert same_results(plain, second.out)
    for name in ("avatar.npz", "scene.npz", "body.npz"):
        assert (plain / name).read_bytes() == (second.out / name).read_bytes()


@pytest.mark.slow
def test_h11_h12_killed_while_saving_stopped_and_resumed_equals_straight(tmp_path, inputs, plain, monkeypatch):
    """The third save dies: what a process leaves that is killed there is what its folder holds at that moment."""
    job, saves, real = fresh(tmp_path, "job"), [], torch.save

    def dies(value, file):
        saves.append(file)
        if len(saves) < 3:
            return real(value, file)
        file.write(b"half")
        file.flush()
        shutil.copytree(job.out, tmp_path / "killed")
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", dies)
        patch.setattr(train, "CHECKPOINT_SECONDS", -1)
        with pytest.raises(OSError, match="disk full"):
            train.run(job, PARAMS, **inputs)
    killed = tmp_path / "killed"
    assert (killed / "checkpoint.part").read_bytes() == b"half"
    assert (killed / "checkpoint.pt").read_bytes() == (job.out / "checkpoint.pt").read_bytes()
    said: list[str] = []

    def listen(event: dict) -> None:
        said.append(event.get("text", ""))
        again._stop = event.get("done", 0) >= 4

    again = Job(out=killed, emit=listen)
    with pytest.raises(Stopped, match="goes on from there"):
        train.run(again, PARAMS, **inputs)
    assert any("goes on after step 2" in text for text in said), "the last whole checkpoint"
    assert (killed / "checkpoint.pt").exists() and not (killed / "avatar.npz").exists()
    train.run(Job(out=killed), PARAMS, **inputs)
    assert not list(killed.glob("checkpoint*")) and same_results(plain, killed)
    facts = json.loads((killed / "train.json").read_text())
    assert sum(facts["seconds_by_part"].values()) == pytest.approx(facts["seconds"], abs=0.01), (
        "before and after the stop"
    )


@pytest.mark.slow
def test_h01_h05_a_training_that_breaks_down_leaves_what_is_needed_to_see_it_again(tmp_path, inputs, monkeypatch):
    def faint(task, note, warn=None, real=build):
        fit = real(task, note)
        fit.scene.logit_opacities.data.fill_(-20)
        return fit

    monkeypatch.setattr("stages.training.run.build", faint)
    monkeypatch.setattr("stages.training.beginning.start.build", faint)
    job = fresh(tmp_path, "job")
    with pytest.raises(StageError, match="training broke down") as error:
        train.run(job, PARAMS, **inputs)
    monkeypatch.undo()
    facts = error.value.facts
    assert "step 1, frame 00000" in facts[0] and "Gaussians would be pruned" in facts[0]
    assert str(job.out / "failure.npz") in facts[2] and not list(job.out.glob("avatar*"))
    with pytest.raises(ValueError, match="Gaussians would be pruned") as again:
        train.replay(job.out / "failure.npz")
    assert str(again.value) in facts[0], "to the last word"
    with np.load(job.out / "failure.npz", allow_pickle=False) as kept:
        told = json.loads(kept["facts"].item())
    assert (told["step"], told["seed"], told["threads"]) == (1, 0, torch.get_num_threads())


@pytest.mark.slow
def test_h01_a_failure_in_the_middle_of_training_is_replayed_from_the_step_before(
    tmp_path, inputs, monkeypatch, impatient
):
    job, real = fresh(tmp_path, "job"), losses.photometric
    monkeypatch.setattr(losses, "photometric", lambda *a: real(*a) * torch.nan)
    with pytest.raises(StageError, match="training broke down") as error:
        train.run(job, PARAMS, **inputs)
    assert holds(error.value.facts[0], "step 3", "4 bad steps", "loss")
    with pytest.raises(FloatingPointError, match=r"4 bad steps.*loss") as again:
        train.replay(job.out / "failure.npz")
    assert str(again.value) in error.value.facts[0]
    monkeypatch.setattr(losses, "photometric", real)
    with pytest.raises(StageError, match=r"step 3.*well"):
        train.replay(job.out / "failure.npz")
    (tmp_path / "other.npz").write_text("no archive")
    with pytest.raises(StageError, match="cannot read"):
        train.replay(tmp_path / "other.npz")
    state, facts = read_failure(job.out / "failure.npz")
    older = torch.load(io.BytesIO(state), weights_only=True)
    del older["progress"]
    file = io.BytesIO()
    torch.save(older, file)
    write_failure(tmp_path / "older.npz", file.getvalue(), facts.model_dump())
    with pytest.raises(StageError, match="of another version") as error:
        train.replay(tmp_path / "older.npz")
    assert "progress" in error.value.facts[0] and "version of hugs" in error.value.hint


@pytest.mark.slow
def test_h01_a_failure_is_replayed_without_the_effects_that_time_was_too_short_for(
    tmp_path, inputs, monkeypatch, impatient
):
    decide(inputs["survey"], motion_blur=True)
    monkeypatch.setattr(
        "stages.training.run.begin", lambda task, *rest, real=begin: real(task.chosen({}, ("motion_blur",)), *rest)
    )
    real, job = losses.photometric, fresh(tmp_path, "job")
    monkeypatch.setattr(losses, "photometric", lambda *a: real(*a) * torch.nan)
    with pytest.raises(StageError, match="training broke down"):
        train.run(job, PARAMS, **inputs)
    with pytest.raises(FloatingPointError, match=r"4 bad steps.*loss"):
        train.replay(job.out / "failure.npz")


@pytest.mark.slow
def test_l01_l03_rows_that_are_not_finite_stay_out_of_the_result_and_are_counted(tmp_path, made):
    said: list[str] = []
    job = fresh(tmp_path, "out")
    job.emit = lambda event: said.append(event.get("text", ""))
    training = replace(made[1], fit=twin(made[1].fit))
    fit, sizes = training.fit, training.fit.sizes()
    fit.scene.means.data[1, 2] = torch.nan
    fit.scene.quats.data[2] = 0
    fit.people[0].human.log_sizes[4] = 200  # the exponential overflows
    write(job.out, finish(training, job))
    assert any_holds(said, "3 Gaussians", "not finite")
    scene, avatar = read_scene(job.out / "scene.npz"), read_avatar(job.out / "avatar.npz")
    facts = json.loads((job.out / "train.json").read_text())
    assert len(scene) == sizes["scene"] - 2 and facts["broken"] == 3
    assert len(avatar) == sizes["human"] - 1 - facts["strays"] + facts["lining"]


@pytest.mark.slow
def test_h17_points_on_a_camera_are_left_out_and_counted(tmp_path, inputs):
    xyz, rgb = read_points(inputs["sfm"] / "points.ply")
    eye = np.array([[1.0, 0, -3], [0.0, 0.001, -3]])  # where cameras stand
    write_points(inputs["sfm"] / "points.ply", np.concatenate([xyz, eye]), np.concatenate([rgb, rgb[:2]]))
    said: list[str] = []
    job = fresh(tmp_path, "out")
    job.emit = lambda event: said.append(event.get("text", ""))
    begun(inputs, PARAMS, job)
    assert any_holds(said, 1, "points", "camera")


@pytest.mark.slow
def test_fewer_frames_are_spread_evenly(inputs):
    fit = begun(inputs, PARAMS.model_copy(update={"steps": 2, "frames_used": 3})).fit
    assert fit.train == [0, 3, 5], "of 0, 1, 3, 4, 5, 6"


@pytest.mark.slow
def test_the_first_steps_look_at_half_the_size(inputs, monkeypatch):
    fit, seen = begun(inputs, PARAMS.model_copy(update={"steps": 2, "half_until": 0.5})).fit, []
    real = fit._learn
    monkeypatch.setattr(fit, "_learn", lambda i, views: (seen.append(views.images.shape[1]), real(i, views))[1])
    fit.advance(), fit.advance()
    assert seen == [HEIGHT // 2, HEIGHT]


@pytest.mark.slow
def test_refined_poses_are_written_and_without_them_and_a_scene_only_the_person_is(tmp_path, inputs, plain):
    fitted, refined = read_poses(inputs["smpl"] / "body.npz"), read_poses(plain / "body.npz")
    assert not np.allclose(fitted.body_pose[1], refined.body_pose[1], atol=1e-6)
    decide(inputs["survey"], scene=False, pose_refinement=False)
    job = fresh(tmp_path, "out")
    train.run(job, PARAMS.model_copy(update={"steps": 4}), **inputs)
    assert np.allclose(read_poses(job.out / "body.npz").body_pose, fitted.body_pose, atol=1e-6)
    assert not (job.out / "scene.npz").exists() and len(read_avatar(job.out / "avatar.npz")) > 0


@pytest.mark.slow
def test_all_effects_at_once_are_written_measured_and_drawn_by_all_that_follow(plain, affected, held):
    inputs, training, out, _ = affected
    facts = json.loads((out / "train.json").read_text())
    assert facts["left_out"] == 0 and all(facts["effects"][name]["psnr"] is not None for name in DRAWN)
    effects = read_effects(out / "effects.npz")
    said = {name: np.asarray(value) for name, value in training.fit.effects.known().items()}
    assert effects.known().keys() == said.keys() == {*SHADOW, "shading", "shutter", "readout"}
    held(max(np.abs(value - said[name]).max() for name, value in effects.known().items()), 1e-6)
    *lamp, darkness = STARTS["shadow"]
    assert said["light"] @ lamp > 0.97 and abs(said["darkness"] - darkness) < 0.1, "eight steps from what survey saw"
    clip, given = (load_clip(inputs["sfm"], inputs["smpl"], folder) for folder in (out, None))
    held(np.abs(clip.viewmats - training.fit.cameras().numpy()).max(), 1e-6)
    moved = np.abs(clip.viewmats - given.viewmats)[clip.training].max((1, 2))
    assert (moved > 1e-5).all() and moved.max() < 0.05
    clips, cast = load_cast(inputs["sfm"], inputs["smpl"], out, "cpu")
    for i in (2, 7):  # held out: as evaluation draws it, and as the film has it
        shot = evaluate.Shot(clips, cast, 0, i, None)
        wanted = (shot.draw(shot.moment)[0].numpy() * 255).round()
        (film,) = render._beside_truth(clip, cast, [i], {})
        assert np.abs(film[:, WIDTH:] - wanted).max() <= 1
        still = evaluate.Shot(clips, cast._replace(effects=FrameEffects(), speeds=None), 0, i, None)
        sharp = still.draw(still.moment)[0].numpy() * 255
        assert np.abs(sharp - wanted).max() > 3
    assert not (plain / "effects.npz").exists() and not (plain / "cameras.npz").exists()


def test_g06_no_person_anywhere_is_a_clear_error(tmp_path, inputs):
    for path in (inputs["sfm"] / "masks").iterdir():
        write_mask(path, np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(StageError, match=r"no training frame.*person") as error:
        train.run(fresh(tmp_path, "out"), PARAMS, **inputs)
    assert "6 training frames" in error.value.facts[0]


def test_importing_the_stage_loads_nothing_heavy():
    code = "import sys, stages.train; print([m for m in ('torch', 'cv2', 'numba', 'pycolmap') if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


ABLATIONS = {"lbs_learning": False, "human_densify": False, "human_loss": False, "triplane": False, "joint": False}


@pytest.mark.slow
def test_every_ablation_reaches_what_is_trained(inputs, made):
    without = trained(inputs, PARAMS.model_copy(update=ABLATIONS | {"steps": 4}))
    for there, fit in ((True, made[1].fit), (False, without.fit)):
        known, who = fit.params, fit.people[0]
        assert (known.human_densify, known.human_loss, known.joint) == (there, there, there)
        assert (who.human.triplane is not None) is there and who.shared.weights.requires_grad is there
    result = finish(without, Job(inputs["sfm"]))
    assert len(result.people[0][0]) > 0 and len(result.scene) > 0


@pytest.mark.parametrize("setting", ["human_loss", "joint"])
def test_a_person_that_needs_a_scene_to_learn_says_so(tmp_path, inputs, setting):
    decide(inputs["survey"], scene=False)
    with pytest.raises(StageError, match="no scene"):
        train.run(fresh(tmp_path, "out"), PARAMS.model_copy(update={setting: False}), **inputs)


class Refuses:
    """A fit of another shape than the checkpoint's."""

    def load(self, state):
        raise RuntimeError("size mismatch for means: [5, 3] and [4, 3]\nmore")


class Touches:
    def __init__(self, sign):
        self.sign = sign

    def __reduce__(self):
        return os.system, (f"touch {self.sign}",)


def test_h13_a_checkpoint_that_is_damaged_foreign_or_hostile_is_refused(tmp_path):
    path, sign = tmp_path / "checkpoint.pt", tmp_path / "ran"
    torch.save(
        {"fit": {}, "threads": 1, "curve": [], "seconds": 0.0, "parts": {}, "choice": {}, "deadline": None}, path
    )
    whole = path.read_bytes()
    torch.save({"fit": Touches(sign)}, path)
    for data, said in ((whole, "size mismatch"), (whole[:-50], "checkpoint.pt: "), (b"", "checkpoint.pt: "),
                       (path.read_bytes(), "checkpoint.pt: "), (pickle.dumps(Touches(sign)), "checkpoint.pt: ")):  # fmt: skip
        path.write_bytes(data)
        with pytest.raises(StageError, match=r"checkpoint.*cannot be used") as error:
            checkpoint = Checkpoint(path)
            checkpoint.resume(Refuses(), checkpoint.load(SAVED)["fit"])
        assert said in error.value.facts[0] and "--force" in error.value.hint and not sign.exists()


@pytest.mark.slow
def test_effects_that_are_on_are_kept(plain, affected):
    *_, out, said = affected
    before, scene, avatar = read_scene(plain / "scene.npz"), read_scene(out / "scene.npz"), out / "avatar.npz"
    assert before.shN.shape[1] == 0 and scene.shN.shape[1] == 15
    extent = json.loads((out / "train.json").read_text())["extent_m"]
    assert (np.linalg.norm(scene.means, axis=1) > 100 * extent).sum() > 10 and any_holds(said, "of the sky")
    assert scene.antialias and read_avatar(avatar).antialias and not before.antialias
    assert read_avatar(plain / "avatar.npz").clothes is None
    still = pose_avatar(load_avatar(read_avatar(avatar)), *(torch.zeros(n) for n in (3, 69, 3)))
    assert still.means.isfinite().all()


@pytest.mark.slow
def test_within_a_time_steps_and_sizes_are_chosen_and_a_stopped_run_goes_on(tmp_path, inputs, monkeypatch):
    """A made-up clock: a step takes a second, whatever this machine is doing."""
    now = [0.0]
    monkeypatch.setattr("stages.training.timing.deadline.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("stages.training.timing.deadline.rehearse", lambda *a: Pace((1.0, 1.0), (1.0, 1.0), 0.4))
    monkeypatch.setattr("stages.training.timing.deadline.PAUSE", 0.0)
    monkeypatch.setattr(
        "stages.training.results.fill_hidden", lambda scene, *_: torch.zeros(len(scene)) > 0
    )  # not looked at
    monkeypatch.setattr("stages.training.results.finish", lambda person, begun, *_: as_trained(person, begun))
    monkeypatch.setattr("stages.training.results.settle", lambda _, person, *__: person)
    for module in ("budget", "deadline"):
        monkeypatch.setattr(f"stages.training.timing.{module}.FEWEST", 10)
    advance = Fit.advance
    monkeypatch.setattr(Fit, "advance", lambda fit: (now.__setitem__(0, now[0] + 1), advance(fit))[1])
    params = PARAMS.model_copy(update={"seconds": 20.0, "reserve": 9.0, "reserve_least": 5.0, "human_cap": 30_000})
    said = []
    job = stopping(tmp_path, "job", after=8)
    stop = job.emit
    job.emit = lambda event: (said.append(event.get("text", "")), stop(event))
    with pytest.raises(Stopped):
        train.run(job, params, **inputs)
    assert any_holds(said, "15 steps", "1000 ms", "28,000 Gaussians")
    assert any_holds(said, "5.4 dB", "10,000 steps")
    begun = now[0]
    train.run(Job(out=job.out), params, **inputs)
    facts = json.loads((job.out / "train.json").read_text())
    assert facts["steps"] == 15 and facts["sizes"] == {"human_cap": 28_000, "scene_cap": 60} and now[0] == 15
    assert begun in (8.0, 9.0)


def test_an_effect_that_the_clock_does_not_see_is_not_said_to_save_time(tmp_path):
    said, warned = [], []
    found = {
        "shadow": {"psnr": 2.6, "psnr_person": 0.5, "psnr_far": -0.3, "share": -0.046},
        "exposure": {"psnr": 1.0, "psnr_person": 1.0, "psnr_far": None, "share": 0.1},
    }
    told = effect_facts(found, 100.0, said.append, warned.append)
    assert [effect["seconds"] for effect in told.values()] == [-4.6, 10.0], "as measured"
    where = "-0.3 in the poses farthest from training"
    assert said[0].startswith("shadow: +2.6 / +0.5 dB") and where in said[0] and "no measurable" in said[0]
    assert said[1].startswith("exposure: +1.0 / +1.0 dB") and holds(said[1], "10 s")
    (only,) = warned
    assert holds(only, "0.3 dB", "shadow", "survey.shadow=never"), "what loses in new poses"


def test_a_time_is_for_a_training_of_person_and_scene_together(tmp_path, inputs):
    with pytest.raises(StageError, match=r"person and scene.*time"):
        train.run(Job(tmp_path), PARAMS.model_copy(update={"seconds": 60.0, "joint": False}), **inputs)


def test_a_person_whose_poses_nothing_trusts_is_a_clear_error(tmp_path, inputs):
    poses = read_poses(inputs["smpl"] / "body.npz")
    write_poses(inputs["smpl"] / "body.npz", replace(poses, confidence=np.zeros(FRAMES)))
    with pytest.raises(StageError, match=r"no training frame.*body fit"):
        train.run(fresh(tmp_path, "out"), PARAMS, **inputs)


@pytest.mark.slow
@pytest.mark.parametrize("until", [0.4, 1.0])
def test_the_last_steps_teach_the_person_though_they_are_no_whole_group(inputs, until):
    fit = begun(inputs, PARAMS.model_copy(update={"steps": 1, "views_per_decode": 2, "networks_until": until})).fit
    fit.advance()
    assert fit.people[0].color_grad_sum.sum() > 0


@pytest.mark.slow
def test_what_is_mended_is_counted_and_a_cap_that_is_too_small_is_said(tmp_path, inputs, monkeypatch):
    monkeypatch.setattr("stages.training.results.fill_hidden", lambda scene, *_: torch.arange(len(scene)) < 3)
    job, events = fresh(tmp_path, "out"), []
    job.emit = events.append
    training = trained(inputs, PARAMS.model_copy(update={"steps": 2, "human_cap": 100, "scene_cap": 10}), job)
    fit = training.fit
    fit.guard.clipped, fit.densifier.settled = 3, torch.arange(len(fit.scene)) < 5
    facts, said = finish(training, job).facts, [event.get("text", "") for event in events]
    heard = [event for event in events if event["event"] == "progress"]
    assert [event["numbers"].get("now") for event in heard[-5:]] == [GAINS, HIDDEN, SHAPING, SETTLING, WRITING]
    done = [event["done"] for event in heard]
    assert (
        done == sorted(done)
        and {event["total"] for event in heard} == {heard[0]["total"]}
        and done[-1] < heard[0]["total"]
    )
    assert all(event["left"] > 0 for event in heard[-5:])
    assert facts["unseen"] > 0 and facts["recolored"] > 0 and facts["clipped"] == 3 and facts["behind"] == 5
    assert facts["filled"] == 3
    begun = facts["sizes"]["human_cap"]
    assert begun == len(fit.people[0].human) > 6800 and facts["sizes"]["scene_cap"] > 10
    for part in (
        f"the person begins with {begun:,} Gaussians, more than human_cap (100)",
        "Gaussians, more than scene_cap (10)",
        f"{facts['recolored']:,} Gaussians that no frame shows well",
        f"{facts['unseen']:,} Gaussians of the person that no frame shows",
        "5 Gaussians of the scene that the person always hides",
        f"{facts['filled']} Gaussians of the scene are invented",
        "3 gradients of networks or effects",
    ):
        assert any(part in text for text in said), part


@pytest.mark.slow
def test_a_training_that_breaks_down_while_it_is_timed_says_so(tmp_path, inputs, monkeypatch):
    def broken(*a):
        raise FloatingPointError("20 bad steps in a row")

    monkeypatch.setattr("stages.training.timing.deadline.rehearse", broken)
    with pytest.raises(StageError, match="first steps") as error:
        train.run(fresh(tmp_path, "out"), PARAMS.model_copy(update={"seconds": 60.0}), **inputs)
    assert error.value.facts == ("20 bad steps in a row",)
