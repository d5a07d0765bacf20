"""How large a metre is: by the body alone, or by heights and lengths that the user knows; how surely, and what disagrees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stages.contract import StageError
from stages.estimators.words import listed
from stages.records import BodyModel, BodyPoses

BY_BODY = 0.18  # of the metre, within which nine of ten bodies are as tall as they look: people's proportions tell little of it
BY_HEIGHT = 0.05  # and within which a given height sets it: legs are more bent than they look, the crown is under hair
AGREE = 2**0.5 * BY_HEIGHT  # by which two that know it may differ


@dataclass(frozen=True)
class Metre:
    """By how much each person's fit is made larger, `factors`, and that of the first the world.

    `how` it is known, in words; in nine of ten cases to `error` of itself, None where it is as given. `doubts` are sentences.
    """

    factors: tuple[float, ...]
    how: str
    error: float | None
    doubts: tuple[str, ...] = ()

    @property
    def given(self) -> bool:
        """Whether the user knew it."""
        return self.how != OWN


OWN = "as tall as the body looks"


def find_metre(
    statures: Sequence[float],
    metres: float,
    moving: bool,
    heights: Mapping[int, float],
    scale: Literal["cameras"] | tuple[float, float] | None,
) -> Metre:
    """The metre of people whose fits are `statures` m tall, where a unit of the cameras is `metres` m.

    `heights` m of some, by number from 1 on. `scale` wins over them: (length m of the fit, its true one), or the cameras' unit is a
    metre. A camera that is not `moving` shows no size: there each person of known height is sized alone. StageError for a height
    of nobody, and for the unit of cameras that stand still.
    """
    if strangers := [who for who in heights if who > len(statures)]:
        count = "one person" if len(statures) == 1 else f"{len(statures)} people"
        hint = "`--person all` makes an avatar of each; a person who is followed alone has the number 1"
        raise StageError(f"a height is given for person {strangers[0]}, but there is {count}", hint)
    by_height = {who: tall / statures[who - 1] for who, tall in heights.items()}
    named = listed([f"{heights[who]:.2f} m of person {who}" for who in sorted(heights)])
    if scale is None and not heights:
        return Metre((1.0,) * len(statures), OWN, BY_BODY)
    if scale is None:
        mean = float(np.exp(np.mean(np.log(list(by_height.values())))))
        how = f"by the height given, {named}" if len(heights) == 1 else f"by the heights given, {named}"
        if not moving:
            return Metre(tuple(by_height.get(who, mean) for who in range(1, 1 + len(statures))), how, BY_HEIGHT)
        return Metre((mean,) * len(statures), how, BY_HEIGHT, _apart(by_height, mean, metres))
    if scale == "cameras" and not moving:
        raise StageError("cameras that do not move show no metre", "give the person's height: `--height 1.85`")
    shared = 1 / metres if scale == "cameras" else scale[1] / scale[0]
    how = "by the given cameras, in metres"
    if scale != "cameras":
        how = f"by a length given, {scale[1]:.2f} m for the {scale[0]:.2f} m of the fit"
    doubts = [
        f"the height given of person {who}, {heights[who]:.2f} m, is {_percent(factor / shared)} off: {how} it is"
        f" {shared * statures[who - 1]:.2f} m, which counts"
        for who, factor in by_height.items()
        if abs(np.log(factor / shared)) > AGREE
    ]
    return Metre((shared,) * len(statures), how, None, tuple(doubts))


def stature_of(model: BodyModel, poses: BodyPoses) -> float:
    """Height in m of the body at rest."""
    return float(np.ptp((model.v_template + model.shapedirs @ poses.betas)[:, 1]))


def resized(
    model: BodyModel, poses: BodyPoses, factor: float, world: float, center: np.ndarray
) -> tuple[BodyModel, BodyPoses]:
    """The same pictures of a body `factor` times as large, in a world where a unit of the cameras is `world` m.

    `center` [3] is the middle of the cameras, in their unit. Where `factor` is that of the world too, all of it grows alike.
    """
    about = poses.world_from_sfm * center
    placed = replace(poses, transl=factor * (poses.transl - about) + world * center, world_from_sfm=world)
    return model.sized(factor), placed


def _apart(by_height: Mapping[int, float], mean: float, metres: float) -> tuple[str, ...]:
    """A sentence if people's heights make metres that differ."""
    low, high = (pick(by_height, key=by_height.__getitem__) for pick in (min, max))
    if np.log(by_height[high] / by_height[low]) <= AGREE:
        return ()
    units = ", ".join(f"{factor * metres:.4g} m by person {who}" for who, factor in sorted(by_height.items()))
    off = _percent(by_height[high] / by_height[low])
    return (f"the given heights differ by {off}: a unit of the cameras is {units}; {mean * metres:.4g} m is taken",)


def _percent(ratio: float) -> str:
    return f"{100 * abs(ratio - 1):.0f} %"
