"""Pages from templates: no text from outside becomes markup, and an edit of a template makes reports stale."""

import re

import numpy as np
import pytest
from jinja2 import UndefinedError

from hugs_cli.cache.fingerprint import Code
from stages.formats import page
from stages.formats.video import write_video

POLICY = re.compile(r"""Policy" content="default-src 'none'; script-src [^*]*; img-src 'self' file: data:;"""
                    r""" media-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'">""")  # fmt: skip
EVIL = "<script>\"&'"


def report(figures=(), **values):
    """A report with evil text wherever there is text, that still grows."""
    row = [EVIL] * 9
    stage = {"name": EVIL, "state": "running"}
    error = {"problem": EVIL, "facts": [EVIL], "hint": EVIL}
    texts = dict.fromkeys(("title", "protocol", "compared", "mapper", "viewer"), EVIL)
    rows = {name: [row] for name in ("accuracy", "beside_paper", "effects", "measures")}
    pairs = {name: [(EVIL, EVIL)] for name in ("headline", "warnings", "notes", "files")}
    pictures = dict.fromkeys(("films", "comparisons", "overlays", "sheet", "outlines"), figures)
    times = {name: ([row], (0,), [0.25]) for name in ("times", "parts")}
    rest = {
        "size": (1, 2, 3),
        "gaussians": (4000, 5),
        "curve": "",
        "scene": True,
        "rungs": [EVIL, EVIL],
        "live": None,
        "map": None,
    }
    rest |= {"state": {"clip": EVIL, "stages": [stage], "now": EVIL, "error": error}, "reload": 0, "page": "a1"}
    return page.fill("report.html", **(texts | rows | pairs | pictures | times | rest | values))


def test_text_never_becomes_markup(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((20, 40, 3), np.uint8)] * 2, 4)
    figures = [page.picture(np.zeros((4, 8, 3), np.uint8), EVIL), page.film(tmp_path / "a.mp4", EVIL)]
    for text, places in (
        (report(figures), 80),
        (page.fill("costs.html", title=EVIL, plot=EVIL, lines=[EVIL]), 4),
    ):
        assert "<script" not in text and POLICY.search(text) and text.count("&lt;script&gt;&#34;&amp;&#39;") >= places
        assert not re.search(r'(src|href)="(?!data:|&lt;script)', text)


def test_pages_run_their_own_lines_and_no_others():
    growing, ended = report(reload=5), report()
    assert "script-src 'nonce-a1';" in growing and growing.count("<script") == growing.count('<script nonce="a1">') == 1
    assert "script-src 'none';" in ended and not re.search(r'\son[a-z]+="', growing)
    assert "script-src 'none';" in page.fill("costs.html", title=EVIL, plot=EVIL, lines=[EVIL])


def test_a_cell_that_looks_like_a_bar_is_text_and_bars_have_the_width_of_their_share():
    text = report(accuracy=[['<div class="bar" onclick="x">', "b", "1", "2", "3"]])
    assert '<div class="bar" onclick' not in text and "<td>&lt;div class=&#34;bar&#34;" in text
    assert text.count('<div class="bar" style="width:25.0%"></div>') == 2


def test_a_name_that_no_value_has_is_an_error():
    with pytest.raises(UndefinedError):
        page.fill("costs.html", title="")


def test_figures_of_a_row_keep_their_shape(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((20, 40, 3), np.uint8)], 4)
    figures = [page.film(tmp_path / "a.mp4", ""), page.picture(np.zeros((8, 4, 3), np.uint8), "")]
    assert [figure.shape for figure in figures] == [2.0, 0.5] and "--shape:2.000" in report(figures)


def test_an_edit_of_a_template_makes_reports_stale():
    read = set(Code().digests("stages.commands.report"))
    room = "stages/formats/page"
    assert {f"{room}/{name}" for name in ("report.html", *page.SHARED)} <= read
    assert f"{room}/costs.html" not in read, "the page of costs is another"
    assert {path.name for path in page.ROOM.iterdir() if path.suffix in (".html", ".css")} == {
        *page.SHARED,
        "report.html",
        "costs.html",
        "fleet.html",
    }
