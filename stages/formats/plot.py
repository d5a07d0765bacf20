"""Plots of points with error bars and lines, in panels beside each other: as SVG, and as pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

import cv2
import numpy as np

COLOURS = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #60646c; --line: #d9d9e0; --paper: #fcfcfd; --box: #f0f0f3;
        --mark: #b54708; --blue: #1f6feb; }
@media (prefers-color-scheme: dark) { :root { --ink: #edeef0; --soft: #b0b4ba; --line: #363a3f; --paper: #111113;
        --box: #1d1e22; --mark: #f5a15b; --blue: #70b8ff; } }
svg text { fill: var(--soft); font: 13px system-ui, sans-serif; }
"""
INKS = {"ink": "#1c2024", "soft": "#60646c", "line": "#d9d9e0", "blue": "#1f6feb", "mark": "#b54708"}  # of pixels
LINES = ("blue", "mark", "#009e73", "#cc79a7", "#8b6fc0", "#c9a000", "#56b4e9", "#7f7f7f", "#a65e2e")
WIDTH, HEIGHT = 720, 266  # px of a panel that stands alone
LEFT, RIGHT, TOP, LOW = 52, 20, 26, 44  # px around its axes
ROW = 22  # px of a line of the legend
LETTER = 7  # px, about
PAD = 1.08  # by which a logarithmic axis is longer than its points, at both ends
NEAR = 20  # px within which a label needs no line to its point
SHARP = 2  # pixels a px


class Dot(NamedTuple):
    """One point; `spread` is half the length of its error bar."""

    x: float
    y: float
    spread: float = 0.0
    label: str = ""


class Line(NamedTuple):
    """Points of one name and colour, joined in their order or not; without a name it is not in the legend."""

    name: str
    dots: tuple[Dot, ...]
    joined: bool = True
    ink: str = ""
    """A key of INKS, '#rrggbb', or '' for the next of LINES."""


class Panel(NamedTuple):
    """One pair of axes; x begins at 0, or is logarithmic."""

    x_name: str
    y_name: str
    lines: tuple[Line, ...]
    log: bool = False


class Stroke(NamedTuple):
    """A line through points (px)."""

    points: tuple[tuple[float, float], ...]
    ink: str
    width: float


class Disc(NamedTuple):
    """A filled circle (px)."""

    x: float
    y: float
    r: float
    ink: str
    label: str


class Text(NamedTuple):
    """Words at a baseline (px); `anchor` is start, middle or end."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    ink: str = "soft"

    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom, about."""
        width = LETTER * len(self.text)
        left = self.x - {"start": 0.0, "middle": 0.5, "end": 1.0}[self.anchor] * width
        return left, self.y - 11, left + width, self.y + 3


class Drawing(NamedTuple):
    """What is drawn, and its size in px."""

    shapes: tuple[Stroke | Disc | Text, ...]
    width: int
    height: int
    title: str


