"""Stage frames picks sharp frames, spread in time, and refuses too little video."""

import json
import os
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from stages import frames
from stages.contract import Job, StageError
from stages.formats.facts import Listing, read_facts
from stages.formats.film_times import FilmTimes
from stages.formats.frame_names import stem
from stages.formats.images import read_image, write_image
from stages.formats.video import VideoInfo, decode, write_video
from tests.made import ffmpeg
from tests.made.said import any_holds, holds

HEIGHT, WIDTH = 96, 128
TICKS = 15360  # a second, in films of 30 frames a second


def panned(count, blurred=(), step=2.0, seed=0, size=(HEIGHT, WIDTH)):
    """A camera that slides over a random texture, with some frames blurred."""
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(0, 256, (size[0] // 4, size[1], 3), dtype=np.uint8), None, fx=4, fy=4)
    made = [wall[: size[0], int(i * step) : int(i * step) + size[1]] for i in range(count)]
    return [cv2.GaussianBlur(f, (0, 0), 4) if i in blurred else np.ascontiguousarray(f) for i, f in enumerate(made)]


def pick(tmp_path, pictures, fps=30, **params):
    write_video(tmp_path / "v.mp4", pictures, fps=fps)
    return run(tmp_path, tmp_path / "v.mp4", **params)


def run(tmp_path, video, **params):
    out = tmp_path / "out"
    out.mkdir()
    events = []
    frames.run(Job(out=out, emit=events.append), frames.Params(**params), video=video)
    facts = json.loads((out / "frames.json").read_text())
    assert sorted(p.stem for p in (out / "images").iterdir()) == [frame["name"] for frame in facts["frames"]]
    return facts, out, [e["text"] for e in events if e["event"] == "warning"]


def test_i08_picks_one_sharp_frame_a_slot(tmp_path):
    blurred = [i for i in range(60) if i % 3 != 1]
    facts, out, warnings = pick(tmp_path, panned(60, blurred), count=20)
    assert [frame["index"] for frame in facts["frames"]] == list(range(1, 60, 3)) and not warnings
    for frame in facts["frames"]:
        assert frame["name"] == f"{frame['index']:06d}" and abs(frame["time_s"] - frame["index"] / 30) < 1e-3
    original = [picture for _, _, picture in decode(tmp_path / "v.mp4")]
    assert np.array_equal(read_image(out / "images" / "000004.png"), original[4])
    video = facts["video"]
    assert (video["path"], video["width"], video["height"], video["rotation"]) == ("v.mp4", WIDTH, HEIGHT, 0)
    assert (video["fps"], video["frames"], video["duration_s"]) == (30.0, 60, 2.0)
    assert (facts["width"], facts["height"]) == (WIDTH, HEIGHT)
    assert sum(facts["dropped"].values()) + len(facts["frames"]) == 60


def test_i08_i20_a_short_clip_keeps_all_but_copies_and_blur(tmp_path):
    pictures = panned(24, blurred=[7])
    pictures[15] = pictures[14]
    facts, _, _ = pick(tmp_path, pictures, count=80)
    assert facts["dropped"] == {"undecodable": 0, "not_sharpest": 0, "copies": 1, "blurred": 1}
    assert [f["index"] for f in facts["frames"]] == [i for i in range(24) if i not in (7, 15)]


def test_a_small_moving_thing_before_a_still_camera_is_not_a_copy(tmp_path):
    pictures = [panned(1)[0].copy() for _ in range(12)]
    for i, picture in enumerate(pictures):
        cv2.circle(picture, (20 + 7 * i, 40), 5, (255, 255, 255), -1)
    facts, _, _ = pick(tmp_path, pictures)
    assert len(facts["frames"]) == 12


def test_at_a_glance_a_camera_seems_to_move_unless_most_of_the_picture_rests(tmp_path):
    """What cannot be seen is taken to move: a picture alone, a folder, a file that is no film."""
    wall = panned(1)[0]
    still = [wall.copy() for _ in range(20)]
    for i, picture in enumerate(still):
        picture[20 + 2 * i : 60 + 2 * i, : WIDTH // 3] = 12 * i
    for name, pictures, moves in (("pan", panned(20), True), ("still", still, False), ("one", [wall], True)):
        write_video(tmp_path / f"{name}.mp4", pictures, 30.0)
        assert frames.moves(tmp_path / f"{name}.mp4") == moves
    (tmp_path / "text.mp4").write_text("no film")
    assert frames.moves(tmp_path / "text.mp4") and frames.moves(tmp_path) and frames.moves(tmp_path / "none.mp4")


def test_large_videos_are_shrunk_and_small_ones_left(tmp_path):
    facts, out, _ = pick(tmp_path, panned(10, size=(240, 322)), max_side=161)
    assert (facts["width"], facts["height"]) == (161, 120)
    assert read_image(out / "images" / "000000.png").shape == (120, 161, 3)
    assert facts["video"]["width"] == 322


def test_i10_uneven_times_are_spread_by_time(tmp_path):
    times = np.concatenate([np.linspace(0, 1, 90, endpoint=False), np.linspace(1, 10, 10, endpoint=False)])
    film, pictures = FilmTimes(times, 10.0, 10), panned(100)
    picker = frames.Picker(film.slots)
    for i, time in enumerate(times):
        list(picker.offer(i, *film.at(time), pictures[i]))
    list(picker.close())
    assert [int(frame["time_s"]) for frame in picker.kept] == list(range(10))


def test_a_black_fade_is_dropped(tmp_path):
    pictures = panned(20)
    for i in range(6):
        pictures[i] = np.full_like(pictures[i], 3 * i)
    facts, _, _ = pick(tmp_path, pictures)
    assert [f["index"] for f in facts["frames"]] == list(range(6, 20))


def test_oblong_pixels_are_said(tmp_path):
    said = []
    info = VideoInfo("v.mp4", 1920, 1080, 25.0, 50, 2.0, 0, "sdr", 4 / 3)
    frames.check_video(Job(tmp_path, emit=lambda event: said.append(event["text"])), info)
    (only,) = said
    assert holds(only, "pixels", 1.33, "square", "1920x1080")


def test_h19_i20_too_little_video_is_refused(tmp_path):
    for count in (1, 5):
        write_video(tmp_path / f"v{count}.mp4", panned(count), fps=30)
        with pytest.raises(StageError, match=rf"\b{count} frame"):
            frames.run(Job(out=tmp_path), frames.Params(), video=tmp_path / f"v{count}.mp4")
    write_video(tmp_path / "still.mp4", panned(1) * 40, fps=30)
    with pytest.raises(StageError, match=r"\b1 usable") as error:
        frames.run(Job(out=tmp_path), frames.Params(), video=tmp_path / "still.mp4")
    assert "39 copies" in error.value.facts[0]
    with pytest.raises(StageError, match="no video at"):
        frames.run(Job(out=tmp_path), frames.Params(), video=tmp_path / "none.mp4")


def test_i14_a_file_cut_short_gives_what_it_has_or_says_so(tmp_path):
    noise = np.random.default_rng(0).integers(0, 20, (60, HEIGHT, WIDTH, 3), dtype=np.uint8)
    write_video(tmp_path / "v.mp4", [f // 2 + n for f, n in zip(panned(60), noise, strict=True)], fps=30)
    whole = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: int(len(whole) * 0.8)])
    facts, _, warnings = run(tmp_path, tmp_path / "cut.mp4")
    assert holds(warnings[0], f"{facts['video']['frames']} of 60 frames")
    assert facts["dropped"]["undecodable"] == 60 - facts["video"]["frames"] > 0
    (tmp_path / "stub.mp4").write_bytes(whole[: int(len(whole) * 0.4)])
    with pytest.raises(StageError, match=r"\b\d+ of 60 frames"):
        frames.run(Job(out=tmp_path), frames.Params(), video=tmp_path / "stub.mp4")


@pytest.mark.parametrize("end", ["front", "back"])
def test_a_film_that_was_trimmed_without_coding_it_again_is_not_called_damaged(tmp_path, end):
    write_video(tmp_path / "v.mp4", panned(60), fps=30)
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    at = data.index(b"elst") + 12  # duration in ms, then where it begins
    duration, begin = struct.unpack_from(">Ii", data, at)
    moved = duration * 2 // 3 * (end == "front")
    struct.pack_into(">Ii", data, at, duration // 3, begin + moved * TICKS // 1000)
    (tmp_path / "trimmed.mp4").write_bytes(data)
    facts, _, warnings = run(tmp_path, tmp_path / "trimmed.mp4", count=10)
    assert facts["video"]["frames"] == 20 and facts["dropped"]["undecodable"] == 0 and not warnings
    assert len(facts["frames"]) == 10, "slots are those of what is left"


def test_i22_a_folder_of_pictures_keeps_their_names(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, picture in enumerate(panned(10)):
        write_image(folder / f"IMG_{i + 95}.png", picture)
    facts, out, _ = run(tmp_path, folder)
    assert [f["source"] for f in facts["frames"]] == [f"IMG_{i}" for i in range(95, 105)]
    assert np.array_equal(read_image(out / "images" / "000009.png"), panned(10)[9])


@pytest.mark.parametrize(("settings", "fps"), [({}, 10), ({"folder_fps": 30}, 30)])
def test_a_folder_of_pictures_is_as_fast_as_is_said(tmp_path, settings, fps):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, picture in enumerate(panned(10)):
        write_image(folder / f"{i}.png", picture)
    facts, _, _ = run(tmp_path, folder, **settings)
    assert facts["video"]["fps"] == fps and facts["video"]["duration_s"] == pytest.approx(10 / fps, abs=1e-4)
    assert [f["time_s"] for f in facts["frames"]] == pytest.approx(np.arange(10) / fps, abs=1e-4)


def timed(path, times):
    """A film of a camera that slides, its pictures shown at `times` s."""
    with av.open(str(path), "w") as box:
        stream = box.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.options = WIDTH, HEIGHT, {"bf": "0"}
        stream.codec_context.time_base = Fraction(1, 90000)
        for time, picture in zip(times, panned(len(times)), strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = round(time * 90000), Fraction(1, 90000)
            box.mux(stream.encode(frame))
        box.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("name", "times", "kept", "said"),
    [
        ("v.mkv", np.arange(30) / 29.97, range(30), None),  # Matroska rounds to milliseconds
        ("v.mp4", np.arange(30) / 30 + 60 * (np.arange(30) > 14), range(30), ("60.0 s", "0.5 s")),
        ("v.mp4", np.append(np.arange(29) / 30, 3600), range(29), (1, "3600.0 s")),
        ("v.mp4", np.append(0, 100 + np.arange(29) / 30), range(1, 30), (1, "0.0 s")),
    ],
)
def test_no_picture_is_lost_to_odd_times(tmp_path, name, times, kept, said):
    timed(tmp_path / name, times)
    facts, _, warnings = run(tmp_path, tmp_path / name)
    assert [frame["index"] for frame in facts["frames"]] == list(kept)
    assert (np.diff([frame["time_s"] for frame in facts["frames"]]) > 0).all()
    assert holds(warnings[0], *said) if said else not warnings


def test_times_that_run_back_are_counted(tmp_path):
    """AVI keeps no times: those of B-frames are guessed, in the order in which they are stored."""
    with av.open(str(tmp_path / "v.avi"), "w") as box:
        stream = box.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.options = WIDTH, HEIGHT, {"bf": "3", "b-adapt": "0"}
        for picture in panned(40):
            box.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        box.mux(stream.encode(None))
    facts, _, warnings = run(tmp_path, tmp_path / "v.avi", count=20)
    times = [frame["time_s"] for frame in facts["frames"]]
    assert 18 <= len(times) <= 20 and (np.diff(times) > 0.02).all()
    (warning,) = warnings
    assert holds(warning, "times", "run backwards", "counted", 30)


def test_interlaced_frames_are_said(tmp_path):
    with av.open(str(tmp_path / "v.mpg"), "w") as box:
        stream = box.add_stream("mpeg2video", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"flags": "+ilme+ildct", "q": "3"}
        for picture in panned(12):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            box.mux(stream.encode(frame))
        box.mux(stream.encode(None))
    _, _, warnings = run(tmp_path, tmp_path / "v.mpg")
    assert holds(warnings[0], "12 of 12 frames", "ffmpeg -i v.mpg -vf bwdif=send_frame")
    (tmp_path / "again").mkdir()
    facts, _, warnings = run(tmp_path / "again", ffmpeg.run(warnings[0], tmp_path))
    assert len(facts["frames"]) == 12 and not any("interlaced" in said for said in warnings)


def test_what_is_left_out_of_a_folder_is_said(tmp_path):
    folder, said = tmp_path / "photos", []
    folder.mkdir()
    for i, picture in enumerate(panned(10)):
        write_image(folder / f"{i + 3 * (i > 4)}.png", picture)
        write_image(folder / f"{i + 3 * (i > 4)}_mask.png", picture)
    (tmp_path / "out").mkdir()
    frames.run(Job(tmp_path / "out", emit=lambda event: said.append(event.get("text"))), frames.Params(), video=folder)
    facts = json.loads((tmp_path / "out" / "frames.json").read_text())
    assert [frame["time_s"] for frame in facts["frames"]] == [0, 0.1, 0.2, 0.3, 0.4, 0.8, 0.9, 1.0, 1.1, 1.2]
    assert any_holds(list(filter(None, said)), "10 files", f"--masks {folder}")
    assert any_holds(list(filter(None, said)), "5 to 7")


def test_names_that_are_no_text_are_read_by_the_next_stage(tmp_path):
    video, strange = tmp_path / os.fsdecode(b"Bj\xf6rn.mp4"), os.fsdecode(b"\xf6_")
    write_video(tmp_path / "v.mp4", panned(9), fps=30)
    (tmp_path / "v.mp4").rename(video)
    _, out, _ = run(tmp_path, video)
    assert read_facts(out / "frames.json", Listing).video.path == "Bj\ufffdrn.mp4"
    assert stem(f"{strange}3.png") == "\ufffd_3"
    (tmp_path / strange).mkdir()
    (tmp_path / strange / "1.png").touch()
    with pytest.raises(StageError, match=r"1\.png .*UTF-8"):
        frames.run(Job(out=tmp_path), frames.Params(), video=tmp_path / strange)
