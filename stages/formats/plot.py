"""Plots of points with error bars and lines, in panels beside each other: SVG in the colours of the page, and PNG."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox

from stages.formats.page import COLORS

INKS = {
    "ink": "#1c2024",
    "soft": "#60646c",
    "line": "#d9d9e0",
    "blue": "#1f6feb",
    "mark": "#b54708",
    "paper": "#fcfcfd",
}
"""The page's colours by day. An SVG takes them by name, so the page's night changes them."""
LINES = ("blue", "mark", "#009e73", "#cc79a7", "#8b6fc0", "#c9a000", "#56b4e9", "#7f7f7f", "#a65e2e")
PX = 72  # px of an SVG in an inch
WIDTH, HALF, HEIGHT, LEGEND = 720, 430, 266, 30  # px of a panel alone in its row, of one beside another; of the legend
PAD = 1.08  # by which a logarithmic axis is longer than its points, at both ends
NEAR = 20  # px within which a label needs no line to its point
PLACES = [(x, y) for y in (0, 13, -14, 24, -26, 36, -38, 50, -52, 64) for x in (8, -8)]  # px from a point to its label
FONT = "DejaVu Sans"  # ships with matplotlib, so a PNG is the same everywhere
STYLE: dict[Any, Any] = {
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INKS["soft"]),
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 0),
    **dict.fromkeys(("xtick.major.pad", "ytick.major.pad", "axes.titlepad"), 8),
    "font.family": FONT,
    "font.size": 13,
    "axes.titlesize": 13,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": INKS["line"],
    "figure.facecolor": INKS["paper"],
    "axes.facecolor": "none",
    "legend.frameon": False,
    "legend.labelcolor": "linecolor",
    "lines.linewidth": 2.5,
    "lines.markersize": 7,
    "svg.fonttype": "none",
    "text.parse_math": False,
    "svg.hashsalt": "hugs",
}
"""Axes without a frame; text as text, and ids that are the same every time."""


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


def plot(panels: Sequence[Panel], columns: int = 1) -> Figure:
    """Panels row by row below one legend. Every panel has a line, every line a dot; all numbers are finite."""
    inks, rows = _inks(panels), math.ceil(len(panels) / columns)
    wide = WIDTH if columns == 1 else HALF * min(columns, len(panels))
    with matplotlib.rc_context(STYLE):
        figure = Figure((wide / PX, (LEGEND + HEIGHT * rows) / PX), dpi=PX, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        grid = list(figure.subplots(rows, columns, squeeze=False).flat)
        named: dict[str, Line2D] = {}
        for axes, panel in zip(grid, panels):
            _scale(axes, panel)
            named |= {line.name: _draw(axes, line, inks[line.name]) for line in panel.lines}
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        named.pop("", None)
        figure.legend(list(named.values()), list(named), loc="outside upper left", ncols=wide // 120, handlelength=0)
        figure.draw_without_rendering()  # lays out, so labels know where everything lies
        for axes, panel in zip(grid, panels):
            _label(axes, panel, inks, canvas)
    return figure


def svg(figure: Figure, alone: bool = False) -> str:
    """The plot as an SVG element in the colours of the page around it, or `alone` as a file with colours of its own."""
    file = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = file.getvalue().replace(f"'{FONT}'", "system-ui, sans-serif")
    for name, color in INKS.items():
        text = text.replace(color, f"var(--{name})")
    if alone:
        return text.replace("<defs>", f"<style>{COLORS}</style><defs>", 1)
    head, body = text[text.index("<svg") :].split(">", 1)
    return re.sub(r' (xmlns(:\w+)?|width|height|version)="[^"]*"', "", head) + f' role="img">{body}'


def png(figure: Figure) -> bytes:
    """The plot on white, two pixels for each px of the SVG."""
    file = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(file, format="png", dpi=2 * PX, facecolor="white")
    return file.getvalue()


def _inks(panels: Sequence[Panel]) -> dict[str, str]:
    """The colour of each line's name, the same in all panels."""
    names = dict.fromkeys(line.name for panel in panels for line in panel.lines if not line.ink)
    own = {line.name: line.ink for panel in panels for line in panel.lines if line.ink}
    inks = {name: LINES[i % len(LINES)] for i, name in enumerate(names)} | own
    return {name: INKS.get(ink, ink) for name, ink in inks.items()}


def _scale(axes: Axes, panel: Panel) -> None:
    """Names, and a few round ticks; y ends at ticks."""
    dots = [dot for line in panel.lines for dot in line.dots]
    axes.set_xlabel(panel.x_name)
    axes.set_title(panel.y_name)
    low, high = min(dot.y - dot.spread for dot in dots), max(dot.y + dot.spread for dot in dots)
    apart = max(high - low, 1e-6 * max(abs(high), 1.0))
    ticks = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, low + apart)
    axes.set_yticks(ticks)
    axes.set_ylim(ticks[0], ticks[-1])
    least, most = min(dot.x for dot in dots), max(dot.x for dot in dots)
    if panel.log:
        axes.set_xscale("log")
        axes.set_xlim(least / PAD, most * PAD)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_minor_locator(NullLocator())
    else:
        axes.set_xlim(0, most * 1.02 or 1)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")


def _draw(axes: Axes, line: Line, ink: str) -> Line2D:
    """Error bars below, the line, its points above."""
    x, y, spread, _ = zip(*line.dots)
    axes.errorbar(x, y, [s or np.nan for s in spread], fmt="none", ecolor=ink, elinewidth=1.5, zorder=2)
    (drawn,) = axes.plot(x, y, "o-" if line.joined else "o", color=ink, zorder=3)
    return drawn


def _label(axes: Axes, panel: Panel, inks: dict[str, str], canvas: FigureCanvasAgg) -> None:
    """Label each point at the nearest free place, or not at all where there is no room."""
    dots = [(dot, inks[line.name]) for line in panel.lines for dot in line.dots]
    taken = [Bbox([at - 4, at + 4]) for at in axes.transData.transform([dot[:2] for dot, _ in dots])]
    room, renderer = axes.get_window_extent().padded(10), canvas.get_renderer()
    for dot, ink in [(dot, ink) for dot, ink in dots if dot.label]:
        thin = {"arrowstyle": "-", "lw": 0.7, "color": ink, "shrinkA": 0, "shrinkB": 0}
        for x, y in PLACES:
            how: dict[str, Any] = {"ha": "left" if x > 0 else "right", "va": "center", "color": ink}
            how |= {"textcoords": "offset points", "arrowprops": thin if abs(y) > NEAR else None}
            words = axes.annotate(dot.label, dot[:2], (x, y), **how)
            words.update_positions(renderer)
            box = Text.get_window_extent(words)
            inside = room.x0 <= box.x0 and box.x1 <= room.x1 and room.y0 <= box.y0 and box.y1 <= room.y1
            if inside and not box.count_overlaps(taken):
                taken.append(box)
                break
            words.remove()
