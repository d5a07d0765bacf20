"""Libraries with native code that must not meet in the wrong order: seen by exit codes, since Python cannot catch it."""

import itertools
import subprocess
import sys

import pytest

WRITE = """
import importlib, sys
for module in sys.argv[2:]:
    importlib.import_module(module)
import numpy as np
from pathlib import Path
from stages.formats.images import read_image, write_image
write_image(Path(sys.argv[1]), np.full((40, 50, 3), 90, np.uint8))
assert (read_image(Path(sys.argv[1])) == 90).all()
"""
OURS = ["stages.estimators.cameras.colmap", "stages.formats.images", "stages.avatar.cameras.lens"]


@pytest.mark.slow
@pytest.mark.parametrize("order", list(itertools.permutations(OURS, 2))[:3] + [("stages.sfm", OURS[0], "torch")])
def test_i19_a_picture_is_written_whatever_was_imported_first(tmp_path, order):
    command = [sys.executable, "-c", WRITE, str(tmp_path / "a.png"), *order]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{order}: exit {done.returncode} {done.stderr[-300:]}"
