"""Colours by every matrix and range that films name, or do not; all eight turns and flips."""

import struct
from fractions import Fraction

import av
import numpy as np
import pytest

from stages.formats import film_pixels
from stages.formats.video import decode, open_video, probe, write_video
from tests.made.said import holds

WEIGHTS = {"BT.709": (0.2126, 0.0722), "BT.601": (0.299, 0.114), "BT.2020": (0.2627, 0.0593), "240M": (0.212, 0.087)}
RED = (200, 40, 40)


def coded(colour, weights, full):
    """Y, Cb, Cr of a colour, in 8 bits."""
    r, g, b = (value / 255 for value in colour)
    kr, kb = weights
    y = kr * r + (1 - kr - kb) * g + kb * b
    parts = y, (b - y) / (2 - 2 * kb), (r - y) / (2 - 2 * kr)
    return [
        round(add + value * scale)
        for value, add, scale in zip(parts, (0 if full else 16, 128, 128), (255,) * 3 if full else (219, 224, 224))
    ]


def patch(path, yuv, matrix, full=False, size=(64, 48)):
    """A film of one colour, coded as it is."""
    with av.open(str(path), "w") as box:
        stream = box.add_stream("libx264", rate=30)
        stream.width, stream.height = size
        stream.pix_fmt, stream.options = "yuv420p", {"qp": "0"}
        context = stream.codec_context
        context.colorspace, context.color_range = matrix, 2 if full else 1
        planes = np.full((size[1] * 3 // 2, size[0]), yuv[0], np.uint8).ravel()
        area = size[0] * size[1]
        planes[area : area * 5 // 4], planes[area * 5 // 4 :] = yuv[1], yuv[2]
        for i in range(3):
            frame = av.VideoFrame.from_ndarray(planes.reshape(-1, size[0]), format="yuv420p")
            frame.colorspace, frame.color_range = matrix, 2 if full else 1
            frame.pts, frame.time_base = i, Fraction(1, 30)
            box.mux(stream.encode(frame))
        box.mux(stream.encode(None))
    return next(decode(path))[2][20, 20].astype(int)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("matrix", "kind"), [(1, "BT.709"), (5, "BT.601"), (6, "BT.601"), (7, "240M"), (9, "BT.2020")])
def test_a_colour_comes_back_by_the_matrix_that_is_named(tmp_path, matrix, kind, full):
    assert np.abs(patch(tmp_path / "v.mp4", coded(RED, WEIGHTS[kind], full), matrix, full) - RED).max() <= 3


@pytest.mark.parametrize(
    ("size", "kind"),
    [
        ((64, 48), "BT.601"),
        ((864, 480), "BT.601"),
        ((480, 864), "BT.601"),
        ((960, 720), "BT.709"),
        ((720, 1280), "BT.709"),
    ]
    + [((1280, 536), "BT.709")],
)
def test_untagged_films_of_720_lines_and_more_are_bt709(tmp_path, size, kind):
    assert np.abs(patch(tmp_path / "v.mp4", coded(RED, WEIGHTS[kind], False), 2, size=size) - RED).max() <= 3


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("turns", range(4))
def test_every_turn_and_flip_of_the_display_matrix(tmp_path, turns, flip):
    """`turns` quarters counter-clockwise, then left and right exchanged."""
    picture = np.kron(np.array([[250, 20, 20, 120], [20, 20, 120, 120], [20, 20, 20, 200]]), np.ones((16, 16)))
    picture = np.repeat(picture[..., None], 3, 2).astype(np.uint8)
    write_video(tmp_path / "v.mp4", [picture] * 3, fps=30)
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns)  # of x right, y down
    a, c, b, d = ((np.diag([-1, 1]) if flip else np.eye(2, dtype=int)) @ turn).ravel().tolist()
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    (tmp_path / "v.mp4").write_bytes(data)
    wanted = np.rot90(picture, turns)[:, :: -1 if flip else 1].astype(int)
    shown, info = next(decode(tmp_path / "v.mp4"))[2], probe(tmp_path / "v.mp4")
    assert shown.shape == wanted.shape == (info.height, info.width, 3) and abs(shown - wanted).mean() < 4
    assert (info.rotation, info.mirrored) == (90 * turns, flip)


@pytest.mark.parametrize("sizes", [[(32, 24), (64, 48)], [(64, 48), (32, 24)], [(48, 64), (64, 64), (32, 24)]])
def test_of_several_tracks_the_largest_is_the_film(tmp_path, sizes):
    with av.open(str(tmp_path / "v.mov"), "w") as box:
        streams = [box.add_stream("libx264", rate=30) for _ in sizes]
        for stream, (stream.width, stream.height) in zip(streams, sizes):
            stream.pix_fmt = "yuv420p"
        for i in range(9):
            for stream, (width, height) in zip(streams, sizes):
                frame = av.VideoFrame.from_ndarray(np.full((height, width, 3), 20 * i, np.uint8), format="rgb24")
                frame.pts, frame.time_base = i, Fraction(1, 30)
                box.mux(stream.encode(frame))
        for stream in streams:
            box.mux(stream.encode(None))
    best, info = max(sizes, key=lambda size: size[0] * size[1]), probe(tmp_path / "v.mov")
    assert (info.width, info.height, info.frames) == (*best, 9)
    assert holds(info.notes[0], len(sizes), f"{best[0]}x{best[1]} h264")
    container, stream = open_video(tmp_path / "v.mov")
    with container:
        assert stream.index == sizes.index(best)


def test_the_patch_that_doctor_decodes_tells_wrong_colours(monkeypatch):
    assert film_pixels.patch_off() <= 3
    monkeypatch.setattr(film_pixels, "MATRICES", {1: film_pixels.BT601})
    assert film_pixels.patch_off() > 10
