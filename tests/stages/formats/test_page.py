"""Pieces of a page: nothing a user names becomes markup, and a chart's points lie where its ticks say."""

import re

import numpy as np
import pytest

from stages.formats import page, plot
from stages.formats.video import write_video

EVIL = "<script>\"&'"


def test_text_never_becomes_markup(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((20, 40, 3), np.uint8)] * 2, 4)
    chart = page.chart({EVIL: ([0, 1], [1, 2])}, EVIL, EVIL)
    parts = [page.picture(np.zeros((4, 8, 3), np.uint8), EVIL), page.film(tmp_path / "a.mp4", EVIL), chart]
    parts += [page.warning(EVIL), page.facts([(EVIL, EVIL)]), page.section(EVIL, note=EVIL)]
    parts += [page.table([EVIL], [[EVIL]])]
    whole = page.page(EVIL, parts)
    assert "<script" not in whole and whole.count("&lt;script&gt;") >= 12
    assert not re.search(r'(src|href)="(?!data:)', whole)


def test_figures_of_a_row_keep_their_shape(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((20, 40, 3), np.uint8)], 4)
    assert "--shape:2.000" in page.film(tmp_path / "a.mp4", "")
    assert "--shape:0.500" in page.picture(np.zeros((8, 4, 3), np.uint8), "")


def test_a_bar_is_the_only_markup_a_table_takes():
    made = page.table(["a", "b"], [["<i>", page.bar(0.25)]], numeric=(0,))
    assert "<td class=n>&lt;i&gt;</td>" in made and 'style="width:25.0%"' in made
    assert 'width:100.0%"' in page.bar(7.0) and 'width:0.0%"' in page.bar(-1.0)


def test_a_charts_points_lie_where_its_ticks_say():
    svg = page.chart({"a": ([1.0, 2.0, 4.0], [20.0, 24.0, 30.0])}, "x", "y")
    points = [tuple(map(float, p.split(","))) for p in re.search(r'points="([^"]+)"', svg)[1].split()]
    across = {
        float(v): float(x) for x, v in re.findall(r'<text x="([\d.]+)" y="276" text-anchor="middle">([^<]+)', svg)
    }
    up = {float(v): float(y) - 4 for y, v in re.findall(r'y="([\d.]+)" text-anchor="end">([^<]+)', svg)}
    np.testing.assert_allclose(points, [(across[1], up[20]), (across[2], up[24]), (across[4], up[30])], atol=0.11)
    assert 0 in across, "time begins at 0"


@pytest.mark.parametrize(("low", "high"), [(0, 0.27), (19.2, 22.4), (25, 25), (-3e-9, 4e-9), (0, 1234), (99.9, 100)])
def test_ticks_are_few_and_hold_what_they_must(low, high):
    ticks = plot.ticks(low, high)
    assert ticks[0] <= low + 1e-9 and ticks[-1] >= high - 1e-9 and 2 <= len(ticks) <= 8 and (np.diff(ticks) > 0).all()


def test_one_point_makes_no_chart():
    assert page.chart({"a": ([1.0], [2.0]), "b": ((), ())}, "x", "y") == ""
