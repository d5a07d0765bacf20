"""Fit person and scene to the training frames, jointly, and write both as Gaussians that need no network."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stages.contract import ADAM, Job, StageError, whole
from stages.formats.facts import Survey, read_facts
from stages.formats.people import people_of
from stages.training.settings import Params
from stages.training.timing.finishing import finishing_parts

if TYPE_CHECKING:
    import numpy as np

    from stages.training.beginning.start import Task
    from stages.training.run import Breakdown

RESUMES, LOADS = True, ADAM
CHECKPOINT, CHECKPOINT_SECONDS = "checkpoint.pt", 60
LIVE = "live.png"  # the last picture of a training under way


def cost(params: Params, folders: Mapping[str, Path]) -> float:
    """See `contract.StageModule`."""
    return sum(steps for _, steps in finishing_parts(len(people_of(folders["sfm"]))))


def compiled() -> bool:
    """See `contract.StageModule`."""
    from stages.avatar.compiled import is_compiled

    return is_compiled("rasterize/blend.py", "draw_backward")


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, survey: Path) -> None:
    """Fit the Gaussians of person, or people, and scene to the frames, jointly."""
    began = time.perf_counter()
    from stages.training.checkpoint import Checkpoint
    from stages.training.files import write, write_curve
    from stages.training.run import Breakdown
    from stages.training.run import run as train
    from stages.training.timing.window import Window

    if params.seconds and not params.joint:
        hint = "give `train.steps` in place of a time, or leave out `train.joint`"
        raise StageError("only a training of person and scene together can be fitted into a time", hint)
    if job.device == "cpu" and not compiled():
        job.note("the drawing kernels are compiled for this processor first, once: half a minute")
    task, checkpoint = _task(job, params, sfm, smpl, survey), Checkpoint(job.out / CHECKPOINT, job.device)
    try:
        window = Window(partial(_show, job.out), partial(write_curve, job.out))
        result = train(task, job, checkpoint, CHECKPOINT_SECONDS, began, window)
    except Breakdown as broken:
        raise _broken_down(job, broken, {"sfm": sfm, "smpl": smpl, "survey": survey}) from broken
    write(job.out, result)
    for name in (CHECKPOINT, LIVE, "failure.npz"):
        (job.out / name).unlink(missing_ok=True)


def _task(job: Job, params: Params, sfm: Path, smpl: Path, survey: Path) -> Task:
    from stages.estimators.perceptual import network
    from stages.formats.clip import load_people
    from stages.training.beginning.start import Task

    facts, clips = read_facts(survey / "survey.json", Survey), load_people(sfm, smpl)
    perceptual = network(params.perceptual_net, job.device) if params.perceptual_every else None
    return Task(clips, params, facts.decisions, facts.starts, job.seed, job.device, perceptual)


def _show(out: Path, strip: np.ndarray) -> None:
    from stages.formats.images import write_image

    with whole(out / LIVE) as part:
        write_image(part, strip)


def _broken_down(job: Job, broken: Breakdown, folders: dict[str, Path]) -> StageError:
    """The error to raise; failure.npz holds what its `replay` needs."""
    import torch

    from stages.formats.failure import write_failure
    from stages.training.run import LOOK

    file, path = io.BytesIO(), job.out / "failure.npz"
    torch.save(broken.state, file)
    facts = {"error": str(broken), "step": broken.step, "frame": broken.frame, "seed": job.seed, "device": job.device}
    facts |= {"threads": torch.get_num_threads(), "params": broken.params.model_dump(), "decisions": broken.decisions}
    write_failure(path, file.getvalue(), facts | {name: str(folder) for name, folder in folders.items()})
    return StageError(
        "training broke down",
        facts=[
            f"step {broken.step}, frame {broken.frame}: {broken}",
            f"gradients or steps left out so far: {broken.left_out}",
            f"`python -m stages.train {path}` takes that step again",
        ],
        hint=LOOK,
    )


def replay(path: Path) -> None:
    """Repeat the step that broke a training, from its `failure.npz` and the inputs where they were: the same error.

    Bit for bit on a CPU. StageError when the step goes well, as it may after a change of the code.
    """
    import torch

    from stages.formats.failure import read_failure
    from stages.training.beginning.start import build
    from stages.training.checkpoint import BROKEN

    state, facts = read_failure(path)
    torch.set_num_threads(facts.threads)
    job, params = Job(path.parent, facts.device, facts.seed), Params(**facts.params)
    task = _task(job, params, *map(Path, (facts.sfm, facts.smpl, facts.survey)))
    fit = build(replace(task, decisions=facts.decisions), job.note)
    try:
        fit.load(torch.load(io.BytesIO(state), map_location=job.device, weights_only=True))
    except BROKEN as error:
        why = str(error).strip().partition("\n")[0] or type(error).__name__
        hint = "take the step again with the version of hugs that wrote the file"
        raise StageError(f"{path} is of another version of the training", hint, [why]) from error
    fit.advance()
    raise StageError(f"step {facts.step} went well this time", facts=[f"it had failed with: {facts.error}"])


if __name__ == "__main__":
    replay(Path(sys.argv[1]))
