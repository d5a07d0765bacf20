"""What doctor looks at, and what it does about what is missing."""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from hugs_cli import doctor
from hugs_cli.doctor import Finding
from stages.estimators import assets

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of model files."""
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    return tmp_path


def test_every_declared_dependency_is_looked_at():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {entry.partition(">")[0].partition("=")[0].partition("<")[0] for entry in project["dependencies"]}
    assert set(doctor.DISTRIBUTIONS.values()) == declared


def test_missing_models_are_named_with_the_command_that_brings_them(cache, monkeypatch):
    found = {finding.name: finding for finding in doctor.examine()}
    for name in assets.ASSETS:
        assert not found[name].ok and found[name].hint == "hugs doctor --fetch"
        (cache / name).write_text("")
    assert [finding.ok for finding in doctor.models()] == [True, True] + [False] * len(assets.ASSETS), (
        "not what was fetched"
    )
    monkeypatch.setattr(assets, "present", lambda name: True)
    assert all(finding.ok for finding in doctor.models())
    assert found["torch"].ok and found["codec libx264"].ok and found["memory"].text.endswith("GiB")


def test_fetch_brings_only_what_is_missing(cache, monkeypatch):
    first, *rest = assets.ASSETS
    asked = []
    monkeypatch.setattr(assets, "present", lambda name: name == first)
    monkeypatch.setattr(assets, "fetch", lambda name, say: asked.append(name))
    doctor.fetch_missing(print)
    assert asked == rest


def test_exit_code_says_whether_something_needed_is_missing(cache):
    code = "import sys; sys.argv[1:] = ['doctor', '--json']; from hugs_cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    findings = [Finding(**row) for row in json.loads(done.stdout)]
    assert done.returncode == 1 and not all(finding.ok for finding in findings)


def test_gsplat_that_is_built_needs_no_compiler(tmp_path, monkeypatch):
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: SimpleNamespace(submodule_search_locations=[tmp_path])
    )
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.5.3")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert not doctor.gsplat().ok and "nvcc" in doctor.gsplat().hint
    (tmp_path / "csrc.cpython-312-x86_64-linux-gnu.so").touch()
    assert doctor.gsplat().ok
