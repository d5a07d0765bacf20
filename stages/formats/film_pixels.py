"""A film's decoded frame as a picture: its colours by the matrix that it names, its turn and flip by the display matrix.

PyAV before 17 leaves a matrix that is named to swscale's default, BT.601: colours are off by up to 27 of 255.
"""

from __future__ import annotations

import io
from typing import Any

import av
import numpy as np

BT709, BT601 = 1, 5
MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}  # of ITU-T H.273, and their numbers in swscale; 2 says nothing
HD = (1280, 720)  # px of the longer or the shorter side, from which on a film that does not say is BT.709's
QUARTER = 90  # degrees


def turn_of(frame: av.VideoFrame) -> tuple[int, bool]:
    """Quarter turns counter-clockwise that put a frame upright, and whether it is still mirrored then."""
    stored: Any = frame.side_data.get("DISPLAYMATRIX")
    if stored is None:
        return 0, False
    a, b, _, c, d = np.frombuffer(bytes(stored), np.int32)[:5].astype(float)  # x -> a x + c y, y -> b x + d y, y down
    mirrored = a * d - b * c < 0
    return round(np.degrees(np.arctan2(-b, -a if mirrored else a)) / QUARTER) % 4, mirrored


def rgb_of(frame: av.VideoFrame, width: int) -> np.ndarray:
    """A frame as uint8 [H,width,3], by the colour matrix that it names, or else that of films of its size."""
    sides = sorted((frame.width, frame.height), reverse=True)
    usual = BT709 if sides[0] >= HD[0] or sides[1] >= HD[1] else BT601
    matrix = MATRICES.get(int(frame.colorspace), usual)
    other = BT601 if matrix == BT709 else BT709  # of a target that has none: only that it differs counts
    named = {} if frame.format.is_rgb else {"src_colorspace": matrix, "dst_colorspace": other}
    return frame.reformat(width=width, format="rgb24", **named).to_ndarray()


def patch_off() -> int:
    """By how many of 255 a film's colour is off that is coded as (200, 40, 40) by BT.709, and says so: what PyAV makes of it."""
    coded, film = np.full((48, 32), 80, np.uint8), io.BytesIO()
    coded[32:40], coded[40:] = 112, 198  # Cb, Cr
    with av.open(film, "w", format="mp4") as box:
        stream = box.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.options = 32, 32, "yuv420p", {"qp": "0"}
        stream.codec_context.colorspace, stream.codec_context.color_range = BT709, 1
        frame = av.VideoFrame.from_ndarray(coded, format="yuv420p")
        frame.colorspace, frame.color_range = BT709, 1
        box.mux(stream.encode(frame))
        box.mux(stream.encode(None))
    film.seek(0)
    with av.open(film, "r") as written:
        shown = rgb_of(next(written.decode(video=0)), 32)
    return int(np.abs(shown.astype(int) - [200, 40, 40]).max())
