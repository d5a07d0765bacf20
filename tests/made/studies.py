"""A pipeline `tiny` that trains nothing: what `hugs ablate` and `hugs costs` are tried on."""

from __future__ import annotations

TRAIN = """
'''Writes what it was told; says that it took a second for each 10 steps.'''
import json
from stages.contract import Params as Base, StageError

class Params(Base):
    steps: int = 400
    scene_sh: int = 1
    human_cap: int = 40
    scene_cap: int = 80
    lbs_learning: bool = True
    human_densify: bool = True
    human_loss: bool = True
    triplane: bool = True
    joint: bool = True

def run(job, params, *, one):
    '''Write what was asked for.'''
    if params.scene_sh == 3:
        raise StageError("too many colours", "take fewer")
    told = params.model_dump()
    off = [name for name, value in told.items() if value is False]
    (job.out / "out.txt").write_text(json.dumps([job.seed, off]))
    (job.out / "train.json").write_text(json.dumps({"seconds": told["steps"] / 10, "told": told, "seed": job.seed}))
"""
EVALUATE = """
'''Makes up numbers: 30 dB, 1 more a seed, 5 fewer a missing part, 2 more a doubling of the steps, .01 a degree.'''
import json, math
from stages.contract import Params as Base

class Params(Base):
    scene: bool = True

def run(job, params, *, train):
    '''Write metrics.json.'''
    facts = json.loads((train / "train.json").read_text())
    told = facts["told"]
    off = [name for name, value in told.items() if value is False]
    psnr = 30.0 + facts["seed"] - 5 * len(off) + 2 * math.log2(told["steps"] / 400) + 0.01 * (told["scene_sh"] - 1)
    some, none = {"psnr": psnr, "ssim": 0.9, "lpips": 0.1}, dict.fromkeys(("psnr", "ssim", "lpips"))
    apart = {"full": some, "person_crop": some} if params.scene else {"full": none, "person_crop": none}
    sizes = {"human": told["human_cap"], "scene": told["scene_cap"]}
    (job.out / "metrics.json").write_text(json.dumps({"heldout": {**apart, "person_white": some}, "gaussians": sizes}))
"""
STAGES = {"one": "video", "train": "one", "evaluate": "train"}


def add_tiny(flow):
    """The flow, with a pipeline `tiny` that has a train and an evaluate stage, and `quick`, the same with fewer steps."""
    flow.write("train", TRAIN)
    flow.write("evaluate", EVALUATE)
    lines = "".join(f"    {n}: {{needs: [{need}], module: flow.{n}}}\n" for n, need in STAGES.items())
    quick = "quick:\n  doc: Quick.\n  extends: tiny\n  stages: {train: {params: {steps: 100}}}\n"
    file = flow.folder / "pipelines.yaml"
    file.write_text(f"{file.read_text()}tiny:\n  doc: Tiny.\n  stages:\n{lines}{quick}")
    return flow
