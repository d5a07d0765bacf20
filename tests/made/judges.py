"""Independent programs that judge our files, from npm: installed once into the user's cache, in these versions."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest

PACKAGES = {
    "@pixiv/three-vrm": "3.5.5",
    "@playcanvas/splat-transform": "3.7.0",
    "@sparkjsdev/spark": "2.2.0",
    "gltf-validator": "2.0.0-dev.3.10",
    "splat-transform-2": "npm:@playcanvas/splat-transform@2.7.1",
    "three": "0.187.0",
}
FOLDER = "HUGS_NODE_MODULES"  # the environment variable that names a folder which has them already


@cache
def modules() -> Path:
    """The folder node_modules with PACKAGES; the test is skipped where there is no node or npm."""
    if given := os.environ.get(FOLDER):
        return Path(given).resolve()
    if missing := [name for name in ("node", "npm") if shutil.which(name) is None]:
        pytest.skip(f"{' and '.join(missing)} is not installed: no judge from npm")
    wanted = json.dumps({"private": True, "dependencies": PACKAGES})
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hugs"
    folder = home / f"judges-{hashlib.sha256(wanted.encode()).hexdigest()[:8]}"
    home.mkdir(parents=True, exist_ok=True)
    with (home / "judges.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several workers want them at once
        if not folder.is_dir():
            part = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            (part / "package.json").write_text(wanted)
            command = "npm install --no-audit --no-fund --ignore-scripts --no-package-lock --loglevel=error".split()
            said = subprocess.run(command, cwd=part, capture_output=True, text=True)
            assert said.returncode == 0, f"npm cannot install the judges: {said.stderr}"
            part.rename(folder)
    return folder / "node_modules"


def node(*arguments: str | Path) -> str:
    """What a script or a program for node prints; AssertionError with its words where it fails."""
    said = subprocess.run(["node", *map(str, arguments)], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    return said.stdout


def faults(glb: Path) -> list[dict[str, object]]:
    """What the validator of Khronos says of a GLB, and of extensions that it does not know nothing."""
    script = (
        "require(process.argv[1]+'/gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync("
        "process.argv[2])),{maxIssues:0}).then(r=>console.log(JSON.stringify(r.issues.messages)))"
    )
    said = json.loads(node("-e", script, modules(), glb))
    return [one for one in said if one["code"] != "UNSUPPORTED_EXTENSION"]
