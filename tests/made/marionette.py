"""A page in Debian's Firefox, on a screen of its own (Xvfb), driven through the Marionette protocol."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

PORT = 28281
SETTINGS = {
    "marionette.port": PORT,
    "remote.prefs.recommended": True,
    "webgl.force-enabled": True,
}  # WebGL without a card
SCRIPT = """const done = arguments[0];
(async () => (%s))().then((value) => done([value, ""])).catch((error) => done([null, `${error}`]))"""


class Firefox:
    """One tab."""

    def __init__(self, folder: Path):
        for program, package in (("firefox-esr", "firefox-esr"), ("xvfb-run", "xvfb xauth")):
            if shutil.which(program) is None:
                pytest.skip(f"{program} is not installed: `apt-get install {package}`")
        folder.mkdir()
        lines = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in SETTINGS.items())
        (folder / "user.js").write_text("".join(lines))
        self.process = subprocess.Popen(
            ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24", "firefox-esr", "--marionette", "--no-remote"]
            + ["--profile", str(folder)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1", "MOZ_DISABLE_AUTO_SAFE_MODE": "1"},
        )  # fmt: skip
        self.buffer, self.sent = b"", 0
        self.line = self._connect(time.monotonic() + 60)
        self._next()  # it greets
        self.ask("WebDriver:NewSession", capabilities={"alwaysMatch": {"pageLoadStrategy": "none"}})
        self.ask("WebDriver:SetTimeouts", script=120_000)

    def ask(self, name: str, **params: Any) -> Any:
        """Call a command of the protocol; its result. Raises RuntimeError where the browser refuses."""
        self.sent += 1
        message = json.dumps([0, self.sent, name, params]).encode()
        self.line.sendall(b"%d:%s" % (len(message), message))
        while True:
            _, number, error, result = self._next()
            if number == self.sent:
                if error:
                    raise RuntimeError(f"{name}: {error['message']}")
                return result

    def run(self, script: str) -> Any:
        """The value of an expression in the page, awaited; RuntimeError if it throws."""
        found = self.ask(
            "WebDriver:ExecuteAsyncScript", script=SCRIPT % script, args=[], newSandbox=False, sandbox=None
        )
        value, error = found["value"]
        if error:
            raise RuntimeError(error)
        return value

    def open(self, page: Path, until: str, seconds: float = 60) -> None:
        """Open a file and wait until the expression `until` is true in it."""
        self.ask("WebDriver:Navigate", url=f"{page.as_uri()}#still")
        end = time.monotonic() + seconds
        while not self.run(until):
            assert time.monotonic() < end, f"never {until}: {self.run('document.body?.innerText')}"
            time.sleep(0.05)

    def close(self) -> None:
        """End the browser and its screen."""
        self.line.close()
        os.killpg(self.process.pid, signal.SIGTERM)
        self.process.wait(20)

    def _connect(self, end: float) -> socket.socket:
        while True:
            try:
                return socket.create_connection(("127.0.0.1", PORT), timeout=120)
            except OSError:
                assert time.monotonic() < end and self.process.poll() is None, "Firefox does not listen"
                time.sleep(0.2)

    def _next(self) -> Any:
        while b":" not in self.buffer:
            self._more()
        size, _, rest = self.buffer.partition(b":")
        while len(rest) < int(size):
            self._more()
            rest = self.buffer.partition(b":")[2]
        self.buffer = rest[int(size) :]
        return json.loads(rest[: int(size)])

    def _more(self) -> None:
        part = self.line.recv(1 << 20)
        assert part, "the browser ended"
        self.buffer += part
