"""What is installed from a built wheel works without the checkout: commands, pipelines, pages, the free body."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from stages.contract import version
from tests.made.command import ROOT

SOURCE = ("hugs", "hugs_cli", "stages", "pipelines.yaml", "pyproject.toml", "README.md", "LICENSE", "NOTICE")


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder of the scripts of an environment with the wheel; libraries are those here, the checkout is out of reach."""
    folder = tmp_path_factory.mktemp("wheel")
    source, place = folder / "source", folder / "venv"
    source.mkdir()
    for name in SOURCE:
        take = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        take(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder, source]
    subprocess.run(build, check=True, timeout=600)
    venv.create(place)
    (wheel,) = folder.glob("*.whl")
    into = [*pip, "--python", place / "bin/python", "install", "--no-deps", "--no-index", wheel]
    subprocess.run(into, check=True, timeout=600)
    (packages,) = place.glob("lib/python*/site-packages")
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib"))  # of those there, no .pth is followed
    return place / "bin"


@pytest.mark.slow
@pytest.mark.parametrize("script", ["hugs", "hugs-avatar"])
def test_a_wheel_works_in_another_environment_and_folder(installed, tmp_path, script):
    (tmp_path / "clip.mp4").write_bytes(b"pixels")

    def said(*words: str, codes: tuple[int, ...] = (0,)) -> str:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        command = [installed / script, *words]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
        assert done.returncode in codes, done.stdout + done.stderr
        return done.stdout + done.stderr

    assert said("--version").startswith(f"hugs {version()}, "), "without a commit: it is no checkout"
    plan = said("run", "clip.mp4", "--dry-run")
    assert {"frames", "train", "evaluate"} <= {line.split()[0] for line in plan.splitlines() if line.strip()}, plan
    assert "free body" in said("doctor", codes=(0, 1)) and not list(ROOT.glob("build/lib"))
    asked = "import hugs, stages, hugs_cli; print(*(one.__file__ for one in (hugs, stages, hugs_cli)))"
    where = subprocess.run(
        [installed / "python", "-c", asked], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert all(path.startswith(str(Path(installed).parent)) for path in where.stdout.split()), where.stdout
