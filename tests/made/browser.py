"""A look at a page in Debian's chromium, headless: what it logged, and which pictures and videos did not load."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --enable-logging=stderr --virtual-time-budget=15000"
).split()
PROBE = """<script>addEventListener("load", () => setTimeout(() => {
  const bad = [...document.images].filter(i => !i.naturalWidth).map(i => i.alt);
  const films = [...document.querySelectorAll("video")];
  const still = films.filter(v => v.error || !v.videoWidth).map(v => v.getAttribute("aria-label"));
  const wide = document.documentElement.scrollWidth > innerWidth + 1;
  const found = {images: document.images.length, bad, films: films.length, still, wide};
  document.body.innerHTML = "<pre id=probe>" + JSON.stringify(found) + "</pre>";
}, 3000))</script>"""


def probe(page: Path, folder: Path, width: int) -> tuple[dict, list[str]]:
    """What the page holds ({images, bad, films, still, wide}) and what it wrote to the console, `width` px wide."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed: `apt-get install chromium`")
    copy = folder / f"probe-{width}.html"
    copy.write_text(page.read_text(encoding="utf-8") + PROBE, encoding="utf-8")
    size, profile = f"--window-size={width},900", f"--user-data-dir={folder / f'profile-{width}'}"
    done = subprocess.run(
        [chromium, *FLAGS, size, profile, "--dump-dom", copy.as_uri()], capture_output=True, text=True, timeout=120
    )
    found = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, f"the page never finished loading\n{done.stderr[-2000:]}"
    return json.loads(found[1].replace("&amp;", "&")), re.findall(r"CONSOLE.*", done.stderr)
