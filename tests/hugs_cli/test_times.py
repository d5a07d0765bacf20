"""Forecasts of simulated machines, and what they are learned from."""

import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hugs_cli import pipelines, times
from hugs_cli.cache import engine
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Workspace
from hugs_cli.console import Console
from hugs_cli.times import COMPILING, OFF, SHORT, Sizes, here, learn, total, usual, work
from stages import train
from stages.formats.video import write_video
from tests.made.said import holds

USUAL = times.USUAL["default"][1]
WHOLE = sum(seconds for name, seconds in USUAL.items() if name != "frames")


@pytest.fixture
def free(monkeypatch, tmp_path):
    """A machine without earlier runs; what is written into the list is the share of it that is free."""
    share = [1.0]
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(times, "free", lambda: (share[0], share[0]))
    monkeypatch.setattr(train, "compiled", lambda: True)
    return share


@cache
def loaded(count: int, steps: int, pipeline: str) -> pipelines.Pipeline:
    return pipelines.load(pipeline, (f"frames.count={count}", f"train.steps={steps}"), pipelines.FILE)


def session(work: Path, count: int = 80, steps: int = 1400, pipeline: str = "default") -> Session:
    video = work / "clip.mp4"
    clip = Session(Workspace(video, work, pipeline), loaded(count, steps, pipeline), {"video": video})
    frames = clip.workspace.links / "frames" / "frames.json"
    frames.parent.mkdir(parents=True, exist_ok=True)
    frames.write_text(json.dumps({"frames": [{}] * count, "width": 480, "height": 864}))
    return clip


def solved(clip: Session, verdict: str) -> Session:
    """The clip with a result of `sfm`."""
    (clip.workspace.links / "sfm").mkdir(exist_ok=True)
    (clip.workspace.links / "sfm" / "sfm.json").write_text(json.dumps({"verdict": verdict}))
    return clip


def run(clip: Session, seconds: dict[str, float], device: str = "cpu") -> None:
    """What a run leaves that took `seconds`."""
    for name, stage in clip.pipeline.stages.items():
        learn(clip, stage, seconds[name], device)


def forecast(clip: Session, device: str = "cpu") -> times.Guess:
    """Of all that follows the frames."""
    return total(here(device).forecast(clip, [name for name in clip.pipeline.stages if name != "frames"]).values())


def test_the_usual_clip_takes_the_usual_time_where_nothing_was_run(free, tmp_path):
    assert forecast(session(tmp_path)) == pytest.approx((WHOLE, OFF[0], 0))
    free[0] = 0.5
    assert forecast(session(tmp_path)).seconds == pytest.approx(2 * WHOLE)
    few = here("cpu").forecast(session(tmp_path), ["frames"])
    assert few["frames"].seconds == USUAL["frames"], "of so short a run it is not found out how busy the machine is"


def test_other_work_slows_most_what_all_processors_do(tmp_path, monkeypatch, free):
    monkeypatch.setattr(times, "free", lambda: (0.8, 0.4))
    slow = {name: here("cpu").forecast(session(tmp_path), ["train", name])[name].seconds for name in USUAL}
    slow = {name: seconds / USUAL[name] for name, seconds in slow.items()}
    assert 1.25 < slow["smpl"] < slow["frames"] < slow["masks"] < slow["train"] < 2.5


def test_nine_of_ten_runs_take_within_a_factor_of_one_and_a_half_of_what_was_said(free, tmp_path, monkeypatch):
    """Machines of any speed, clips of any size, runs beside none, one or two busy processes, each stage off by chance."""
    rng, off = np.random.default_rng(0), []
    for machine in range(10):
        monkeypatch.setenv("HUGS_CACHE", str(tmp_path / f"{machine}"))
        pace, own = np.exp(rng.normal(0, 0.5)), {name: np.exp(rng.normal(0, 0.15)) for name in USUAL}
        for earlier in range(3):
            clip = session(tmp_path, int(rng.choice([30, 80, 200])), int(rng.choice([300, 1400, 5000])))
            sizes, free[0] = times.sizes_of(clip, ()), rng.choice([1.0, 0.6, 0.4])
            took = {
                name: pace * own[name] * usual("default", name, sizes) / free[0] * np.exp(rng.normal(0, 0.2))
                for name in USUAL
            }
            if earlier:
                off.append(forecast(clip).seconds / sum(took.values()))
            run(clip, took)
    assert np.mean(np.abs(np.log(off)) < np.log(1.5)) >= 0.9


