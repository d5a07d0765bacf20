"""What a forecast reads of compiled kernels is what Numba finds."""

import os
import subprocess
import sys
from importlib import metadata

import llvmlite.binding
import pytest

from stages.avatar import compiled
from tests.made.command import ROOT

KERNEL = "kernels/patches.py", "_cost"
COMPILE = """
import numpy as np
from stages.avatar.kernels import patches
patches._cost(np.zeros((9, 9, 3)), 3, 3, 4, 4, 1.0, 1.0)
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A cache in which one kernel is compiled, in a process of its own."""
    home = tmp_path_factory.mktemp("cache")
    environment = os.environ | {"HUGS_CACHE": str(home)}
    subprocess.run([sys.executable, "-c", COMPILE], cwd=ROOT, env=environment, check=True)
    return home


@pytest.fixture(autouse=True)
def only(home, monkeypatch, tmp_path):
    """No other cache is looked into."""
    monkeypatch.setenv("HUGS_CACHE", str(home))
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path))


def test_a_compiled_kernel_is_found_and_no_other(home):
    assert compiled.is_compiled(*KERNEL)
    assert not compiled.is_compiled("kernels/patches.py", "search"), "it was not called"
    assert not compiled.is_compiled("kernels/mesh.py", "_cost")


def test_code_without_kernels_changes_nothing_and_a_source_of_kernels_all(tmp_path, monkeypatch):
    house, known = tmp_path / "stages" / "avatar", compiled.sources()
    for file in (house / "kernels" / "one.py", house / "other.py"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("import math\n")
    assert compiled.sources(house) == [house / "kernels" / "one.py"]
    monkeypatch.setattr(compiled, "sources", lambda: [*known, house / "kernels" / "one.py"])
    assert not compiled.is_compiled(*KERNEL)


def test_those_of_another_installation_version_or_processor_are_not_ours(monkeypatch, tmp_path):
    with monkeypatch.context() as other:
        other.setattr(compiled, "HOUSE", tmp_path)
        assert not compiled.is_compiled(*KERNEL)
    with monkeypatch.context() as other:
        other.setattr(metadata, "version", lambda name: "0.1.2")
        assert not compiled.is_compiled(*KERNEL)
    with monkeypatch.context() as other:
        other.setattr(llvmlite.binding, "get_host_cpu_name", lambda: "486")
        assert not compiled.is_compiled(*KERNEL)


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x05."])
def test_a_broken_file_is_as_none(home, content):
    (index,) = home.rglob("*._cost-*.nbi")
    whole = index.read_bytes()
    index.write_bytes(content)
    assert not compiled.is_compiled(*KERNEL)
    index.write_bytes(whole)
    assert compiled.is_compiled(*KERNEL)


@pytest.mark.slow
def test_it_is_quick_as_neither_numba_nor_torch_is_loaded(home):
    asked = "import sys; from stages import train; train.compiled(); print({'numba', 'torch'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", asked], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout == "set()\n"
