"""A pipeline `tiny` that trains nothing and ends in no time: what runs within a time are tried on."""

from __future__ import annotations

TRAIN = """
'''Writes what it was told; fails while there is a file `stop` beside the video.'''
import json
from pathlib import Path
from stages.contract import Params as Base, StageError

RESUMES = True

class Params(Base):
    seconds: float = 0
    reserve: float = 0
    reserve_least: float = 0
    size: int = 1

def cost(params, folders):
    return 30 + 10 * len(folders)

def run(job, params, *, one):
    '''Write one file.'''
    if Path({stop!r}).exists():
        raise StageError("stopped")
    (job.out / "out.json").write_text(json.dumps(params.model_dump()))
    (job.out / "train.json").write_text(json.dumps({{"last_step_seconds": {step}}}))
"""
AFTER = """
'''Comes after.'''
from stages.contract import Params

def run(job, params, *, train):
    '''Write one file.'''
    (job.out / "out.txt").write_text("done")
"""


def add_tiny(flow):
    """The flow, and a pipeline `tiny` of it with a train stage and one after it."""
    flow.write("train", TRAIN.format(stop=str(flow.folder / "stop"), step=0.1))
    flow.write("after", AFTER)
    stages = {"one": "video", "train": "one", "after": "train"}
    lines = "".join(f"    {n}: {{needs: [{need}], module: flow.{n}}}\n" for n, need in stages.items())
    file = flow.folder / "pipelines.yaml"
    file.write_text(f"{file.read_text()}tiny:\n  doc: Tiny.\n  stages:\n{lines}")
    return flow
