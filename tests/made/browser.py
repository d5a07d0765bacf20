"""A look at a page in Debian's chromium, headless: what it logged, and which pictures and videos did not load."""

from __future__ import annotations

import contextlib
from pathlib import Path

from tests.made.devtools import Page

LOADED = """document.readyState === "complete"
  && [...document.images].every(i => i.naturalWidth || (i.src && i.complete))
  && [...document.querySelectorAll("video")].every(v => v.error || v.videoWidth)"""
FOUND = """{
  const films = [...document.querySelectorAll("video")];
  ({images: document.images.length, films: films.length,
    bad: [...document.images].filter(i => !i.naturalWidth).map(i => i.alt),
    still: films.filter(v => v.error || !v.videoWidth).map(v => v.getAttribute("aria-label")),
    wide: document.documentElement.scrollWidth > innerWidth + 1})
}"""


def probe(page: Path, folder: Path, width: int) -> tuple[dict, list[str]]:
    """What the page holds ({images, bad, films, still, wide}) and what it wrote to the console, `width` px wide."""
    with contextlib.closing(Page(folder / f"profile-{width}", (width, 900), ["--disable-gpu"])) as tab:
        tab.open(page, LOADED)
        return tab.run(FOUND), tab.said
