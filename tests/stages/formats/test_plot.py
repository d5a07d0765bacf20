"""Plots: points lie where the ticks say, colours are the same in all panels, labels keep apart, pixels show the same."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from stages.formats import plot
from stages.formats.plot import Dot, Line, Panel

EVIL = "<script>\"&'"


def two_panels() -> list[Panel]:
    """Two lines, the first in both panels, the second with error bars and labels close together."""
    first = Line("first", (Dot(1, 20), Dot(2, 24), Dot(8, 30)))
    second = Line(
        "second", tuple(Dot(4 + 0.01 * i, 25 + 0.1 * i, 0.5, f"a long label {i}") for i in range(5)), joined=False
    )
    return [Panel("minutes", "dB", (first, second), log=True), Panel("minutes", "dB", (second, first))]


def test_points_of_a_logarithmic_panel_lie_where_its_ticks_say():
    drawn = plot.drawing([Panel("x", "y", (Line("a", (Dot(1, 20), Dot(2, 24), Dot(8, 30))),), log=True)])
    (curve,) = [shape for shape in drawn.shapes if isinstance(shape, plot.Stroke) and len(shape.points) == 3]
    words = [shape for shape in drawn.shapes if isinstance(shape, plot.Text)]
    across = {float(t.text): t.x for t in words if t.anchor == "middle" and t.text != "x"}
    up = {float(t.text): t.y - 4 for t in words if t.anchor == "end"}
    assert {1, 2, 5} <= set(across) and across[2] - across[1] == pytest.approx((curve.points[2][0] - across[1]) / 3)
    np.testing.assert_allclose(curve.points[:2], [(across[1], up[20]), (across[2], up[24])], atol=1e-6)


def test_a_line_has_one_colour_in_all_panels_and_one_name_in_the_legend():
    drawn = plot.drawing(two_panels(), columns=2)
    curves = [shape.ink for shape in drawn.shapes if isinstance(shape, plot.Stroke) and len(shape.points) == 3]
    assert curves == [plot.LINES[0]] * 2 and (drawn.width, drawn.height) == (860, plot.HEIGHT + 34)
    names = [shape.text for shape in drawn.shapes if isinstance(shape, plot.Text)]
    assert names.count("first") == names.count("second") == 1


def test_labels_overlap_neither_each_other_nor_points():
    drawn = plot.drawing(two_panels()[:1])
    boxes = [s.box() for s in drawn.shapes if isinstance(s, plot.Text) and s.text.startswith("a long")]
    points = [(s.x, s.y) for s in drawn.shapes if isinstance(s, plot.Disc)]
    assert len(boxes) == 5
    for i, (left, top, right, bottom) in enumerate(boxes):
        assert not any(left < r and l < right and top < b and t < bottom for l, t, r, b in boxes[:i])  # noqa: E741
        assert not any(left < x < right and top < y < bottom for x, y in points)
        assert left >= 0 and right <= drawn.width


def test_error_bars_are_as_long_as_the_spread():
    drawn = plot.drawing([Panel("x", "y", (Line("a", (Dot(1, 20, 1.0), Dot(2, 24))),))])
    up = {float(s.text): s.y - 4 for s in drawn.shapes if isinstance(s, plot.Text) and s.anchor == "end"}
    (bar,) = [s for s in drawn.shapes if isinstance(s, plot.Stroke) and s.width == 1.5]
    scale = (up[20] - up[24]) / 4
    assert bar.points[0][1] - bar.points[1][1] == pytest.approx(2 * scale)


def test_a_file_of_its_own_is_svg_without_markup_from_names_and_fetches_nothing():
    panel = Panel(EVIL, EVIL, (Line(EVIL, (Dot(1, 2, 0.1, EVIL), Dot(2, 3))),))
    text = plot.svg(plot.drawing([panel]), alone=True)
    assert ET.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"
    assert "<script" not in text and not re.search(r"(src|href)=|url\(|@import", text)


def test_pixels_show_what_the_svg_does():
    drawn = plot.drawing(two_panels(), columns=2)
    image = plot.pixels(drawn)
    assert image.shape == (2 * drawn.height, 2 * drawn.width, 3)
    for shape in drawn.shapes:
        if isinstance(shape, plot.Disc):
            seen = image[round(2 * shape.y), round(2 * shape.x)]
            assert any((seen == tuple(bytes.fromhex(plot.INKS.get(ink, ink)[1:]))).all() for ink in plot.LINES[:2])
    assert (image == 255).all(-1).mean() > 0.8, "on white"


@pytest.mark.parametrize(("low", "high"), [(1, 1), (2.5, 8.6), (0.74, 1.21), (1, 1000), (0.02, 0.03), (59, 61)])
def test_logarithmic_ticks_are_few_and_about_what_they_must_hold(low, high):
    found = plot.log_ticks(low, high)
    assert 2 <= len(found) <= 10 and (np.diff(found) > 0).all() and (found > 0).all()
    assert ((found >= low / 1.08) & (found <= high * 1.08)).sum() >= 1
