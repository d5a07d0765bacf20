"""A page in Debian's chromium, headless and without a network, driven through the DevTools protocol over two pipes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless=new --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --hide-scrollbars --host-resolver-rules=MAP/*/~NOTFOUND --remote-debugging-pipe"
).split()
SOFTWARE = "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist".split()
FROM_BROWSER, TO_BROWSER = 4, 3  # the numbers that chromium expects


class Page:
    """One tab. `requests` are the addresses that it asked for, `said` what it wrote to the console or threw."""

    def __init__(self, folder: Path, size: tuple[int, int] = (640, 480), flags: list[str] = SOFTWARE):
        chromium = shutil.which("chromium")
        if chromium is None:
            pytest.skip("chromium is not installed: `apt-get install chromium`")
        read_there, self.write_here = os.pipe()
        self.read_here, write_there = os.pipe()
        options = [one.replace("/", " ") if one.startswith("--host") else one for one in FLAGS]
        options += [*flags, f"--user-data-dir={folder}", f"--window-size={size[0]},{size[1]}", "about:blank"]
        start = f'exec "$@" {TO_BROWSER}<&{read_there} {FROM_BROWSER}>&{write_there}'
        self.process = subprocess.Popen(
            ["bash", "-c", start, "bash", chromium, *options],
            pass_fds=(read_there, write_there), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read_there)
        os.close(write_there)
        self.session, self.sent, self.buffer = "", 0, b""
        self.requests: list[str] = []
        self.said: list[str] = []
        (tab,) = (one for one in self.ask("Target.getTargets")["targetInfos"] if one["type"] == "page")
        self.session = self.ask("Target.attachToTarget", targetId=tab["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.ask(f"{domain}.enable")
        self.ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol; its result. Raises RuntimeError where the browser refuses."""
        self.sent += 1
        message = {"id": self.sent, "method": method, "params": params}
        data = json.dumps(message | ({"sessionId": self.session} if self.session else {})).encode() + b"\0"
        while data:
            data = data[os.write(self.write_here, data) :]
        while True:
            found = self._next()
            if found.get("id") == self.sent:
                if "error" in found:
                    raise RuntimeError(f"{method}: {found['error']}")
                return found["result"]
            self._note(found)

    def run(self, script: str) -> Any:
        """The value of an expression in the page, awaited; RuntimeError if it throws."""
        found = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"].get("exception", {}).get("description", "the script failed"))
        return found["result"].get("value")

    def open(self, page: Path, until: str, seconds: float = 600) -> None:
        """Open a file and wait until the expression `until` is true in it."""
        self.ask("Page.navigate", url=f"{page.as_uri()}#still")
        end = time.monotonic() + seconds
        while not self.run(until):
            assert time.monotonic() < end, f"never {until}: {self.run('document.body?.innerText')}\n{self.said}"
            time.sleep(0.05)

    def close(self) -> None:
        """End the browser."""
        self.session = ""
        self.ask("Browser.close")
        self.process.wait(600)
        os.close(self.read_here)
        os.close(self.write_here)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            part = os.read(self.read_here, 1 << 20)
            assert part, "the browser ended"
            self.buffer += part
        message, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        kind, params = event.get("method"), event.get("params", {})
        if kind == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif kind == "Runtime.consoleAPICalled":
            self.said.append(" ".join(str(one.get("value", one.get("description"))) for one in params["args"]))
        elif kind == "Runtime.exceptionThrown":
            self.said.append(str(params["exceptionDetails"]))
        elif kind == "Log.entryAdded":
            self.said.append(" ".join(params["entry"][key] for key in ("text", "url") if key in params["entry"]))
