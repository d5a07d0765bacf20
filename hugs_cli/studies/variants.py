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
    """Settings of one stage that trade time or memory for accuracy, and the levels that `hugs costs --sweep` tries."""

    stage: str
    settings: tuple[str, ...]
    levels: dict[tuple[Any, ...], float]
    """Values of the settings -> time of the stage, relative; only to forecast a sweep."""
    relative: bool = False
    """Levels are factors of the pipeline's own values."""
    effect: str = ""
    """The settings matter only if survey turns this effect on."""

    def of(self, own: tuple[Any, ...]) -> dict[tuple[Any, ...], float]:
        """All levels but the pipeline's `own`, with times relative to it."""
        if self.relative:
            return {
                tuple(max(1, round(f * v)) for f, v in zip(fs, own, strict=True)): t for fs, t in self.levels.items()
            }
        return {level: t / self.levels.get(own, 1.0) for level, t in self.levels.items() if level != own}


LPIPS = {("alex", 0): 1.0, ("alex", 4): 1.1, ("alex", 1): 1.3, ("vgg", 4): 1.5, ("vgg", 1): 3.2}
AXES = {
    "steps": Axis("train", ("steps",), {(0.25,): 0.25, (0.5,): 0.5, (2,): 2.0}, relative=True),
    "half": Axis("train", ("half_until",), {(0.0,): 1.1, (0.4,): 1.0, (1.0,): 0.8}),
    "frames": Axis("train", ("frames_used",), {(8,): 1.0, (16,): 1.0, (32,): 1.0, (0,): 1.0}),
    "points": Axis("train", ("human_points",), {(7_000,): 0.6, (27_500,): 1.0, (110_000,): 2.7}),
    "caps": Axis("train", ("human_cap", "scene_cap"), {(0.5, 0.5): 0.8, (2, 2): 1.4}, relative=True),
    "sh": Axis("train", ("scene_sh",), {(0,): 0.9, (1,): 1.0, (2,): 1.1, (3,): 1.2}, effect="view_dependence"),
    "perceptual": Axis("train", ("perceptual_net", "perceptual_every"), LPIPS),
    "features": Axis("sfm", ("features",), {(1024,): 0.7, (1536,): 1.0, (2048,): 1.3, (4096,): 4.0}),
    "overlap": Axis("sfm", ("overlap",), {(2,): 1.0, (5,): 1.8}),
}
"""Times were measured on the phone clip, 2 cores, November 2026."""


def level_name(axis: str, level: tuple[Any, ...]) -> str:
    """The variant with an axis at a level: 'caps', (20000, 40000) -> 'caps_20000_40000'."""
    return "_".join([axis, *(f"{value:g}" if isinstance(value, float) else str(value) for value in level)])


def changes(variant: str, unknown: Callable[[str], Exception]) -> tuple[str, dict[str, Any]]:
    """The stage and settings that a variant changes, as values or text; raises `unknown(variant)` if there is no such variant."""
    if variant in ABLATIONS:
        return "train", {ABLATIONS[variant]: False}
    name, *values = variant.split("_")
    axis = AXES.get(name)
    if axis is None or len(values) != len(axis.settings):
        raise unknown(variant)
    return axis.stage, dict(zip(axis.settings, values, strict=True))
