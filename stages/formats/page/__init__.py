"""HTML pages from the templates of this folder: all that is shown is inside the file, all text is escaped."""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jinja2 import DictLoader, Environment, StrictUndefined, Template

from stages.contract import version
from stages.formats.video import probe

ROOM = Path(__file__).parent
SHARED = ("base.html", "parts.html", "style.css", "colors.css")
"""Templates that the others use, by name, so an edit of one makes every report stale."""
COLORS = (ROOM / "colors.css").read_text(encoding="utf-8")


class Figure(NamedTuple):
    """A picture or a video inside the page."""

    source: str
    """A data: URL."""
    caption: str
    shape: float
    """Width by height."""
    moves: bool = False


def fill(template: str, **values: object) -> str:
    """The whole document. A template may use `values` and the SHARED templates; a name that is missing is an error."""
    return _template(template).render(values, made_by=f"hugs {version()}") + "\n"


@cache
def _template(name: str) -> Template:
    texts = {name: (ROOM / name).read_text(encoding="utf-8") for name in (*SHARED, name)}
    environment = Environment(
        loader=DictLoader(texts), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(name)


def picture(pixels: np.ndarray, caption: str, quality: int = 88) -> Figure:
    """A figure of uint8 [H,W,3] as a JPEG; the caption is also its alternative text."""
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"no JPEG of a picture of shape {pixels.shape}")
    return Figure(_data("image/jpeg", data.tobytes()), caption, pixels.shape[1] / pixels.shape[0])


def film(path: Path, caption: str) -> Figure:
    """A figure that plays an .mp4 in a loop."""
    info = probe(path)
    return Figure(_data("video/mp4", path.read_bytes()), caption, info.width / info.height, moves=True)


def _data(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
