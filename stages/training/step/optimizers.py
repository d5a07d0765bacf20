"""The optimisers: one Adam each for the person, the scene, effects, and the corrections of frames."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn
from torch.optim import Adam, Optimizer, SparseAdam

from stages.avatar.model.human import HumanModel
from stages.avatar.model.scene import SceneModel
from stages.training.step.refine import BodyCorrections, FrameCorrections
from stages.training.step.schedule import LR_EFFECTS, LR_FRAMES, LR_HUMAN, LR_OWN, LR_SCENE

FRAMES = "frames"
"""How the names begin of optimisers whose parameters have a row a frame."""


def optimizers(
    frames: FrameCorrections,
    people: Mapping[str, tuple[HumanModel, BodyCorrections]],
    scene: SceneModel | None,
    extent: float,
    effects: nn.Module | None = None,
) -> dict[str, Optimizer]:
    """The optimisers of `frames`, of `people` by name, of the `scene`, and of the `effects` that have anything to learn.

    Each group has its `name` and `base` rate, lengths by `extent` m.
    """
    groups = {"frames": _tables(frames)}
    for name, (human, corrections) in people.items():
        groups |= {name: _parts(human), f"{FRAMES} of {name}": _tables(corrections)}
    if scene is not None:
        rates = LR_SCENE | {"means": LR_SCENE["means"] * extent}
        groups["scene"] = [([getattr(scene, name)], name, rate) for name, rate in rates.items()]
    learned = {} if effects is None else dict(effects.named_parameters())
    if learned:
        groups["effects"] = [([p], n, LR_EFFECTS[n.rpartition(".")[2]]) for n, p in learned.items()]
    return {
        name: (SparseAdam if name.startswith(FRAMES) else _adam)(
            [dict(zip(("params", "name", "base"), g)) for g in rows]
        )
        for name, rows in groups.items()
    }


Groups = list[tuple[list[nn.Parameter], str, float]]


def _tables(corrections: nn.Module) -> Groups:
    tables = dict(corrections.named_parameters())
    return [([tables[f"{n}.weight"]], n, rate) for n, rate in LR_FRAMES.items() if f"{n}.weight" in tables]


def _parts(human: HumanModel) -> Groups:
    rates = LR_HUMAN | LR_OWN
    parts = {name: [getattr(owner, name)] for owner, name in human.rows()}
    if human.triplane is not None and human.decoders is not None:
        parts["triplane"] = [human.triplane.table]
        parts |= {name: list(network.parameters()) for name, network in human.decoders.named_children()}
    return [(parameters, name, rates[name]) for name, parameters in parts.items()]


def _adam(groups: list[dict]) -> Adam:
    return Adam(groups, eps=1e-15, fused=True)
