"""Plots: points lie where the ticks say, colours are the same in all panels, labels keep apart, all numbers are drawn."""

import re
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Text

from stages.formats import plot
from stages.formats.plot import Dot, Line, Panel

EVIL = "<script>$\"&'$"


def two_panels() -> list[Panel]:
    """Two lines, the first in both panels, the second with error bars and labels close together."""
    first = Line("first", (Dot(1, 20), Dot(2, 24), Dot(8, 30)))
    second = Line(
        "second", tuple(Dot(4 + 0.01 * i, 25 + 0.1 * i, 0.5, f"a long label {i}") for i in range(5)), joined=False
    )
    return [Panel("minutes", "dB", (first, second), log=True), Panel("minutes", "dB", (second, first))]


def curves(axes):
    """The drawn lines by colour; error bars have no marker."""
    return {to_hex(line.get_color()): line for line in axes.lines if line.get_marker() == "o"}


def test_points_of_an_svg_lie_where_its_ticks_say():
    figure = plot.plot([Panel("x", "y", (Line("a", (Dot(1, 20), Dot(2, 24), Dot(4, 30))),))])
    root = ET.fromstring(plot.svg(figure, alone=True))
    words = {text.text: text for text in root.iter("{http://www.w3.org/2000/svg}text")}
    across, up = ({t: float(words[t].get(c)) for t in ts} for c, ts in (("x", "0123"), ("y", ("20", "24", "30"))))
    path = re.search(r'd="([^"]+)" [^>]*stroke: var\(--blue\); stroke-width: 2.5', plot.svg(figure))[1]
    points = np.array(re.findall(r"[ML] (\S+) (\S+)", path), float)
    np.testing.assert_allclose(points[:2, 0], [across["1"], across["2"]], atol=0.1)
    a_unit = (up["20"] - up["30"]) / 10
    np.testing.assert_allclose(points[0, 1] - points[:, 1], [0, 4 * a_unit, 10 * a_unit], atol=0.1)


def test_a_line_has_one_colour_in_all_panels_and_one_name_in_the_legend():
    figure = plot.plot(two_panels(), columns=2)
    first, second = map(curves, figure.axes)
    assert first.keys() == second.keys() == {plot.INKS["blue"], plot.INKS["mark"]}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["first", "second"]


def test_labels_overlap_neither_each_other_nor_points():
    axes = (figure := plot.plot(two_panels()[:1])).axes[0]
    boxes = [Text.get_window_extent(words) for words in axes.texts]
    points = np.concatenate([axes.transData.transform(line.get_xydata()) for line in curves(axes).values()])
    assert len(boxes) == 5
    for i, box in enumerate(boxes):
        assert not box.count_overlaps(boxes[:i])
        assert not any(box.contains(*point) for point in points)
        assert box.x0 >= 0 and box.x1 <= figure.bbox.x1


def test_error_bars_are_as_long_as_the_spread():
    axes = plot.plot([Panel("x", "y", (Line("a", (Dot(1, 20, 1.0), Dot(2, 24))),))]).axes[0]
    (bars,) = axes.collections
    np.testing.assert_allclose(bars.get_segments()[0], [[1, 19], [1, 21]])


def test_an_svg_fetches_nothing_and_has_no_markup_from_names():
    figure = plot.plot([Panel(EVIL, EVIL, (Line(EVIL, (Dot(1, 2, 0.1, EVIL), Dot(2, 3))),))])
    alone, inside = plot.svg(figure, alone=True), plot.svg(figure)
    assert ET.fromstring(alone).tag == "{http://www.w3.org/2000/svg}svg" and "prefers-color-scheme" in alone
    for text in (alone, inside):
        assert "<script" not in text and text.count("&lt;script&gt;$") >= 4, "text as text"
        assert not re.search(r'(src|href)="(?!#)|url\((?!#)|@import', text)
    assert not re.search(r"https?://|#[0-9a-f]{6}", inside), "its colours are the page's"
    assert plot.svg(plot.plot(two_panels())) == plot.svg(plot.plot(two_panels())), "the same every time"


def test_a_png_is_on_white_and_twice_the_size():
    figure = plot.plot(two_panels(), columns=2)
    image = cv2.imdecode(np.frombuffer(plot.png(figure), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert image.shape == (2 * (plot.HEIGHT + plot.LEGEND), 4 * plot.HALF, 3)
    assert (image == 255).all(-1).mean() > 0.8 and (image[:4] == 255).all()
    for name in ("blue", "mark"):
        assert (image == tuple(bytes.fromhex(plot.INKS[name][1:]))).all(-1).sum() > 100


@pytest.mark.parametrize(("low", "high"), [(0, 0.27), (19.2, 22.4), (25, 25), (-3e-9, 4e-9), (0, 1234), (99.9, 100)])
def test_ticks_are_few_and_hold_what_they_must(low, high):
    axes = plot.plot([Panel("x", "y", (Line("a", (Dot(0, low), Dot(high, high))),))]).axes[0]
    ticks = axes.get_yticks()
    assert ticks[0] <= low + 1e-9 and ticks[-1] >= high - 1e-9 and 2 <= len(ticks) <= 8 and (np.diff(ticks) > 0).all()
    assert axes.get_xlim()[0] == 0, "time begins at 0"


@pytest.mark.parametrize(("low", "high"), [(1, 1), (2.5, 8.6), (0.74, 1.21), (1, 1000), (0.02, 0.03), (59, 61)])
def test_logarithmic_ticks_are_few_and_about_what_they_must_hold(low, high):
    axes = plot.plot([Panel("x", "y", (Line("a", (Dot(low, 1), Dot(high, 1))),), log=True)]).axes[0]
    first, last = axes.get_xlim()
    shown = [tick for tick in axes.get_xticks() if first <= tick <= last]
    assert 1 <= len(shown) <= 10 and last / first == pytest.approx(high / low * plot.PAD**2)
