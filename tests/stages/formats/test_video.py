"""Videos: colour, time, rotation, range and damage on reading; H.264 on writing."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.frame_names import extracting
from stages.formats.images import write_image
from stages.formats.pictures import natural_order
from stages.formats.video import decode, probe, write_video
from tests.made import ffmpeg
from tests.made.said import holds

COS_SIN = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}  # clockwise turn a player is told to make


def corner_marked(count=12, height=48, width=64):
    """Grey frames with a red top-left corner and a white bar that moves."""
    frames = np.full((count, height, width, 3), 90, np.uint8)
    frames[:, : height // 4, : width // 4] = (255, 0, 0)
    for i in range(count):
        frames[i, height // 2 :, i * 4 : i * 4 + 6] = 255
    return list(frames)


def set_rotation(path, degrees):
    """Patch the display matrix in the track header of an MP4."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    c, s = COS_SIN[degrees]
    data[at : at + 36] = struct.pack(">9i", c << 16, s << 16, 0, -s << 16, c << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def is_red(pixel):
    return pixel[0] > 180 and pixel[1] < 80 and pixel[2] < 80


def test_round_trip_keeps_colour_and_time(tmp_path):
    frames = corner_marked()
    write_video(tmp_path / "v.mp4", frames, fps=24)
    got = list(decode(tmp_path / "v.mp4"))
    assert [i for i, _, _ in got] == list(range(12))
    assert np.allclose([t for _, t, _ in got], np.arange(12) / 24, atol=1e-3)
    assert max(np.abs(a.astype(int) - b).mean() for (_, _, a), b in zip(got, frames, strict=True)) < 6
    info = probe(tmp_path / "v.mp4")
    assert (info.width, info.height, info.frames, info.rotation, info.transfer) == (64, 48, 12, 0, "sdr")
    assert abs(info.fps - 24) < 0.01 and abs(info.duration_s - 0.5) < 0.01


def test_plain_colours_come_back(tmp_path):
    for colour in [(255, 0, 0), (0, 255, 0), (30, 60, 200)]:
        write_video(tmp_path / "v.mp4", [np.full((64, 64, 3), colour, np.uint8)] * 3, fps=30)
        assert np.abs(next(decode(tmp_path / "v.mp4"))[2][32, 32].astype(int) - colour).max() <= 3


def test_the_file_is_h264_yuv420p_with_its_index_first(tmp_path):
    write_video(tmp_path / "v.mp4", corner_marked(), fps=30)
    with av.open(str(tmp_path / "v.mp4")) as container:
        context = container.streams.video[0].codec_context
        assert context.name == "h264" and context.pix_fmt == "yuv420p"
    data = (tmp_path / "v.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    assert not list(tmp_path.glob("*.part"))


def test_i12_odd_sizes_are_padded_by_repeating(tmp_path):
    write_video(tmp_path / "v.mp4", [np.full((47, 63, 3), 200, np.uint8)] * 4, fps=30)
    frame = next(decode(tmp_path / "v.mp4"))[2]
    assert frame.shape == (48, 64, 3) and abs(int(frame[47, 63, 0]) - 200) < 4


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_i11_rotation_in_the_file_is_applied(tmp_path, degrees):
    write_video(tmp_path / "v.mp4", corner_marked(), fps=30)
    set_rotation(tmp_path / "v.mp4", degrees)
    info = probe(tmp_path / "v.mp4")
    frame = next(decode(tmp_path / "v.mp4"))[2]
    assert frame.shape[:2] == (info.height, info.width) == ((48, 64) if degrees % 180 == 0 else (64, 48))
    corner = {0: (4, 4), 90: (4, -4), 180: (-4, -4), 270: (-4, 4)}[degrees]
    assert is_red(frame[corner]) and sum(is_red(frame[y, x]) for y in (4, -4) for x in (4, -4)) == 1


@pytest.mark.parametrize(("pixel", "width"), [(Fraction(4, 3), 64), (Fraction(8, 9), 43), (Fraction(1), 48)])
def test_pixels_that_are_not_square_are_made_square(tmp_path, pixel, width):
    """HDV keeps 1920x1080 as 1440x1080, DV keeps 640x480 as 720x480."""
    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        stream.codec_context.sample_aspect_ratio = pixel
        for picture in corner_marked(4, 32, 48):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    for degrees in (0, 90):
        set_rotation(tmp_path / "v.mp4", degrees)
        info, frames = probe(tmp_path / "v.mp4"), [picture for _, _, picture in decode(tmp_path / "v.mp4")]
        assert {picture.shape for picture in frames} == {(info.height, info.width, 3)} and len(frames) == 4
        assert (info.width, info.height) == ((32, width) if degrees else (width, 32))
        assert info.pixel == pytest.approx(float(pixel))
        red = (frames[0][..., 0] > 180) & (frames[0][..., 1] < 80)
        rows, columns = (np.flatnonzero(red.any(axis)) for axis in (1, 0))
        assert abs(len(columns if not degrees else rows) - width / 4) <= 1, "the corner is a quarter of the width"


def test_i10_variable_frame_rate_keeps_each_time(tmp_path):
    times = [0, 1, 2, 10, 11, 30]  # in 1/30 s
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = Fraction(1, 30)
        for time, pixels in zip(times, corner_marked(6), strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert np.allclose([t for _, t, _ in decode(tmp_path / "v.mkv")], np.array(times) / 30, atol=2e-3)
    assert abs(probe(tmp_path / "v.mkv").fps - 5) < 0.1
    first = ffmpeg.run(extracting("v.mkv"), tmp_path)  # as the hint of masks says: a picture each, none doubled
    assert len(list(first.parent.iterdir())) == 6


def test_i13_high_dynamic_range_is_noticed(tmp_path):
    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.color_trc = 18
        for pixels in corner_marked(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    assert probe(tmp_path / "v.mp4").transfer == "HLG"


def test_i14_unusable_paths_are_told_apart(tmp_path):
    with pytest.raises(StageError, match="no video at"):
        probe(tmp_path / "no.mp4")
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(StageError, match="is empty"):
        probe(tmp_path / "empty.mp4")
    for name in ("notes.mp4", "notes.txt"):
        (tmp_path / name).write_text("some words\n" * 50)
        with pytest.raises(StageError, match="not a video"):
            probe(tmp_path / name)
    write_video(tmp_path / "v.mp4", corner_marked(), fps=30)
    whole = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: whole.index(b"moov") - 4] + b"\0\0\0\x08free")
    with pytest.raises(StageError, match="cut short"):
        probe(tmp_path / "cut.mp4")
    (tmp_path / "folder").mkdir()
    with pytest.raises(StageError, match="no pictures"):
        probe(tmp_path / "folder")


def test_i14_a_damaged_middle_loses_frames_but_never_raises(tmp_path):
    rng = np.random.default_rng(0)
    write_video(tmp_path / "v.mp4", list(rng.integers(0, 256, (40, 96, 96, 3), dtype=np.uint8)), fps=30)
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    data[len(data) // 2 : len(data) * 3 // 4] = rng.bytes(len(data) * 3 // 4 - len(data) // 2)
    (tmp_path / "v.mp4").write_bytes(data)
    assert probe(tmp_path / "v.mp4").frames == 40
    assert 10 <= len(list(decode(tmp_path / "v.mp4"))) < 40


def test_a_folder_of_pictures_is_a_video(tmp_path):
    for i in (9, 10, 100):
        write_image(tmp_path / f"frame_{i}.png", np.full((30, 40, 3), i, np.uint8))
    assert [int(p[0, 0, 0]) for _, _, p in decode(tmp_path)] == [9, 10, 100]
    assert (probe(tmp_path).width, probe(tmp_path).frames) == (40, 3)
    write_image(tmp_path / "frame_11.png", np.zeros((30, 41, 3), np.uint8))
    with pytest.raises(StageError, match="different sizes"):
        list(decode(tmp_path))


def test_i22_natural_order(tmp_path):
    names = ["b2.png", "b10.png", "b1.png", "a10b2.png", "a9b30.png", "é.png", "²1.png"]
    ordered = [p.name for p in sorted((tmp_path / n for n in names), key=natural_order)]
    assert ordered.index("a9b30.png") < ordered.index("a10b2.png") < ordered.index("b1.png")
    assert ordered.index("b1.png") < ordered.index("b2.png") < ordered.index("b10.png")


def test_the_same_pictures_give_the_same_bytes(tmp_path):
    """x264's macroblock tree reads memory that nobody wrote, at this width."""
    wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (300, 600, 3)).astype(np.float32), (0, 0), 3)
    wall = np.clip(128 + 8 * (wall - 128), 0, 255).astype(np.uint8)
    pictures = [wall[k : k + 240, 3 * k : 3 * k + 480] for k in range(12)]
    films = []
    for number in range(8):
        litter = [np.random.default_rng(number).integers(0, 256, 1 << 18, dtype=np.uint8) for _ in range(20)]
        del litter
        write_video(tmp_path / "film.mp4", pictures, 12)
        films.append((tmp_path / "film.mp4").read_bytes())
    assert len(set(films)) == 1


def test_writing_refuses_nothing_and_mixed_sizes(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "v.mp4", [], fps=30)
    with pytest.raises(ValueError, match="one size"):
        write_video(tmp_path / "v.mp4", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)], fps=30)


