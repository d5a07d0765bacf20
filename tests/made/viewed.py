"""What is done with an open page: files are dropped on it, it is waited for, and its pictures are compared with ours."""

from __future__ import annotations

import base64
import json

import cv2
import numpy as np

from tests.made.devtools import Page


def drop(page: Page, name: str, text: str) -> None:
    """Drop a file of that name onto the page."""
    page.run(
        "(() => { const carried = new DataTransfer();"
        f"carried.items.add(new File([{json.dumps(text)}], {json.dumps(name)}));"
        "window.dispatchEvent(new DragEvent('drop', { dataTransfer: carried, cancelable: true })); })()"
    )


def wait(page: Page, until: str) -> None:
    """Wait until an expression is true in the page; RuntimeError after 20 s."""
    page.run(
        f"new Promise((resolve, reject) => {{ const end = Date.now() + 20000; (function look() {{ if ({until}) resolve();"
        f"else if (Date.now() > end) reject(new Error({json.dumps('never ' + until)})); else setTimeout(look, 20); }})(); }})"
    )


def message(page: Page, words: str) -> None:
    """Wait until the page's message holds these words."""
    wait(page, f"document.getElementById('message').textContent.includes({json.dumps(words)})")


def picture(url: str) -> np.ndarray:
    """The picture [H,W,3] uint8 of a data: URL."""
    data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """PSNR dB of two pictures of 0 to 255."""
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))