def test_more_runs_make_it_surer_and_those_of_the_same_pipeline_count_first(free, tmp_path):
    clip, other = session(tmp_path), session(tmp_path, pipeline="paper")
    for runs, slow in ((1, 2.0), (2, 2.0), (3, 2.0)):
        run(clip, {name: slow * seconds for name, seconds in USUAL.items()})
        guess = forecast(clip)
        assert guess.seconds == pytest.approx(2 * WHOLE)
        assert guess.off == pytest.approx(OFF.get(runs, times.FEW))
    assert forecast(other).seconds == pytest.approx(2 * WHOLE), "better than nothing"
    run(other, dict(USUAL))
    assert forecast(other).seconds == pytest.approx(WHOLE)
    low, high = times.said(times.Guess(600, 2.0)), times.said(times.Guess(600, 1.25))
    assert holds(low, "5m 00s", "20m 00s") and holds(high, "8m 00s", "12m 30s")


def test_a_stage_that_was_run_says_how_fast_the_others_are(free, tmp_path):
    clip = session(tmp_path)
    learn(clip, clip.pipeline.stages["masks"], 3 * USUAL["masks"], "cpu")
    assert here("cpu").forecast(clip, ["train"])["train"].seconds == pytest.approx(3 * USUAL["train"])
    assert here("cuda").forecast(clip, ["train"])["train"].seconds == pytest.approx(USUAL["train"]), "another device"


def test_a_long_training_of_small_pictures(free, tmp_path):
    few, many = Sizes(80, 100 * 100, 300), Sizes(80, 200 * 200, 3000)
    assert work("train", many) / work("train", few) == pytest.approx(2 * 3300 / 460)
    assert work("render", many) == 2 * work("render", few) and work("masks", Sizes(40)) == 0.5
    clip = session(tmp_path, 40, 600)
    assert times.sizes_of(clip, ()) == Sizes(40, 480 * 864, 600)
    assert times.sizes_of(clip, ["frames", "sfm"]) == Sizes(40, 960 * 540, 600)


def test_a_film_that_has_less_than_is_asked_for_is_as_long_and_large_as_it_is(free, tmp_path):
    write_video(tmp_path / "clip.mp4", np.zeros((12, 48, 64, 3), np.uint8), 30.0)
    assert times.sizes_of(session(tmp_path), ["frames"]) == Sizes(12, 64 * 48, 1400)


def film(file: Path, moves: bool) -> None:
    """A second of a pattern that takes three quarters of the picture, or all of it and moves; what is left changes."""
    rng = np.random.default_rng(0)
    wall = rng.integers(0, 255, (12, 20, 3)).repeat(16, 0).repeat(16, 1)
    shown = [np.roll(wall, 4 * i * moves, 1).astype(np.uint8) for i in range(30)]
    for i, picture in enumerate(shown):
        picture[:, :80] = (80 + 5 * i) % 255
    write_video(file, np.stack(shown), 30.0)


def test_a_camera_that_stands_is_known_at_a_glance_and_then_by_sfm(free, tmp_path):
    """A scene is trained of a camera that moves, and where that is not known."""
    clip, todo = session(tmp_path), ["sfm", "train"]
    assert times.sizes_of(clip, todo)[3:] == (True, True), "there is no film"
    for moves in (True, False):
        clip = session(tmp_path / str(moves))
        film(clip.video, moves)
        assert times.sizes_of(clip, todo)[3:] == (moves, moves)
    known = {"moving": (True, True), "rotation only": (True, False), "static camera": (False, False)}
    for verdict, sizes in known.items():
        assert times.sizes_of(solved(clip, verdict), ["train"])[3:] == sizes
        assert times.sizes_of(clip, todo)[3:] == (False, False), "the result of an earlier run"
    assert not times.sizes_of(solved(session(tmp_path / "only", pipeline="human_only"), "moving"), ["train"]).scene


