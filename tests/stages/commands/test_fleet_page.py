"""The page of a fleet, as a browser sees it."""

from __future__ import annotations

import contextlib
import os

import numpy as np
import pytest

from stages.commands import fleet_page
from stages.contract import Job
from stages.formats.images import write_image
from tests.made import browser
from tests.made.devtools import Page
from tests.made.flow import Flow
from tests.made.said import holds

ROW = {
    "clip": "dance", "folder": "from-mon/dance & more", "pipeline": "draft", "state": "done", "stage": "", "percent": None,
    "silent": None, "seconds_left": 0.0, "seconds": 90.0, "spent": 90.0, "psnr": 28.44, "psnr_person": None,
    "effects": ["motion_blur"], "warnings": [], "kind": "", "problem": "", "hint": "", "facts": [], "log": "",
    "picture": "", "pages": ["report.html", "export/viewer.html"],
}  # fmt: skip
TOTALS = {"states": {"done": 1}, "failures": {}, "machine_seconds": 7200.0, "spent_seconds": 90.0, "seconds_left": 0}


def write(folder, *rows, live=False, totals=TOTALS) -> str:
    fleet_page.run(Job(folder), fleet_page.Params(), name="fleet", rows=rows, totals=totals, live=live)
    return (folder / "fleet.html").read_text(encoding="utf-8")


def test_a_row_has_its_words_and_links(tmp_path):
    page = write(tmp_path, ROW)
    assert 'href="from-mon/dance%20%26%20more/draft/report.html">report<' in page and ">viewer<" in page
    assert "28.4" in page and "motion blur" in page and "2 min" in page and "2.0 h" in page
    running = ROW | {"state": "running", "stage": "train", "percent": 30, "silent": 120, "seconds_left": 6000.0}
    page = write(tmp_path, running, live=True, totals=TOTALS | {"states": {"running": 1}, "seconds_left": 6000})
    assert holds(page, "train 30 %", "2 min") and "1.7 h" in page and "location.reload" in page


def test_pictures_are_made_once_and_a_broken_one_hurts_nobody(tmp_path):
    rows = []
    for name in ("a", "b"):
        picture = tmp_path / name / "store" / "evaluate-1" / "heldout" / "1.png"
        picture.parent.mkdir(parents=True)
        write_image(picture, np.full((200, 600, 3), 90, np.uint8))
        rows.append(ROW | {"folder": name, "picture": "evaluate-1/heldout/1.png"})
    (tmp_path / "b/store/evaluate-1/heldout/1.png").write_text("no picture")
    page = write(tmp_path, *rows)
    (small,) = (tmp_path / fleet_page.PICTURES).iterdir()
    assert page.count("<img") == 1 and small.name in page and small.stat().st_size < 3000
    made = small.stat().st_mtime_ns
    write(tmp_path, *rows)
    assert small.stat().st_mtime_ns == made


@pytest.mark.slow
@pytest.mark.parametrize("width", [1300, 390])
def test_it_opens_in_a_browser(tmp_path, width):
    picture = tmp_path / "a" / "store" / "evaluate-1" / "heldout" / "1.png"
    picture.parent.mkdir(parents=True)
    write_image(picture, np.full((200, 600, 3), 90, np.uint8))
    broken = ROW | {
        "state": "failed",
        "stage": "train",
        "problem": "no person",
        "hint": "film one",
        "facts": ["0 of 9"],
    }
    write(tmp_path, ROW | {"folder": "a", "picture": "evaluate-1/heldout/1.png"}, *[broken] * 40, live=False)
    found, console = browser.probe(tmp_path / "fleet.html", tmp_path, width)
    assert found["images"] == 1 and not found["bad"] and not found["wide"] and not console


def reload(tab: Page, loaded: str) -> None:
    """Load the page of a tab anew, and wait for it."""
    tab.run("window.before = 1; setTimeout(() => location.reload())")

    def is_new() -> bool:
        try:
            return tab.run(f"!window.before && {loaded}")
        except RuntimeError as error:
            if "navigated" not in str(error):  # asked just as the old page went
                raise
            return False

    Flow.wait_for(is_new)


@pytest.mark.slow
def test_a_page_that_is_written_no_more_says_so_and_stays_sorted(tmp_path):
    """Its fleet was killed. Since when is told by the browser's clock alone."""
    write(tmp_path, ROW, ROW | {"clip": "a walk"}, live=True)
    still, loaded = "document.querySelector('#old').hidden", "document.readyState === 'complete'"
    first = "document.querySelector('#clips tbody tr').cells[1].firstChild.textContent"
    with contextlib.closing(Page(tmp_path / "profile", (800, 600), ["--disable-gpu"])) as tab:
        tab.open(tmp_path / "fleet.html", loaded)
        assert tab.run(still) and tab.run(first) == "dance"
        tab.run("document.querySelectorAll('#clips th')[1].click()")
        assert tab.run(first) == "a walk" and tab.run("location.hash") == "#1"
        tab.run("history.replaceState({ ...history.state, since: Date.now() - 1e6 }, '')")
        reload(tab, loaded)
        assert not tab.run(still) and tab.run(first) == "a walk"
        write(tmp_path, ROW, live=True)
        reload(tab, loaded)
        assert tab.run(still), "a new page is no old one"


@pytest.mark.parametrize("key", ["clip", "folder", "pipeline", "problem", "log", "picture"])
def test_a_name_that_is_no_text_hurts_nobody(tmp_path, key):
    strange = os.fsdecode(b"Bj\xf6rn")
    page = write(tmp_path, ROW, ROW | {key: strange, "pages": [f"{strange}.html"]})
    assert "from-mon/dance%20%26%20more/draft/report.html" in page and "Bj%F6rn" in page