def drawing(panels: Sequence[Panel], columns: int = 1) -> Drawing:
    """Panels row by row below one legend. Every panel has a line, every line a dot; all numbers are finite."""
    inks = _inks(panels)
    wide = WIDTH if columns == 1 else 430
    total = wide * min(columns, len(panels))
    legend, below = _legend(inks, total)
    shapes: list[Stroke | Disc | Text] = [*legend]
    for i, panel in enumerate(panels):
        shapes += _panel(panel, inks, wide * (i % columns), below + HEIGHT * (i // columns), wide)
    title = "; ".join(dict.fromkeys(f"{panel.y_name} over {panel.x_name}" for panel in panels))
    return Drawing(tuple(shapes), total, below + HEIGHT * math.ceil(len(panels) / columns), title)


def svg(drawn: Drawing, alone: bool = False) -> str:
    """The drawing as an SVG element that takes its colours from the page, or `alone` as a file of its own."""
    size = f'viewBox="0 0 {drawn.width} {drawn.height}"'
    head = f'<svg {size} role="img" aria-label="{escape(drawn.title)}">'
    if alone:
        size = f'xmlns="http://www.w3.org/2000/svg" width="{drawn.width}" height="{drawn.height}" {size}'
        head = f'<svg {size}><style>{COLOURS}</style><rect width="100%" height="100%" fill="var(--paper)"/>'
    return "".join([head, *map(_element, drawn.shapes), "</svg>"])


def pixels(drawn: Drawing) -> np.ndarray:
    """The drawing on white, uint8 [2 * height, 2 * width, 3], RGB. Letters other than ASCII become '?'."""
    image = np.full((SHARP * drawn.height, SHARP * drawn.width, 3), 255, np.uint8)
    for shape in drawn.shapes:
        ink = tuple(bytes.fromhex(INKS.get(shape.ink, shape.ink)[1:]))
        match shape:
            case Stroke(points, _, width):
                corners = np.rint(np.array(points) * SHARP * 16).astype(np.int32)
                cv2.polylines(image, [corners], False, ink, max(1, round(SHARP * width)), cv2.LINE_AA, 4)
            case Disc(x, y, r, _, _):
                at = round(x * SHARP * 16), round(y * SHARP * 16)
                cv2.circle(image, at, round(r * SHARP * 16), ink, -1, cv2.LINE_AA, 4)
            case Text(x, y, text, anchor, _):
                text, font, size = text.encode("ascii", "replace").decode(), cv2.FONT_HERSHEY_SIMPLEX, 0.45 * SHARP
                long = cv2.getTextSize(text, font, size, 1)[0][0]
                left = round(x * SHARP - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * long)
                cv2.putText(image, text, (left, round(y * SHARP)), font, size, ink, 1, cv2.LINE_AA)
    return image


def _inks(panels: Sequence[Panel]) -> dict[str, str]:
    """The colour of each line's name, the same in all panels."""
    names = dict.fromkeys(line.name for panel in panels for line in panel.lines if not line.ink)
    own = {line.name: line.ink for panel in panels for line in panel.lines if line.ink}
    return {name: LINES[i % len(LINES)] for i, name in enumerate(names)} | own


def _legend(inks: dict[str, str], width: int) -> tuple[list[Disc | Text], int]:
    """The names of all lines in their colours, and the height that they take."""
    shapes: list[Disc | Text] = []
    x, y = LEFT, 16
    for name, ink in inks.items():
        if name and x > LEFT and x + LETTER * (len(name) + 2) > width:
            x, y = LEFT, y + ROW
        if name:
            shapes += [Disc(x + 4, y - 4, 4, ink, name), Text(x + 14, y, name, ink=ink)]
            x += LETTER * (len(name) + 5)
    return shapes, y + ROW - 4 if shapes else 0


def _panel(panel: Panel, inks: dict[str, str], left: int, top: int, wide: int) -> Iterator[Stroke | Disc | Text]:
    """Axes, then lines and error bars, then points, then their labels."""
    dots = [dot for line in panel.lines for dot in line.dots]
    xs = [dot.x for dot in dots]
    up = ticks(min(dot.y - dot.spread for dot in dots), max(dot.y + dot.spread for dot in dots))
    across = log_ticks(min(xs), max(xs)) if panel.log else ticks(0.0, max(xs))
    first, last = (min(xs) / PAD, max(xs) * PAD) if panel.log else (0.0, max(xs) or 1.0)
    x0, x1, y0, y1 = left + LEFT, left + wide - RIGHT, top + HEIGHT - LOW, top + TOP

    def at(x: float, y: float) -> tuple[float, float]:
        share = math.log(x / first) / math.log(last / first) if panel.log else x / last
        return x0 + share * (x1 - x0), y0 - (y - up[0]) / (up[-1] - up[0]) * (y0 - y1)

    for y in up:
        _, py = at(last, y)
        yield Stroke(((x0, py), (x1, py)), "line", 1)
        yield Text(x0 - 8, py + 4, f"{y:g}", "end")
    for x in across[(across >= first) & (across <= last)]:
        yield Text(at(x, up[0])[0], y0 + 20, f"{x:g}", "middle")
    yield Text(x0, y1 - 10, panel.y_name)
    yield Text((x0 + x1) / 2, y0 + 40, panel.x_name, "middle")
    for line in panel.lines:
        if line.joined and len(line.dots) > 1:
            yield Stroke(tuple(at(dot.x, dot.y) for dot in line.dots), inks[line.name], 2.5)
        for dot in line.dots:
            if dot.spread:
                yield Stroke((at(dot.x, dot.y - dot.spread), at(dot.x, dot.y + dot.spread)), inks[line.name], 1.5)
    taken = [(px - 4, py - 4, px + 4, py + 4) for px, py in (at(dot.x, dot.y) for dot in dots)]
    for line in panel.lines:
        for dot in line.dots:
            px, py = at(dot.x, dot.y)
            yield Disc(px, py, 3.5, inks[line.name], f"{dot.label or line.name}: {dot.x:.3g}, {dot.y:.4g}")
            if dot.label and (
                words := _beside(px, py, dot.label, inks[line.name], taken, (x0, y1 - 8, x1 + RIGHT, y0))
            ):
                taken.append(words.box())
                if abs(words.y - py) > NEAR:
                    yield Stroke(((px, py), (words.x, words.y - 4)), inks[line.name], 0.7)
                yield words


def _beside(x: float, y: float, text: str, ink: str, taken: list[tuple], limits: tuple) -> Text | None:
    """The label of a point where nothing else is, as near as can be; None where there is no room within `limits`."""
    for away in (4, -9, 18, -20, 30, -32, 44, -46, 58, -60):
        for side, anchor in ((8, "start"), (-8, "end")):
            words = Text(x + side, y + away, text, anchor, ink)
            box = words.box()
            inside = limits[0] <= box[0] and limits[1] <= box[1] and box[2] <= limits[2] and box[3] <= limits[3]
            if inside and not any(_overlap(box, other) for other in taken):
                return words
    return None


def _overlap(one: tuple, other: tuple) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _element(shape: Stroke | Disc | Text) -> str:
    ink = f"var(--{shape.ink})" if shape.ink in INKS else shape.ink
    match shape:
        case Stroke(((x1, y1), (x2, y2)), _, width):
            place = f'x1="{x1:.1f}" x2="{x2:.1f}" y1="{y1:.1f}" y2="{y2:.1f}"'
            return f'<line {place} stroke="{ink}" stroke-width="{width}"/>'
        case Stroke(points, _, width):
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
            return f'<polyline points="{path}" fill="none" stroke="{ink}" stroke-width="{width}"/>'
        case Disc(x, y, r, _, label):
            return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}" fill="{ink}"><title>{escape(label)}</title></circle>'
        case Text(x, y, text, anchor, name):
            style = "" if name == "soft" else f' style="fill:{ink}"'
            return f'<text x="{x:.1f}" y="{y:g}" text-anchor="{anchor}"{style}>{escape(text)}</text>'


def ticks(low: float, high: float, about: int = 5) -> np.ndarray:
    """Round numbers from at or below `low` to at or above `high`, some `about` of them, at least two."""
    rough = max(high - low, 1e-6 * max(abs(high), 1.0)) / about
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(s for s in (1, 2, 5, 10) if s * power >= rough)
    first, last = np.floor(low / step), max(np.ceil(high / step), np.floor(low / step) + 1)
    return np.round(np.arange(first, last + 1) * step, 9)


def log_ticks(low: float, high: float) -> np.ndarray:
    """Round numbers about `low` to `high`, both above 0: 1, 2, 5, 10 ... where they lie far enough apart, else even steps."""
    whole = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = np.array([round(s * 10.0**k, 9) for k in whole for s in (1, 2, 5)])
    within = found[(found >= low / PAD) & (found <= high * PAD)]
    return within if len(within) > 2 else ticks(low / PAD, high * PAD, 4)
