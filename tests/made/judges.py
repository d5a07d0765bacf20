"""Independent programs that judge our files: installed once into the user's cache, in these versions."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

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
BLENDER = {(3, 11): "5.0.1", (3, 13): "5.3.0"}
"""Python -> the bpy of it."""


@cache
def modules() -> Path:
    """The folder node_modules with PACKAGES; the test is skipped where there is no node or npm."""
    if given := os.environ.get(FOLDER):
        return Path(given).resolve()
    if missing := [name for name in ("node", "npm") if shutil.which(name) is None]:
        pytest.skip(f"{' and '.join(missing)} is not installed: no judge from npm")
    wanted = json.dumps({"private": True, "dependencies": PACKAGES})

    def install(part: Path) -> None:
        (part / "package.json").write_text(wanted)
        command = "npm install --no-audit --no-fund --ignore-scripts --no-package-lock --loglevel=error".split()
        said = subprocess.run(command, cwd=part, capture_output=True, text=True)
        assert said.returncode == 0, f"npm cannot install the judges: {said.stderr}"

    return _once(wanted, install) / "node_modules"


def _once(wanted: str, install: Callable[[Path], None]) -> Path:
    """The folder of the user's cache in which `install` has put what is `wanted`."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hugs"
    folder = home / f"judges-{hashlib.sha256(wanted.encode()).hexdigest()[:8]}"
    home.mkdir(parents=True, exist_ok=True)
    with (home / "judges.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several workers want them at once
        if not folder.is_dir():
            part = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            install(part)
            part.rename(folder)
    return folder


def blender(script: str, *arguments: str | Path) -> Any:
    """What a script of tests/tools prints as JSON in its last line, run by Blender's Python package; the test is skipped where
    there is none for this Python.
    """
    if (version := BLENDER.get(sys.version_info[:2])) is None:
        pytest.skip(f"no bpy for Python {platform.python_version()}")
    wanted = f"bpy=={version}"

    def install(part: Path) -> None:
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(part), wanted]
        said = subprocess.run(command, capture_output=True, text=True)
        assert said.returncode == 0, f"pip cannot install {wanted}: {said.stderr}"

    place = Path(__file__).parents[1] / "tools" / script
    said = subprocess.run(
        [sys.executable, str(place), *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(_once(wanted, install))},
    )
    assert said.returncode == 0, said.stderr
    return json.loads(said.stdout.strip().splitlines()[-1])


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
