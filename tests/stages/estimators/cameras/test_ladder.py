"""Which way of mapping is taken, and what is said of a clip that none of them could place; cases I01 to I21."""

import json
import time
from dataclasses import asdict, dataclass
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras import pinhole as cameras
from stages.commands.report import clip as report
from stages.contract import Job, StageError
from stages.estimators.cameras import colmap, colmap_features, ladder, short_walk
from stages.estimators.cameras.intrinsics import FOCAL_SPREAD
from stages.estimators.cameras.ladder import Matched, Rung, best_rung, climb
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import write_ignored
from stages.estimators.cameras.verdict import Footage, components, judge_cameras, name_frames, sharpness
from stages.formats.cameras import read_cameras
from stages.formats.facts import Sfm, parse
from stages.formats.images import read_image, write_image
from tests.made import rooms as room
from tests.made.rooms import run, walk, write_clip
from tests.made.said import any_holds, holds
from tests.made.worlds import umeyama

NAMES = [f"{3 * i:06d}" for i in range(10)]


@dataclass
class Made:
    """What the ladder asks of a model."""

    registered: int
    focal: float = 800.0
    error: float = 0.5
    points: int = 4000

    def facts(self):
        return asdict(self)


def matched_of(folder, count: int = 80, need: int = 40, fixed_focal: bool = False) -> Matched:
    return Matched(folder / "database.db", folder / "frames/images", folder, count, 864, need, 2, fixed_focal)


def extracted(folder, views: np.ndarray, features: int = 1024, overlap: int | None = None) -> Matched:
    """A rendered clip with features and matches, without a person."""
    write_clip(folder, views, person=False)
    names, files = NAMES[: len(views)], [f"{name}.png" for name in NAMES[: len(views)]]
    write_ignored(names, folder / "masks", folder / "ignored", room.WIDTH)
    matched = matched_of(folder, len(views), len(views))
    colmap_features.extract(matched.database, matched.images, folder / "ignored", files, features, [])
    colmap_features.match(
        matched.database, overlap or len(names).bit_length(), growing=overlap is None, side=room.WIDTH
    )
    return matched


def climbed(monkeypatch, tmp_path, *models_by_rung, **settings):
    """Rungs and events of a ladder whose rungs make these models."""
    tries, events = [], []

    def rung(models, matched, out, placed):
        tries.append(out)
        for _ in range(100):
            placed()
        return models

    rungs = {f"way {i}": partial(rung, models) for i, models in enumerate(models_by_rung)}
    monkeypatch.setattr(ladder, "RUNGS", rungs)
    matched = matched_of(tmp_path, **settings)
    found = climb(Job(tmp_path, emit=events.append), matched)
    assert len(set(tries)) == len(tries) == len(found)
    return matched, found, events


def test_the_first_good_rung_ends_the_ladder_without_a_word(monkeypatch, tmp_path):
    matched, rungs, events = climbed(monkeypatch, tmp_path, [Made(72)], [Made(80)])
    assert [rung.how for rung in rungs] == ["way 0"] and matched.good(rungs[0].models[0])
    assert {event["event"] for event in events} == {"progress"}


def test_every_rung_after_the_first_is_said_and_kept(monkeypatch, tmp_path):
    ways = [], [Made(71)], [Made(80, focal=4000.0)], [Made(80, error=2.5)], [Made(80, points=7)], [Made(75)], [Made(80)]
    _, rungs, events = climbed(monkeypatch, tmp_path, *ways)
    assert [rung.how for rung in rungs] == [f"way {i}" for i in range(6)], "the sixth is good, the seventh not tried"
    notes = [event["text"] for event in events if event["event"] == "note"]
    assert len(notes) == 6
    assert holds(notes[0], "way 0", 100, "points", "0 s", "way 1", "120 s") and "71 of 80 frames" in notes[1]
    assert "4000 px" in notes[2] and "2.5 px off" in notes[3] and "no model" in notes[4] and "75 of 80" in notes[5]
    kept = json.loads(json.dumps([rung.facts() for rung in rungs]))
    assert kept[1] == {"how": "way 1", "models": [asdict(Made(71))]} and kept[0]["models"] == kept[4]["models"] == []
    done = [event["done"] for event in events if event["event"] == "progress"]
    assert done == sorted(done) and done[0] >= 60 and done[-1] <= 85


