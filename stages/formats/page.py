"""One self-contained HTML page: pictures, videos and a line chart inside the file, nothing fetched from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np

STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #60646c; --line: #d9d9e0; --paper: #fcfcfd; --box: #f0f0f3;
        --mark: #b54708; --blue: #1f6feb; }
@media (prefers-color-scheme: dark) { :root { --ink: #edeef0; --soft: #b0b4ba; --line: #363a3f; --paper: #111113;
        --box: #1d1e22; --mark: #f5a15b; --blue: #70b8ff; } }
body { margin: 0 auto; max-width: 1080px; padding: 24px; background: var(--paper); color: var(--ink);
       font: 16px/1.5 system-ui, sans-serif; }
h1 { margin: 0; font-size: 30px; } h2 { margin: 40px 0 8px; font-size: 20px; }
p { margin: 6px 0; } .soft, figcaption { color: var(--soft); font-size: 14px; }
.row { display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(var(--least, 300px), 1fr)); }
figure { margin: 0; }
img, video { display: block; width: 100%; height: auto; border-radius: 6px; background: var(--box); }
.facts { display: grid; gap: 10px; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); margin: 18px 0; }
.facts div { background: var(--box); border-radius: 8px; padding: 10px 14px; }
.facts b { display: block; font-size: 22px; }
.warn { border-left: 4px solid var(--mark); background: var(--box); padding: 8px 14px; margin: 8px 0; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; } .bar { background: var(--blue); height: 10px; border-radius: 3px; min-width: 1px; }
svg { width: 100%; height: auto; } svg text { fill: var(--soft); font-size: 13px; }
"""


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
    return _figure(f'<img alt="{escape(caption)}" src="{_data("image/jpeg", data.tobytes())}">', caption)


def film(path: Path, caption: str) -> str:
    """A figure that plays an .mp4 in a loop, embedded."""
    source = _data("video/mp4", path.read_bytes())
    return _figure(
        f'<video controls loop muted autoplay playsinline aria-label="{escape(caption)}" src="{source}"></video>',
        caption,
    )


def row(figures: Sequence[str], least: int = 300) -> str:
    """Figures beside each other, each at least `least` px wide, wrapped on narrow screens."""
    return f'<div class="row" style="--least:{least}px">{"".join(figures)}</div>'


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


def bar(share: float) -> str:
    """A bar of `share` (0 to 1) of the cell's width."""
    return f'<div class="bar" style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></div>'


def chart(lines: dict[str, tuple[Sequence[float], Sequence[float]]], x_name: str, y_name: str) -> str:
    """A line chart as SVG: name -> (x, y); fewer than two points make no chart and give ''."""
    lines = {name: (x, y) for name, (x, y) in lines.items() if len(x) > 1}
    if not lines:
        return ""
    width, height, left, low = 900, 300, 56, 40
    xs = np.concatenate([np.asarray(x, float) for x, _ in lines.values()])
    ys = np.concatenate([np.asarray(y, float) for _, y in lines.values()])
    x0, x1 = 0.0, max(xs.max(), 1e-9)
    y0, y1 = np.floor(ys.min()), np.ceil(max(ys.max(), ys.min() + 1e-6))

    def at(x: float, y: float) -> tuple[float, float]:
        return left + (x - x0) / (x1 - x0) * (width - left - 10), height - low - (y - y0) / (y1 - y0) * (
            height - low - 14
        )

    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(y_name)} over {escape(x_name)}">']
    for y in np.linspace(y0, y1, 5):
        _, py = at(0, y)
        out.append(f'<line x1="{left}" x2="{width - 10}" y1="{py:.1f}" y2="{py:.1f}" stroke="var(--line)"/>')
        out.append(f'<text x="{left - 8}" y="{py + 4:.1f}" text-anchor="end">{y:.1f}</text>')
    for x in np.linspace(x0, x1, 6):
        px, _ = at(x, y0)
        out.append(f'<text x="{px:.1f}" y="{height - 20}" text-anchor="middle">{x:.3g}</text>')
    for i, (name, (x, y)) in enumerate(lines.items()):
        color = ("var(--blue)", "var(--mark)")[i % 2]
        points = " ".join(f"{px:.1f},{py:.1f}" for px, py in (at(*p) for p in zip(x, y, strict=True)))
        out.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2.5"/>')
        out.append(f'<text x="{left + 14}" y="{height - low - 12 - 18 * i}" style="fill:{color}">{escape(name)}</text>')
    out.append(f'<text x="{(left + width) / 2}" y="{height - 3}" text-anchor="middle">{escape(x_name)}</text></svg>')
    return "".join(out)


def _figure(media: str, caption: str) -> str:
    return f"<figure>{media}<figcaption>{escape(caption)}</figcaption></figure>"


def _data(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