@pytest.mark.parametrize(("codec", "kind"), [("h264", "raw H.264 video"), ("hevc", "raw HEVC video")])
def test_pictures_without_times_are_called_so(tmp_path, codec, kind):
    path = tmp_path / f"clip.{codec}"
    with av.open(str(path), "w", format=codec) as container:
        stream = container.add_stream({"h264": "libx264", "hevc": "libx265"}[codec], rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = {"x265-params": "log-level=none"} if codec == "hevc" else {}
        for pixels in corner_marked(12):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p")))
        container.mux(stream.encode(None))
    with pytest.raises(StageError) as error:
        probe(path)
    assert holds(error.value.problem, path, kind)
    assert f"`ffmpeg -framerate 30 -i {path} {path.with_suffix('.mp4')}`" in error.value.hint
    assert holds(*error.value.facts, "12 packets")
    mended = probe(ffmpeg.run(error.value.hint, tmp_path))
    assert mended.frames == 12 and mended.fps == pytest.approx(30)


def test_a_film_whose_pictures_change_their_size_is_refused(tmp_path):
    sizes = [
        {"height": 48, "width": 64},
        {"height": 64, "width": 48},
    ]  # as calls in a browser record a phone that is turned
    with av.open(str(tmp_path / "call.mkv"), "w") as out:
        stream, time = None, 0
        for number, size in enumerate(sizes):
            write_video(tmp_path / f"{number}.mp4", corner_marked(6, **size), fps=30)
            with av.open(str(tmp_path / f"{number}.mp4")) as film:
                own = av.BitStreamFilterContext("h264_mp4toannexb", film.streams.video[0])
                stream = stream or out.add_stream_from_template(film.streams.video[0])
                for packet in (one for raw in film.demux(video=0) for one in own.filter(raw if raw.size else None)):
                    packet.pts += time
                    packet.dts += time
                    packet.stream = stream
                    out.mux(packet)
            time += 6 * 512
    with pytest.raises(StageError, match="size") as refused:
        list(decode(tmp_path / "call.mkv"))
    assert holds(*refused.value.facts, "64x48", "0.2 s", "48x64")
    shapes = [picture.shape for _, _, picture in decode(ffmpeg.run(refused.value.hint, tmp_path))]
    assert shapes == [(48, 64, 3)] * 12


def test_a_list_of_films_is_no_film(tmp_path):
    write_video(tmp_path / "v.mp4", corner_marked(), fps=24)
    (tmp_path / "film.mp4").write_text("ffconcat version 1.0\nfile v.mp4\nfile v.mp4\n")
    (tmp_path / "film.m3u8").write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nv.mp4\n#EXT-X-ENDLIST\n")
    for read in (probe, lambda path: next(decode(path))):
        with pytest.raises(StageError, match=r"film\.mp4.*list"):
            read(tmp_path / "film.mp4")
    with pytest.raises(StageError, match=r"film\.m3u8"):
        probe(tmp_path / "film.m3u8")


def test_a_film_that_breaks_off_while_it_is_made_leaves_what_was_there(tmp_path):
    def some():
        yield from corner_marked(80)  # so many that the encoder has begun to write
        raise KeyboardInterrupt

    (tmp_path / "v.mp4").write_text("before")
    (tmp_path / "v.mp4.part").write_text("a download of somebody")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "v.mp4", some(), fps=24)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "v.mp4": "before",
        "v.mp4.part": "a download of somebody",
    }