def test_when_sfm_has_ended_what_follows_is_guessed_again_if_the_camera_turns_out_to_stand(free, tmp_path):
    clip, todo = session(tmp_path), ["sfm", "smpl", "train", "render"]
    known, first = here("cpu"), here("cpu").forecast(clip, todo)
    assert known.again(solved(clip, "moving"), todo) == {} == known.again(clip, todo[1:])
    again = known.again(solved(clip, "static camera"), todo)
    assert list(again) == todo and again["smpl"] == first["smpl"] and again["sfm"].seconds < first["sfm"].seconds / 5
    assert again["train"].seconds == pytest.approx(95, rel=0.05)
    assert again["render"].seconds < 0.6 * first["render"].seconds
    assert known.again(clip, todo[1:]) == {}, "it is known already"


def test_a_run_is_counted_down_by_what_its_stages_show(free, tmp_path, monkeypatch):
    clip, console = session(tmp_path), Console(io.StringIO(), io.StringIO())
    clip.video.write_bytes(b"no film")
    monkeypatch.setattr(engine, "check", lambda *given: None)
    monkeypatch.setattr(engine, "make", lambda *given: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        held = SimpleNamespace(launcher=None, page=None)
        engine.bring(held, clip, list(clip.pipeline.stages), frozenset(), "cpu", console)
    first = dict(console.countdown.stages)
    learn(clip, clip.pipeline.stages["masks"], 4 * USUAL["masks"], "cpu")
    solved(clip, "static camera")
    again = console.countdown.again(["sfm", "smpl", "train"])
    assert again["train"].seconds < first["train"].seconds / 2, "there is no scene"
    assert again["smpl"] == first["smpl"], "what this run shows of the machine is the countdown's"


def test_runs_with_a_scene_and_without_are_not_mixed_up(free, tmp_path):
    with_scene, without = (solved(session(tmp_path / name), name) for name in ("moving", "static camera"))
    run(with_scene, {name: 2 * seconds for name, seconds in USUAL.items()})
    for _ in range(3):
        run(without, {name: seconds if name in ("train", "sfm") else 2 * seconds for name, seconds in USUAL.items()})
    after = here("cpu").forecast(with_scene, ["sfm", "train", "smpl"])
    assert [after[name].seconds for name in after] == pytest.approx([2 * USUAL[name] for name in after])
    assert here("cpu").forecast(without, ["train"])["train"].seconds == pytest.approx(USUAL["train"])


def test_rows_of_a_file_that_knew_no_scene_are_read(free, tmp_path):
    clip = session(tmp_path)
    run(clip, {name: 2 * seconds for name, seconds in USUAL.items()})
    rows = json.loads(times.file().read_text())["rows"]
    for row in rows:
        row["sizes"] = {name: row["sizes"][name] for name in ("frames", "pixels", "steps")}
    times.file().write_text(json.dumps({"rows": rows}))
    assert len(times.kept()) == len(USUAL) and forecast(clip).seconds == pytest.approx(2 * WHOLE)


@pytest.mark.parametrize(
    ("pipeline", "sizes", "took"),
    [
        ("default", Sizes(80, 480 * 864, 1400), 448),
        ("default", Sizes(60, 384 * 512, 1400), 329),
        ("default", Sizes(80, 640 * 360, 1400), 335),
        ("default", Sizes(80, 960 * 540, 1400, False, False), 218),
        ("default", Sizes(60, 480 * 480, 1400, False, False), 161),
        ("preview", Sizes(20, 267 * 480, 200), 54),
        ("preview", Sizes(20, 360 * 480, 200), 56),
        ("preview", Sizes(20, 270 * 480, 200, False, False), 50),
        ("preview", Sizes(20, 480 * 480, 200, False, False), 42),
    ],
)
def test_runs_on_an_idle_machine_took_about_as_long_as_is_usual(pipeline, sizes, took):
    """docs/benchmarks/table.json; `preview` promises a minute."""
    assert 1 / 1.3 < sum(usual(pipeline, stage, sizes) for stage in USUAL) / took < 1.3


def test_a_preview_takes_a_minute_and_on_a_slow_machine_as_many_times_as_long_as_other_pipelines_did(free, tmp_path):
    clip = session(tmp_path, 20, 200, "preview")
    todo = list(clip.pipeline.stages)
    assert total(here("cpu").forecast(clip, todo).values()).seconds == pytest.approx(52.5, rel=0.05)
    run(session(tmp_path / "other"), {name: 3 * seconds for name, seconds in USUAL.items()})
    assert total(here("cpu").forecast(clip, todo).values()).seconds == pytest.approx(158, rel=0.05)


@pytest.mark.parametrize("pipeline", times.USUAL)
def test_what_is_usual_was_measured_with_the_settings_that_a_pipeline_has(pipeline, tmp_path):
    """From other numbers of frames and steps a stage's time is only guessed, and shares of the run are wrong."""
    video, known = tmp_path / "clip.mp4", times.USUAL[pipeline][0]
    clip = Session(Workspace(video, tmp_path, pipeline), pipelines.load(pipeline, (), pipelines.FILE), {"video": video})
    sizes = times.sizes_of(clip, ["frames", "sfm"])
    assert (sizes.frames, sizes.steps) == (known.frames, known.steps) and sizes.pixels == pytest.approx(
        known.pixels, rel=0.3
    )


def test_what_tells_nothing_is_not_kept(free, tmp_path, monkeypatch):
    monkeypatch.setattr(times, "KEPT", 5)
    clip = session(tmp_path)
    train = clip.pipeline.stages["train"]
    learn(clip, train, SHORT / 2, "cpu")
    learn(clip, replace(train, params=train.params.model_copy(update={"seconds": 600.0})), 500.0, "cpu")
    small = Sizes(frames=12, pixels=192 * 256, steps=8)
    with monkeypatch.context() as patch:
        patch.setattr("hugs_cli.times.sizes_of", lambda session, todo: small)
        learn(clip, train, 3.0, "cpu")
    assert times.kept() == []
    learn(clip, train, 500.0, "cpu")
    assert [row.seconds for row in times.kept()] == [500]
    for _ in range(times.KEPT):
        learn(clip, train, 700.0, "cpu")
    rows = times.kept()
    assert {row.seconds for row in rows} == {700} and len(rows) == times.KEPT


def test_what_compiling_takes_is_expected_where_no_kernels_are_and_learned_from_none(free, tmp_path, monkeypatch):
    clip, there = session(tmp_path), []
    monkeypatch.setattr(train, "compiled", lambda: bool(there))
    first = forecast(clip)
    assert (first.seconds, first.compiling) == pytest.approx((WHOLE + COMPILING, COMPILING))
    assert holds(times.said(first), "34.0 s") and not holds(times.said(first._replace(compiling=0.0)), "34.0 s")
    assert not here("cpu").forecast(clip, ["train"], first=False)["train"].compiling, "another run compiles before"
    assert not here("cuda").forecast(clip, ["train"])["train"].compiling, "of a CPU"
    for name, stage in clip.pipeline.stages.items():
        compiling = COMPILING if name == "train" else 0.0
        learn(clip, stage, 2 * USUAL[name] + compiling, "cpu", compiling)
    assert forecast(clip).compiling == pytest.approx(2 * COMPILING), "as slow as that machine is, until they are there"
    there.append(True)
    assert forecast(clip)[::2] == pytest.approx((2 * WHOLE, 0)), "nor is it taken for a slow machine"


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"rows": 3}',
        '{"rows": [{"stage": "train"}]}',
        '{"rows": [["train", "m", "p", "cpu", 2, [80, -1, 3], 5]]}',
    ],
)
def test_a_file_that_cannot_be_read_is_as_none(free, tmp_path, content):
    times.folder().mkdir(parents=True)
    times.file().write_text(content)
    assert times.kept() == [] and forecast(session(tmp_path)).off == OFF[0]
    run(session(tmp_path), dict(USUAL))
    assert len(times.kept()) == len(USUAL)
