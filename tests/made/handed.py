"""A pipeline whose stages hand on what `tests.made.tiny` makes: whole runs for nothing, of processes of their own and the cache."""

from __future__ import annotations

import json
from pathlib import Path

from tests.made import tiny

STAGE = '''
"""Hands on a folder."""
import shutil
from stages.contract import Params as Base

class Params(Base):
    made: str
    """Where it is."""

def run(job, params, *, {needs}):
    """Copy it."""
    shutil.copytree(params.made, job.out, dirs_exist_ok=True)
'''
NEEDS = {"frames": ["video"], "sfm": ["frames"], "smpl": ["sfm"], "survey": ["smpl"], "train": ["survey", "mask_files"]}


def pipelines(folder: Path) -> Path:
    """Write the package `handed` and made/ into a folder, which must be on the path; the file of its pipelines, with `default`."""
    made, package = tiny.make(folder / "made"), folder / "handed"
    package.mkdir()
    stages = {}
    for name, needs in NEEDS.items():
        (package / f"{name}.py").write_text(STAGE.format(needs=", ".join(f"{one}=None" for one in needs)))
        stages[name] = {"needs": needs, "module": f"handed.{name}", "params": {"made": str(made[name])}}
    (package / "__init__.py").write_text("")
    file = folder / "handed.yaml"
    file.write_text(json.dumps({"default": {"doc": "All is there.", "stages": stages}}))
    return file
