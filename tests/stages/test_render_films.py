"""The films of a result: they decode, show the side they should, and stand where the person stood."""

import json
import shutil

import numpy as np
import pytest

from stages import render
from stages.contract import Job
from stages.formats.clip import load_clip
from stages.formats.video import decode
from tests.made.tiny import EMPTY, FOCAL, HEIGHT, WIDTH, colour_of, make_poses, make_viewmats

RED_SIDE, BLUE_SIDE, ARM, HEAD = range(4)
PARAMS = render.Params(fps=8, turntable_frames=8, motion_seconds=1.0)


def run(clip, out):
    notes = []
    render.run(Job(out, emit=notes.append), PARAMS, **{name: clip[name] for name in ("sfm", "smpl", "train")})
    films = {path.stem: np.stack([image for _, _, image in decode(path)]) for path in out.glob("*.mp4")}
    return films, next(n["text"] for n in notes if n["event"] == "note")


@pytest.fixture(scope="module")
def films(tiny, tmp_path_factory):
    return run(tiny, tmp_path_factory.mktemp("render"))[0]


def middle(found):
    return np.argwhere(found).mean(0)  # row, column


def test_the_turntable_begins_with_the_face_and_goes_around(films):
    frames = films["turntable"]
    assert frames.shape == (8, 640, 640, 3) and (frames[:, :8, :8] > 245).all(), "white around"
    front, back = colour_of(frames[0]), colour_of(frames[4])
    assert (front == RED_SIDE).sum() > 3 * (front == BLUE_SIDE).sum()
    assert (back == BLUE_SIDE).sum() > 3 * (back == RED_SIDE).sum()
    assert middle(front == ARM)[1] > 400 and middle(back == ARM)[1] < 240, "its left arm is on our right, seen in front"
    assert middle(front == HEAD)[0] < 160, "head up"
    rows, columns = np.nonzero(front >= 0)
    assert 0.75 * 640 < rows.max() - rows.min() < 630 and columns.min() > 0 and columns.max() < 639


def test_held_out_frames_stand_beside_the_clip(films, tiny):
    frames, clip = films["heldout"], load_clip(tiny["sfm"], tiny["smpl"])
    assert frames.shape == (2, HEIGHT, 2 * WIDTH, 3)
    for picture, i in zip(frames, np.flatnonzero(clip.heldout), strict=True):
        left, right = picture[:, :WIDTH].astype(float), picture[:, WIDTH:].astype(float)
        assert np.abs(left - clip.images(i)).mean() < 6 and np.abs(right - left).mean() < 4
    assert not clip.shows_person(EMPTY) and (colour_of(frames[1]) < 0).all(), "nobody is drawn where nobody is"


def test_the_motion_stands_upright_where_the_person_stood(films):
    frames = films["motion"]
    assert frames.shape == (8, HEIGHT, WIDTH, 3)
    place, view = make_poses().transl[4], make_viewmats()[4]
    x, _, z = view[:3, :3] @ place + view[:3, 3]
    seen = colour_of(frames[0])
    feet = np.argwhere((seen == RED_SIDE) | (seen == BLUE_SIDE))[-20:].mean(0)
    head = middle(seen == HEAD)
    for _, column in (feet, head):
        assert column == pytest.approx(WIDTH / 2 + FOCAL * x / z, abs=5), "upright over one spot"
    assert head[0] < feet[0] - 35
    assert (seen == RED_SIDE).sum() > 2 * (seen == BLUE_SIDE).sum(), "it faces the camera as it did in the clip"
    assert middle(seen == ARM)[1] > head[1]
    assert middle(colour_of(frames[4]) == ARM)[0] < head[0], "arms up in the middle of a jumping jack"


def test_the_scene_film_shows_nobody(films):
    assert films["scene"].shape == (8, HEIGHT, WIDTH, 3)
    assert (colour_of(films["scene"]) < 0).all() and films["scene"].std((1, 2)).min() > 8


def test_a_clip_without_a_scene_is_filmed_over_white(tiny_human, tmp_path):
    films, note = run(tiny_human, tmp_path)
    assert set(films) == {"heldout", "turntable", "motion"} and "scene.mp4" not in note
    assert len(films["heldout"]) == 1, "the frame without a person has nothing to show"
    assert (films["heldout"][0, :8, WIDTH : WIDTH + 8] > 245).all() and (films["motion"][:, :8, :8] > 245).all()
    assert (colour_of(films["heldout"][0, :, WIDTH:]) >= 0).sum() > 300


def test_held_out_frames_are_shown_at_their_own_exposure(tiny, tmp_path):
    clip = load_clip(tiny["sfm"], tiny["smpl"])
    first = int(np.flatnonzero(clip.heldout)[0])
    train = tmp_path / "train"
    shutil.copytree(tiny["train"], train)
    facts = json.loads((train / "train.json").read_text())
    facts["exposure"] = {clip.names[first]: [0.5, 0.5, 0.5]}
    (train / "train.json").write_text(json.dumps(facts))
    (tmp_path / "out").mkdir()
    darker = run(tiny | {"train": train}, tmp_path / "out")[0]["heldout"][0]
    left, right = darker[:, :WIDTH].astype(float), darker[:, WIDTH:].astype(float)
    assert np.abs(right - 0.5 * left).mean() < 4 and left.mean() > 40


def test_a_motion_of_less_than_two_pictures_is_refused_before_anything_runs():
    with pytest.raises(ValueError, match="less than two pictures"):
        render.Params(fps=24, motion_seconds=0.05)


def test_l13_a_clip_too_short_to_hold_a_frame_out_has_no_such_film(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_FIRST", 99)
    assert set(run(tiny, tmp_path)[0]) == {"turntable", "motion", "scene"}