def test_every_mapper_is_told_when_to_stop_and_a_word_comes_before_each(monkeypatch, tmp_path):
    limits, events = [], []
    monkeypatch.setattr(colmap, "map_global", lambda *args: limits.append(args[5]) or [])
    monkeypatch.setattr(colmap, "map_incremental", lambda *args: limits.append(args[5]) or [])
    monkeypatch.setattr(colmap_features, "match", lambda *args, **how: None)
    climb(Job(tmp_path, emit=events.append), matched_of(tmp_path))
    assert limits == [ladder.SECONDS] * len(ladder.RUNGS) and ladder.SECONDS < 300 / 2
    notes = [event for event in events if event["event"] == "note"]
    assert [note.get("at_once", False) for note in notes] == [True] * (len(ladder.RUNGS) - 1) + [False]


@pytest.mark.slow
def test_a_mapper_stops_when_it_is_told_to(tmp_path):
    matched = extracted(tmp_path, walk(7, 1.4, 2.0), features=512)
    soon, late = (tmp_path / name for name in ("soon", "late"))
    (whole,) = colmap.map_incremental(matched.database, matched.images, late, False, lambda: None, 60)
    models = colmap.map_incremental(matched.database, matched.images, soon, False, lambda: time.sleep(1.2), 1)
    assert whole.registered == 7 and max((model.registered for model in models), default=0) < 5, (
        "two frames begin, each takes 1.2 s"
    )


def test_i06_the_best_model_may_come_third(monkeypatch, tmp_path):
    models = [Made(30), Made(12, error=0.1), Made(41, error=0.9), Made(41, error=0.8)]
    matched, rungs, _ = climbed(monkeypatch, tmp_path, [Made(39)], models, [])
    rung = best_rung(matched, rungs)
    assert rung.how == "way 1" and rung.models[0] is models[3] and rung.models[-1] is models[1]


@pytest.mark.parametrize("focal", [200.0, 2700.0])
def test_i21_a_wandering_focal_length_loses_to_fewer_frames(monkeypatch, tmp_path, focal):
    matched, rungs, _ = climbed(monkeypatch, tmp_path, [Made(80, focal=focal), Made(50)])
    assert rungs[0].models[0].registered == 50
    few = sorted([Made(80, focal=focal), Made(39)], key=matched.rank)
    assert few[-1].registered == 80, "but not to too few of them"
    assert matched_of(tmp_path, fixed_focal=True).good(Made(80, focal=focal)), "one that the user gave is believed"


def test_of_equal_rungs_the_first_wins_and_none_is_no_crash(tmp_path):
    matched = matched_of(tmp_path)
    rungs = [Rung("a", [], 0), Rung("b", [Made(50)], 0), Rung("c", [Made(50)], 0)]
    assert best_rung(matched, rungs).how == "b" and best_rung(matched, rungs[:1]).models == []


@pytest.fixture(scope="module")
def close(tmp_path_factory):
    """Four frames so close together that COLMAP's incremental mapper finds no pair to begin with."""
    return extracted(tmp_path_factory.mktemp("close"), walk(4, 0.4, 2.0))


@pytest.mark.slow
def test_colmap_maps_with_a_small_first_angle_what_it_cannot_by_itself(close, monkeypatch):
    for how in list(ladder.RUNGS):
        if how.startswith("global"):
            monkeypatch.delitem(ladder.RUNGS, how)
    rungs = climb(Job(close.scratch), close)
    assert [(rung.how, len(rung.models)) for rung in rungs] == [
        ("incremental mapper", 0),
        ("incremental mapper, small first angle", 1),
    ]
    (model,) = rungs[1].models
    assert model.registered == 4 and model.focal == pytest.approx(room.FOCAL, rel=0.03) and model.error < 0.3


