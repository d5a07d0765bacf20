"""The benchmarks measure what they say: makers agree, times add up, sizes are right."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages import train
from stages.avatar import rasterize
from stages.estimators.detectors.every import DETECTORS
from stages.formats.body_model import read_body_model
from stages.records import Scene
from tests.benchmarks import (
    approximations,
    effect_models,
    effects,
    effects_off,
    gestures,
    ideas,
    loose,
    posing,
    promises,
    train_step,
)
from tests.benchmarks.host import all_threads, use_threads
from tests.benchmarks.naive import Naive, project
from tests.benchmarks.rasterizer import Torch, distance
from tests.benchmarks.real_views import Hips, angle_between
from tests.benchmarks.train_step import Stopwatch, resized, timed_parts
from tests.benchmarks.workloads import random_work
from tests.made import one_pose
from tests.made.clothes import dress, some_clothes
from tests.made.command import ROOT
from tests.made.synthetic.wardrobe import MAKERS
from tests.made.tiny import make_avatar
from tests.made.training import fit_of, make_clip, run

clip = pytest.fixture(scope="module")(make_clip)


@pytest.mark.slow
def test_the_naive_kernel_draws_what_ours_draws():
    work = random_work(400, 70, 50, 15)
    ours, naive = Torch(work, rasterize.rasterize, rasterize.gaussian_axes), Naive(work, project(work))
    np.testing.assert_allclose(naive.forward(), ours.forward(), atol=1e-4)
    ours.backward()
    naive.backward()
    for a, b in zip(naive.gradients(), ours.gradients(), strict=True):
        assert distance(a, b) < 1e-4
    assert 5 < naive.pairs.mean() < 15


def test_a_countdown_is_judged_at_half_time_and_until_it_is_nearly_over():
    said = [(0.0, 90.0), (30.0, 70.0), (49.0, 55.0), (51.0, 20.0), (97.0, 0.5), (99.0, 0.0)]
    found = promises.judged(said, 100.0)
    assert found == {"guess": 90, "took": 100, "to_go": 50, "said": 55, "off": 0.1, "least": 0.5}


def test_a_box_that_is_too_small_is_widened_within_the_picture():
    assert gestures.widened((10, 90, 30, 100), 64, (320, 100)) == (0, 36, 64, 100)
    assert gestures.widened((300, 5, 320, 95), 64, (320, 100)) == (256, 5, 320, 95)
    assert gestures.widened((100, 5, 130, 95), 64, (320, 100)) == (83, 5, 147, 95)


@pytest.mark.slow
def test_what_computes_beside_a_run_ends_however_that_ends():
    with promises.other_work(1) as (other,):
        assert other.poll() is None and os.getsid(other.pid) == other.pid
    assert other.returncode == -signal.SIGKILL
    lines = "from tests.benchmarks.promises import other_work", "with other_work(1) as (one,):"
    script = "\n".join([*lines, " print(one.pid, flush=True)", " input()"])
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdin=-1, stdout=-1) as one:
        other = int(one.stdout.readline())
        one.kill()
    end = time.monotonic() + 30
    while not gone(other):
        if time.monotonic() > end:
            os.kill(other, signal.SIGKILL)
            pytest.fail("it went on")
        time.sleep(0.1)


def gone(process: int) -> bool:
    """Whether a process has ended, waited for or not."""
    try:
        return not Path(f"/proc/{process}/cmdline").read_bytes()
    except FileNotFoundError:
        return True


def test_exclusive_times_add_up_to_the_total(monkeypatch):
    now = [0.0]

    def spend(seconds):
        now[0] += seconds

    def outer():
        spend(2)
        job.inner()
        job.inner()

    monkeypatch.setattr(train_step, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    watch, job = Stopwatch(), SimpleNamespace(outer=outer, inner=lambda: spend(3))
    watch.watch([("outside", job, "outer"), ("inside", job, "inner")])
    job.outer()
    assert watch.seconds == {"inside": 6, "outside": 2} and now == [8]


@pytest.mark.slow
def test_benchmarks_that_are_run_by_hand_speak_of_what_there_is(tmp_path):
    """Settings, effects and lines of code that they name exist: one that named a setting long gone had rotted unseen."""
    assert set(effects.STRENGTHS) == set(DETECTORS) - {"face"}, "gestures has clips of faces, near and far"
    assert set(effect_models.EFFECTS) <= set(DETECTORS)
    assert set(loose.GARMENTS) == {*MAKERS, "none", *one_pose.KINDS}
    train.Params(**effect_models.PARAMS)
    train.Params(**loose.PARAMS)
    train.Params(**gestures.PARAMS)
    for case in approximations.CASES.values():
        train.Params(**dict(case.settings))
        for file, text, _ in case.edits:
            assert (Path(__file__).parents[2] / file).read_text().count(text) == 1, text
    size = {"frames": 6, "width": 96, "height": 128, "points": 300}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effects, "SIZE", size)
        found = effects.measured(effects.clip(tmp_path, 0), list(effects.STRENGTHS))
    assert all(isinstance(one["on"], bool) for one in found.values())


def test_every_timed_part_of_a_training_step_exists():
    for part, owner, name in timed_parts(SimpleNamespace(adam={"person 1": SimpleNamespace(step=None)})):
        assert hasattr(owner, name), part


def test_a_scene_takes_the_size_asked_for():
    rng = np.random.default_rng(0)
    rows = {name: rng.random((50, 3), np.float32) for name in ("means", "scales", "sh0")}
    scene = Scene(quats=rng.random((50, 4), np.float32), opacities=rng.random(50), shN=np.zeros((50, 3, 3)), **rows)
    for count in (20, 50, 130):
        other = resized(scene, count, rng)
        assert {len(getattr(other, name)) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")} == {
            count
        }
        np.testing.assert_allclose(other.scales.prod(1).mean() * count, scene.scales.prod(1).mean() * 50, rtol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ideas.WITHOUT)
def test_every_idea_can_be_left_out_and_is_back_afterwards(name, clip):
    idea = ideas.WITHOUT[name]
    assert set(idea.settings) <= set(train.Params.model_fields)
    before = [getattr(patch.getter(), patch.attribute) for patch in idea.patches]
    with ExitStack() as stack:
        for patch in idea.patches:
            stack.enter_context(patch)
        fit = fit_of(clip, steps=8)
        numbers = run(fit, 8)
    assert np.isfinite(numbers).all() and fit.guard.left_out == 0
    assert before == [getattr(patch.getter(), patch.attribute) for patch in idea.patches]


def test_a_training_without_the_hooks_of_effects_has_none_of_them_and_learns_the_same(clip):
    off, bare = fit_of(clip, steps=8, exposure=False), effects_off.bare(fit_of(clip, steps=8, exposure=False))
    assert not isinstance(bare.effects, type(off.effects)) and off.effects.shadow is None
    seconds = effects_off.measure(off, bare, 8)
    assert seconds.shape == (8, 2) and (seconds > 0).all() and off.progress.step == bare.progress.step == 8
    assert effects_off.alike(off, bare)
    with torch.no_grad():
        bare.scene.sh0[0, 0] += 1e-6
    assert not effects_off.alike(off, bare)


def test_a_world_is_scaled_by_hips_on_which_all_cameras_agree():
    true = np.array([[0, 0, 4.0], [0.5, 0, 4], [0, 9, 9]])
    hips = Hips(true, true / np.array([[1.1], [1.1], [7]]), np.array([True, True, False]))
    assert hips.scale == pytest.approx(1.1)
    assert angle_between(np.array([0, 0, 2.0]), np.array([-3.0, 0, -3])) == pytest.approx(135)


def test_who_is_undressed_to_be_posed_goes_with_the_bones_that_carried_the_clothes():
    dressed = dress(make_avatar(read_body_model(), every=40), some_clothes())
    bare = posing.undressed(dressed)
    assert bare.clothes is None and bare.lbs_weights.shape == (len(dressed), 24)
    np.testing.assert_allclose(bare.lbs_weights.sum(1), 1)
    found, many = posing.measure(dressed, 3), posing.at_once(dressed, 3)
    use_threads(all_threads())
    assert many["poses"] == 3 and many["ratio"] == many["at once"]["median"] / many["by itself"]["median"] > 0
    assert found["bones"] == 5 and all(found[kind]["ratio"] > 0 for kind in ("a pose by itself", "a motion"))
