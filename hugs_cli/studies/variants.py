"""Variants of a pipeline, named behind a dot: without a part of the method, or with one axis at another level.

`default.no_lbs` is `default` with train.lbs_learning=false, `default.steps_1000` with train.steps=1000,
`default.perceptual_vgg_4` with train.perceptual_net=vgg and train.perceptual_every=4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

ABLATIONS = {  # the settings of `train` that switch parts of the method off
    "no_lbs": "lbs_learning",
    "no_densify": "human_densify",
    "no_human_loss": "human_loss",
    "no_triplane": "triplane",
    "no_joint": "joint",
}


class Axis(NamedTuple):
    """Settings of one stage that cost time or memory and may buy accuracy, and the levels that `hugs costs` tries."""

    stage: str
    settings: tuple[str, ...]
    levels: dict[tuple[Any, ...], float]
    """Values of the settings -> how many times as long the stage takes, about; only used to say how long a sweep takes."""
    relative: bool = False
    """Levels are factors of what the pipeline has."""
    effect: str = ""
    """The settings only count where survey finds that the clip calls for this."""

    def of(self, own: tuple[Any, ...]) -> dict[tuple[Any, ...], float]:
        """The levels around a pipeline that has the values `own`, which is none of them, and times beside its time."""
        if self.relative:
            return {
                tuple(max(1, round(f * v)) for f, v in zip(fs, own, strict=True)): t for fs, t in self.levels.items()
            }
        return {level: t / self.levels.get(own, 1.0) for level, t in self.levels.items() if level != own}


AXES = {
    "steps": Axis("train", ("steps",), {(0.25,): 0.25, (0.5,): 0.5, (2,): 2.0}, relative=True),
    "half": Axis("train", ("half_until",), {(0.0,): 1.1, (0.4,): 1.0, (1.0,): 0.8}),
    "frames": Axis("train", ("frames_used",), {(8,): 1.0, (16,): 1.0, (32,): 1.0, (0,): 1.0}),
    "points": Axis("train", ("rounds",), {(0,): 0.6, (1,): 1.0, (2,): 2.7}),
    "caps": Axis("train", ("human_cap", "scene_cap"), {(0.5, 0.5): 0.8, (2, 2): 1.4}, relative=True),
    "sh": Axis("train", ("scene_sh",), {(0,): 0.9, (1,): 1.0, (2,): 1.1, (3,): 1.2}, effect="view_dependence"),
    "stop": Axis("train", ("early_stop",), {(1e-6,): 1.1, (1e-4,): 1.0, (1e-3,): 1.0, (1e-2,): 0.95}),
    "perceptual": Axis(
        "train",
        ("perceptual_net", "perceptual_every"),
        {("alex", 0): 1.0, ("alex", 4): 1.1, ("alex", 1): 1.3, ("vgg", 4): 1.5, ("vgg", 1): 3.2},
    ),
    "features": Axis("sfm", ("features",), {(1024,): 0.5, (2048,): 1.0, (4096,): 3.0}),
    "overlap": Axis("sfm", ("overlap",), {(2,): 1.0, (5,): 1.8}),
}


def level_name(axis: str, level: tuple[Any, ...]) -> str:
    """The variant with an axis at a level: 'caps', (20000, 40000) -> 'caps_20000_40000'."""
    return "_".join([axis, *(f"{value:g}" if isinstance(value, float) else str(value) for value in level)])


def changes(variant: str, unknown: Callable[[str], Exception]) -> tuple[str, dict[str, Any]]:
    """The stage and the settings of it that a variant changes, as values or as text; raises `unknown(variant)` for others."""
    if variant in ABLATIONS:
        return "train", {ABLATIONS[variant]: False}
    name, *values = variant.split("_")
    axis = AXES.get(name)
    if axis is None or len(values) != len(axis.settings):
        raise unknown(variant)
    return axis.stage, dict(zip(axis.settings, values, strict=True))