def test_more_pairs_are_matched_and_i17_the_same_clip_gives_the_same_model(close, tmp_path):
    files = [f"{name}.png" for name in NAMES[:4]]
    assert len(colmap_features.read_pairs(close.database, files)[0]) == 5
    made = []
    for i in range(2):
        models = ladder.RUNGS["global mapper, more pairs"](close, tmp_path / f"{i}", lambda: None)
        made.append([(model.facts(), {name: pose.tolist() for name, pose in model.poses.items()}) for model in models])
    assert len(colmap_features.read_pairs(close.database, files)[0]) == 6
    assert made[0] == made[1] and made[0][0][0]["registered"] == 4


@pytest.mark.slow
def test_i01_a_camera_that_does_little_more_than_turn_goes_on_turning_where_nothing_can_be_mapped(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(ladder, "RUNGS", {"incremental mapper": ladder.by_incremental})
    monkeypatch.setattr(short_walk, "compare", lambda *given: None)  # which finds the walk in these three frames
    views = walk(3, 0.3, 2.0)
    write_clip(tmp_path, views, person=False)
    facts, events = run(tmp_path, features=1024)
    motion = facts["motion"]
    assert 1 < motion["rotation_residual_px"] / motion["rotation_limit_px"] < 3
    assert facts["verdict"] == "rotation only" and facts["registered"] == 3 and facts["points"] == 0
    assert facts["rungs"] == [{"how": "incremental mapper", "models": []}] and facts["trouble"] is None
    assert any(holds(event.get("text", ""), "camera", "turn", "only the person") for event in events)
    assert facts["lens"]["focal_spread_px"] == pytest.approx(FOCAL_SPREAD * facts["focal_px"], abs=0.01)
    found = read_cameras(tmp_path / "out/cameras.npz")
    assert np.allclose(found.viewmats[:, :3, 3], 0)
    off = found.viewmats[:, :3, :3] @ (views[:, :3, :3] @ views[0, :3, :3].T).mT
    angles = Rotation.from_matrix(off).magnitude()
    assert np.degrees(angles).max() < 5, "0.6 m past walls 5 to 7 m away look like a turn of 5 degrees"


def test_i02_frames_without_texture_are_named(tmp_path):
    write_clip(tmp_path, walk(3, 1.0))
    for path in (tmp_path / "frames/images").iterdir():
        write_image(path, np.full((room.HEIGHT, room.WIDTH, 3), 80, np.uint8))
    with pytest.raises(StageError) as error:
        run(tmp_path, camera="moving")
    assert holds(str(error.value), "no two frames match", "texture")
    facts = error.value.facts
    assert any_holds(facts, 100, "features", "3 of 3 frames", "000000", "000006")
    assert any_holds(facts, "verified pairs", 0)
    assert any_holds(facts, "features", 0, 0, "median") and "sfm.camera=fixed" in error.value.hint


def matches(first: int, second: int, count: int) -> Pair:
    return Pair(first, second, np.zeros((count, 2)), np.zeros((count, 2)))


def chosen(*positions: int) -> np.ndarray:
    return np.isin(np.arange(10), positions)


SHARP, RICH = np.full(10, 2.0), np.full(10, 900)


def test_i06_two_models_are_named_with_the_cut():
    pairs = [matches(i, i + 1, 300) for i in range(9) if i != 5] + [matches(5, 6, 21), matches(4, 6, 16)]
    posed = [chosen(0, 1, 2, 3, 4, 5), chosen(5, 6, 7, 8), chosen(1, 2)]
    verdict = judge_cameras(NAMES, posed, RICH, SHARP, pairs)
    assert verdict.name == "two separate models" and "min_share" in verdict.hint
    larger, smaller, cut = verdict.facts
    assert holds(larger, "6 of 10 frames", "000000", "000015") and holds(smaller, "3 of 10 frames", "000018", "000024")
    assert holds(cut, "cut", "000015", "000018", "37 matches", 300)
    later = judge_cameras(NAMES, [chosen(5, 6, 7, 8, 9), chosen(0, 1, 2, 3, 4)], RICH, SHARP, pairs)
    assert holds(later.facts[2], "cut", "000012", "000015", "316 matches"), "the larger may come later"
    third = judge_cameras(NAMES, [chosen(0, 1, 2, 3), chosen(4, 5, 6), chosen(7, 8, 9)], RICH, SHARP, pairs)
    assert third.name == "3 separate models" and len(third.facts) == 4
    small = judge_cameras(NAMES, [chosen(0, 1, 2, 3), chosen(4, 5)], RICH, SHARP, pairs)
    assert small.name is None, "a second model of a third of the frames that lack a pose explains too little"


@pytest.mark.slow
def test_i06_two_rooms_in_one_clip_go_on_with_the_larger_or_fail(monkeypatch, tmp_path):
    monkeypatch.setattr(ladder, "RUNGS", {"global mapper": ladder.by_global})
    monkeypatch.setattr(short_walk, "compare", lambda *given: None)  # no mapper, and slow
    write_clip(tmp_path, walk(7, 1.2), person=False)
    other = [(normal, offset, room.texture(20 + i)) for i, (normal, offset, _) in enumerate(room.WALLS)]
    monkeypatch.setattr(room, "WALLS", other)
    for i, view in enumerate(walk(3, 0.4, 2.0)):
        write_image(tmp_path / f"frames/images/{NAMES[4 + i]}.png", room.photograph(view))
    facts, events = run(tmp_path, features=1024)
    assert facts["verdict"] == "moving" and facts["trouble"] == "two separate models"
    assert facts["dropped"] == NAMES[4:7]
    assert [model["registered"] for model in facts["rungs"][0]["models"]] == [4, 3]
    (warning,) = [e["text"] for e in events if e["event"] == "warning" and holds(e["text"], "4 of 7")]
    assert holds(warning, "3 of 7 frames", "000012 to 000018") and holds(warning, "000009", "000012", "0 matches")
    (tmp_path / "strict").mkdir()
    for kind in ("frames", "masks"):
        (tmp_path / "strict" / kind).symlink_to(tmp_path / kind)
    with pytest.raises(StageError, match=r"4 of 7 frames.*\b6\b.*separate models") as error:
        run(tmp_path / "strict", features=1024, min_share=0.8)
    assert any_holds(error.value.facts, "global mapper", "4 of 7 frames")


@pytest.mark.slow
def test_i07_a_frame_without_a_pose_is_dropped_by_name(monkeypatch, tmp_path):
    monkeypatch.setattr(ladder, "RUNGS", {"global mapper": ladder.by_global})
    monkeypatch.setattr(short_walk, "compare", lambda *given: None)  # no mapper, and slow
    views = walk(6, 1.2)
    write_clip(tmp_path, views, person=False)
    write_image(tmp_path / f"frames/images/{NAMES[2]}.png", np.full((room.HEIGHT, room.WIDTH, 3), 80, np.uint8))
    facts, events = run(tmp_path, features=1024)
    assert facts["registered"] == 5 and facts["dropped"] == [NAMES[2]] and facts["trouble"] == "too little texture"
    assert any(holds(event.get("text", ""), "5 of 6 frames", "texture") for event in events)
    found = read_cameras(tmp_path / "out/cameras.npz")
    assert list(found.names) == [NAMES[i] for i in (0, 1, 3, 4, 5)]
    truth = cameras.camera_centers(views[[0, 1, 3, 4, 5]])
    scale, R, t = umeyama(found.centers, truth)
    assert np.linalg.norm(scale * found.centers @ R.T + t - truth, axis=1).max() < 0.02 * 2.4  # of the path's length


def test_i08_blurred_frames_are_found_whatever_their_texture(tmp_path):
    write_clip(tmp_path, walk(6, 1.0))
    folder = tmp_path / "frames/images"
    write_ignored(NAMES[:6], tmp_path / "masks", tmp_path / "ignored", room.WIDTH)

    def change(i, how):
        path = folder / f"{NAMES[i]}.png"
        write_image(path, how(read_image(path)))

    change(1, lambda image: cv2.GaussianBlur(image, (0, 0), 4.0))
    change(2, lambda image: cv2.blur(image, (15, 1)))  # a shake to the side
    change(3, lambda image: (100 + image / 16).astype(np.uint8))  # hardly any texture, but sharp
    change(4, lambda image: np.full_like(image, 80))
    sharp = sharpness(folder, tmp_path / "ignored", [f"{name}.png" for name in NAMES[:6]])
    assert (sharp[[1, 2]] < 1.25).all() and (sharp[[0, 3, 5]] > 1.7).all() and np.isnan(sharp[4])


def test_i08_blur_is_named_where_it_keeps_frames_from_being_placed(tmp_path):
    blurred, few = np.where(chosen(2, 3, 8), 1.1, SHARP), np.where(chosen(2, 3, 4), 20, RICH)
    verdict = judge_cameras(NAMES, [~chosen(2, 3, 4)], few, blurred, [])
    assert verdict.name == "too blurred" and "light" in verdict.hint
    longest, poor, soft = verdict.facts
    assert holds(longest, "longest", "000015", "000027") and holds(
        soft, "blurred", "3 of 10", "000006", "000009", "000024"
    )
    assert holds(poor, 100, "features", "3 of 10 frames", "000006", "000012")
    assert judge_cameras(NAMES, [~chosen(2, 3, 4)], few, SHARP, []).name == "too little texture"
    assert judge_cameras(NAMES, [~chosen(0, 9)], few, blurred, []).name is None, "only of frames without a pose"


def test_frames_missing_without_a_cause_are_told_with_the_longest_run():
    posed = chosen(0, 1, 3, 4, 5)
    verdict = judge_cameras(NAMES, [posed], RICH, SHARP, [])
    assert verdict.name is None and len(verdict.facts) == 1 and holds(verdict.facts[0], "000009 to 000015")
    assert holds(*judge_cameras(NAMES, [], RICH, SHARP, []).facts, "no frame")
    assert holds(name_frames(NAMES, chosen(0, 2, 4, 6, 7)), "5 of 10 frames", "000000, 000006, 000012", "1 more")


def test_a_few_frames_left_out_are_a_note(tmp_path):
    events = []
    footage = Footage(NAMES, tmp_path, tmp_path, tmp_path / "database.db", 5)
    assert footage.require(Job(tmp_path, emit=events.append), [~chosen(4)], []) is None
    (note,) = events
    assert note["event"] == "note" and holds(note["text"], "1 of 10 frames", "000012")
    assert footage.require(Job(tmp_path, emit=events.append), [chosen(*range(10))], []) is None and len(events) == 1


def test_parts_of_a_turning_clip_that_nothing_joins():
    pairs = [matches(0, 1, 50), matches(4, 2, 50), matches(4, 7, 50), matches(8, 7, 50)]
    parts = components(pairs, 10)
    assert [np.flatnonzero(part).tolist() for part in parts] == [[2, 4, 7, 8], [0, 1]]
    assert components([], 10) == []


def test_the_report_says_how_the_cameras_were_found():
    rungs = [{"how": "global mapper", "models": []}, {"how": "incremental <1>", "models": [{"registered": 7}] * 2}]
    facts = {"verdict": "moving", "distortion": {"max_shift_px": 0.0}, "of": 9}
    clauses = report._rungs(parse(json.dumps(facts | {"rungs": rungs, "mapper": "incremental <1>"}), Sfm))
    none, some = clauses
    assert holds(none, "global mapper", "0 of 9 frames", "0 models")
    assert some.startswith("incremental <1>") and holds(some, "7 of 9 frames", "2 models")
    assert report._rungs(parse(json.dumps(facts), Sfm)) == []
