"""What each effect gains and costs in a finished training: held-out frames drawn, and steps taken, without it."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.splats.neighbours import spread_evenly
from stages.training.step.fit import Fit
from stages.training.timing.accuracy import heldout_accuracy

OPTIONS = {
    "pose_refinement": "refine_pose",
    "face": "learn_face",
    "camera_refinement": "refine_camera",
    "exposure": "exposure",
    "antialias": "antialias",
}
PARTS = {
    "shadow": "shadow",
    "shading": "shading",
    "motion_blur": "shutter",
    "rolling_shutter": "readout",
    "clothing": "clothes",
    "transients": "transients",
}
"""Effect -> where a training has it: the option, or the part of its `FrameEffects`; `transients` are its own."""
ONLY_TAUGHT = ("transients",)  # used by the loss alone: held-out frames look the same without
TURNS = 2  # of steps with all effects and without each: the fastest of each, which nothing has disturbed, counts
STEPS = 4  # that are timed at least, always on the same frames
PAUSES = 4  # `effect_gains` takes as long for an effect as so many measurements of accuracy


def effects_of(fit: Fit) -> list[str]:
    """The effects that a training can do without: not the lens, which is sfm's, nor a sky, which nothing replaces.

    Without a scene a shadow falls on nothing: it is kept as `survey` saw it, for films.
    """
    found = [name for name, option in OPTIONS.items() if getattr(fit.options, option)]
    found += [name for name, part in PARTS.items() if getattr(_owner(fit, name), part) is not None]
    if fit.scene is None and "shadow" in found:
        found.remove("shadow")
    return found + ["view_dependence"] * (fit.scene is not None and fit.scene.shN.shape[1] > 0)


def _owner(fit: Fit, effect: str) -> Fit | FrameEffects:
    return fit if effect == "transients" else fit.effects


@contextmanager
def without(fit: Fit, effect: str) -> Iterator[None]:
    """Take one of its `effects_of` out of a training, and put it back afterwards."""
    options, owner, scene, speeds = fit.options, _owner(fit, effect), fit.scene, fit.speeds
    part = getattr(owner, PARTS[effect]) if effect in PARTS else None
    colors = None if scene is None else (scene.shN, scene.antialias)
    if effect in OPTIONS:
        fit.options = options._replace(**{OPTIONS[effect]: False})
    if effect in PARTS:
        setattr(owner, PARTS[effect], None)
        fit.speeds = speeds if fit.effects.takes_time else None
    if effect == "antialias" and scene is not None:
        scene.antialias = False
    if effect == "view_dependence" and scene is not None:
        scene.shN = torch.nn.Parameter(scene.shN.detach()[:, :0])
    try:
        yield
    finally:
        fit.options, fit.speeds = options, speeds
        if effect in PARTS:
            setattr(owner, PARTS[effect], part)
        if scene is not None and colors is not None:
            scene.shN, scene.antialias = colors


def effect_gains(fit: Fit, frames: list[int], far: list[int]) -> dict[str, dict[str, float | None]]:
    """Of each effect `psnr` and `psnr_person`, dB that `frames` lose drawn without it, `psnr_far`, dB that the person loses in
    the frames `far` whose poses are unlike those of training, and `share` of a step's time it takes.

    The rest was trained beside it: a training without it may lose less. None where nothing tells. The training is then
    as it was, bit for bit, also where a step fails as in `Fit.advance`.
    """
    effects = effects_of(fit)
    if not effects:
        return {}
    whole, found = _psnr(fit, frames, far), {}
    for name in effects:
        with without(fit, name):
            drawn = _psnr(fit, frames, far) if name not in ONLY_TAUGHT else {}
        found[name] = {key: _less(whole[key], drawn.get(key)) for key in whole}
    before, spent = copy.deepcopy(fit.state()), dict(fit.clock.seconds)
    fit.progress.freeze()
    try:
        least = dict.fromkeys(["", *effects], math.inf)  # without an effect; "": with all of them
        for _ in range(TURNS):
            for name in least:
                with without(fit, name) if name else nullcontext():
                    least[name] = min(least[name], _seconds(fit))
        for name in effects:
            found[name]["share"] = 1 - least[name] / least[""]
    finally:
        fit.load(before)
        fit.clock.seconds = spent
    return found


def _psnr(fit: Fit, frames: list[int], far: list[int]) -> dict[str, float | None]:
    cast, views = fit.cast(), fit.seen()
    near, new = (heldout_accuracy(cast, views, some) for some in (frames, far))
    return {key: near[key] for key in ("psnr", "psnr_person")} | {"psnr_far": new["psnr_person"]}


def _seconds(fit: Fit) -> float:
    """Seconds of at least STEPS steps, as many as whole runs of the networks have; processor time where the CPU draws."""
    clock = time.process_time if fit.full.viewmats.device.type == "cpu" else _all_done
    count = -(-STEPS // fit.params.views_per_decode) * fit.params.views_per_decode
    fit.order, began = torch.tensor(spread_evenly(list(range(len(fit.train))), count)), clock()
    for _ in range(count):
        fit.advance()
    return clock() - began


def _all_done() -> float:
    """The time at which a GPU has done all that it was asked, s."""
    torch.cuda.synchronize()
    return time.perf_counter()


def _less(whole: float | None, drawn: float | None) -> float | None:
    return None if whole is None or drawn is None else whole - drawn
