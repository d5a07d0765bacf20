"""One HTML page: pictures, videos and a line chart inside the file, nothing fetched but what lies beside it (`aside`)."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np

from stages.formats import plot
from stages.formats.video import probe

STYLE = (
    plot.COLOURS
    + """
body { margin: 0 auto; max-width: 1080px; padding: 24px; background: var(--paper); color: var(--ink);
       font: 16px/1.5 system-ui, sans-serif; }
h1 { margin: 0; font-size: 30px; } h2 { margin: 40px 0 8px; font-size: 20px; }
p { margin: 6px 0; } .soft, figcaption { color: var(--soft); font-size: 14px; }
.row { display: flex; flex-wrap: wrap; gap: 14px; }
figure { margin: 0; flex: var(--shape) 1 calc(var(--shape) * var(--tall)); max-width: calc(var(--shape) * var(--tall) * 1.3); }
img, video { display: block; width: 100%; height: auto; border-radius: 6px; background: var(--box); }
.facts { display: grid; gap: 10px; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); margin: 18px 0; }
.facts div { background: var(--box); border-radius: 8px; padding: 10px 14px; }
.facts b { display: block; font-size: 22px; }
.warn { border-left: 4px solid var(--mark); background: var(--box); padding: 8px 14px; margin: 8px 0; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; white-space: nowrap; } td:has(.bar) { width: 50%; vertical-align: middle; }
.bar { background: var(--blue); height: 10px; border-radius: 3px; min-width: 1px; }
pre { font-size: 13px; } svg { width: 100%; max-width: 860px; height: auto; }
"""
)


def page(title: str, parts: Sequence[str]) -> str:
    """The whole document; `parts` are HTML."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    icon = '<link rel="icon" href="data:,">'
    body = "".join(parts)
    return f'<!doctype html><html lang="en"><head>{head}{icon}<style>{STYLE}</style></head><body>{body}</body></html>\n'


def picture(pixels: np.ndarray, caption: str, quality: int = 88) -> str:
    """A figure of uint8 [H,W,3] as an embedded JPEG; the caption is also its alternative text."""
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"no JPEG of a picture of shape {pixels.shape}")
    shape = pixels.shape[1] / pixels.shape[0]
    return _figure(f'<img alt="{escape(caption)}" src="{_data("image/jpeg", data.tobytes())}">', caption, shape)


def aside(source: str, target: str) -> str:
    """A picture that lies beside the page, by its relative address, and leads to `target`; nothing where it is not there."""
    gone = "this.parentNode.remove()"
    return f'<a href="{escape(target)}"><img alt="" src="{escape(source)}" onerror="{gone}"></a>'


def film(path: Path, caption: str) -> str:
    """A figure that plays an .mp4 in a loop, embedded."""
    source, info = _data("video/mp4", path.read_bytes()), probe(path)
    return _figure(
        f'<video controls loop muted autoplay playsinline aria-label="{escape(caption)}" src="{source}"></video>',
        caption,
        info.width / info.height,
    )


def row(figures: Sequence[str], tall: int) -> str:
    """Figures beside each other, equally high within a line: about `tall` px, less where the screen is narrow."""
    return f'<div class="row" style="--tall:{tall}px">{"".join(figures)}</div>'


def section(title: str, *parts: str, note: str = "") -> str:
    """A heading, a line of explanation and its content."""
    said = f'<p class="soft">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(title)}</h2>{said}{''.join(parts)}</section>"


def facts(numbers: Sequence[tuple[str, str]]) -> str:
    """Boxes with a number and what it is."""
    boxes = "".join(f"<div><b>{escape(value)}</b>{escape(name)}</div>" for name, value in numbers)
    return f'<div class="facts">{boxes}</div>'


def warning(text: str) -> str:
    """A sentence that must be seen."""
    return f'<p class="warn">{escape(text)}</p>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = ()) -> str:
    """A table; columns in `numeric` are right-aligned. Cells that start with '<div class="bar"' are HTML."""

    def line(cells: Sequence[str], tag: str) -> str:
        shown = (c if c.startswith('<div class="bar"') else escape(c) for c in cells)
        return "".join(f"<{tag}{' class=n' * (i in numeric)}>{c}</{tag}>" for i, c in enumerate(shown))

    body = "".join(f"<tr>{line(cells, 'td')}</tr>" for cells in rows)
    return f'<div class="wide"><table><tr>{line(head, "th")}</tr>{body}</table></div>'


def lines(texts: Sequence[str]) -> str:
    """Lines whose columns stand below each other."""
    return f'<div class="wide"><pre>{escape(chr(10).join(texts))}</pre></div>'


def bar(share: float) -> str:
    """A bar of `share` (0 to 1) of the cell's width."""
    return f'<div class="bar" style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></div>'


def chart(lines: dict[str, tuple[Sequence[float], Sequence[float]]], x_name: str, y_name: str) -> str:
    """A line chart as SVG: name -> (x, y), x from 0; fewer than two points make no chart and give ''."""
    known = [plot.Line(name, tuple(map(plot.Dot, x, y))) for name, (x, y) in lines.items() if len(x) > 1]
    return plot.svg(plot.drawing([plot.Panel(x_name, y_name, tuple(known))])) if known else ""


def _figure(media: str, caption: str, shape: float) -> str:
    return f'<figure style="--shape:{shape:.3f}">{media}<figcaption>{escape(caption)}</figcaption></figure>'


def _data(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
