"""Where Gaussians are added and removed: clone, split and prune, each set with its own statistics and its own cap."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.splats.neighbours import nearest

if TYPE_CHECKING:
    from stages.avatar.model.human import HumanModel
    from stages.avatar.model.scene import SceneModel

FAR = 0.1  # metres from the body; hair and clothes seldom reach beyond
LEAST = 1e-6  # distance of an opacity from 0 and 1 where its logit is taken
SHRINK = 1.6  # the children of a split are this much smaller (3DGS section 5.2)


class Rules(NamedTuple):
    """What is dense enough, too large or too faint; lengths in metres, `grad` in loss per half image side."""

    grad: float  # mean absolute screen gradient from which a Gaussian is under-fitted
    dense_size: float  # larger ones are split, smaller ones cloned
    max_size: float  # larger ones are removed
    max_radius: float  # on screen, in image sides: larger ones are split whatever their gradient
    min_opacity: float
    cap: int


class Growth:
    """Screen gradients and radii of one set of Gaussians since the last densification."""

    def __init__(self, rows: int, device: torch.device | str = "cpu"):
        self.start(rows, device)

    def start(self, rows: int, device: torch.device | str) -> None:
        """Forget everything; there are now `rows` Gaussians."""
        self.grad, self.count, self.radius = torch.zeros(3, rows, device=device)

    @torch.no_grad()
    def add(self, screen_grad_abs: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add one view: screen_grad_abs[N,2] = sum over pixels of |dL/d means2d| per px, radii[N] px (0 = not drawn).

        Both are made independent of the resolution; rows that are not finite do not count.
        """
        grad = screen_grad_abs.norm(dim=1) * (0.5 * max(width, height))
        drawn = (radii > 0) & grad.isfinite()
        self.grad += torch.where(drawn, grad, 0)
        self.count += drawn
        self.radius = torch.maximum(self.radius, radii.to(self.radius) / max(width, height))

    def mean(self) -> Tensor:
        """Mean gradient [N]; 0 for a Gaussian that was never drawn."""
        return self.grad / self.count.clamp_min(1)

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {"grad": self.grad, "count": self.count, "radius": self.radius}

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from `state()`."""
        self.grad, self.count, self.radius = (state[k].clone() for k in ("grad", "count", "radius"))


class Plan(NamedTuple):
    """Rows of the next set: `source`[M] the old row of each, `fresh`[M] new ones, `child`[M] parts of a split."""

    source: Tensor
    fresh: Tensor
    child: Tensor
    cloned: int
    split: int
    pruned: int


@torch.no_grad()
def plan(growth: Growth, sizes: Tensor, opacities: Tensor, rules: Rules, room: int, lost: Tensor | None = None) -> Plan:
    """Decide which rows to clone, split and prune; sizes[N] largest scale in metres, opacities[N].

    At most `room` rows are added, those of the largest gradient first, and none where `rules.cap` rows or more stay.
    Rows that are not finite and `lost`[N] ones are pruned. Raises ValueError when nothing would be left.
    """
    finite = sizes.isfinite() & opacities.isfinite()
    faint = opacities < rules.min_opacity
    huge = sizes > rules.max_size
    keep = finite & ~faint & ~huge
    if lost is not None:
        keep &= ~lost
    kept = int(keep.sum())
    if kept == 0:
        raise ValueError(
            f"all {len(sizes)} Gaussians would be pruned: {int(faint.sum())} with opacity under {rules.min_opacity}, "
            f"{int(huge.sum())} larger than {rules.max_size:.3g} m, {int((~finite).sum())} not finite"
        )
    grad = growth.mean()
    wide = growth.radius > rules.max_radius
    wants = keep & ((grad >= rules.grad) | wide)
    room = max(0, min(room, rules.cap - kept, int(wants.sum())))
    score = torch.where(wants, grad + wide * grad.max().clamp_min(1), -1.0)
    chosen = torch.zeros_like(keep)
    chosen[score.argsort(descending=True, stable=True)[:room]] = True
    splits = chosen & ((sizes > rules.dense_size) | wide)
    clones = chosen & ~splits
    stay = (keep & ~splits).nonzero()[:, 0]
    copies, parents = clones.nonzero()[:, 0], splits.nonzero()[:, 0]
    source = torch.cat([stay, copies, parents, parents])
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    child = torch.arange(len(source), device=source.device) >= len(stay) + len(copies)
    return Plan(source, fresh, child, len(copies), len(parents), len(sizes) - kept)


def strays(means: Tensor, body: Tensor) -> Tensor:
    """Which of the canonical means[N,3] are farther than FAR from all of the body's vertices[V,3]: no part of a person."""
    distance, _ = nearest(body, means, 1)
    return distance[:, 0] > FAR


def grow_scene(
    scene: SceneModel, optimizer: Optimizer, growth: Growth, rules: Rules, rounds_left: int, generator: torch.Generator
) -> Plan:
    """Densify the scene in place and start new statistics; the way to the cap is shared among `rounds_left` rounds."""
    scales = scene.log_scales.detach().exp()
    opacities, room = scene.logit_opacities.detach().sigmoid(), _room(scene, rules, rounds_left)
    rows = plan(growth, scene.sizes().amax(1), opacities, rules, room)
    moved = displacement(matrix_from_quat(scene.quats.detach()) * scales[:, None, :], rows, generator)
    for name in scene.ROWS:
        setattr(scene, name, _regrow(optimizer, getattr(scene, name), rows))
    with torch.no_grad():
        scene.means += moved
        scene.log_scales[rows.child] -= math.log(SHRINK)
    growth.start(len(scene), scene.means.device)
    return rows


def grow_human(
    human: HumanModel,
    optimizer: Optimizer,
    growth: Growth,
    rules: Rules,
    rounds_left: int,
    body: Tensor,
    generator: torch.Generator,
) -> Plan:
    """Densify the person in place, as `grow_scene`; sizes and opacities are those decoded now.

    Those that strayed from the canonical body's vertices `body`[V,3] go.
    """
    with torch.no_grad():
        person, *_ = human()
    lost = strays(person.means, body)
    room = _room(human, rules, rounds_left)
    rows = plan(growth, person.scales.amax(1), person.opacities, rules, room, lost)
    moved = displacement(person.rotations * person.scales[:, None, :], rows, generator)
    thinned = thinner(person.opacities, rows)
    for owner, name in human.rows():
        setattr(owner, name, _regrow(optimizer, getattr(owner, name), rows))
    for name in human.ROWS:
        setattr(human, name, getattr(human, name)[rows.source])
    with torch.no_grad():
        human.xyz += moved
        human.homes[rows.fresh] = human.xyz[rows.fresh]
        human.log_sizes[rows.child] -= math.log(SHRINK)
        human.logits += thinned
    growth.start(len(human), human.xyz.device)
    return rows


def thinner(opacities: Tensor, rows: Plan) -> Tensor:
    """What to add to the opacities' logits [M], so that the two that come of one let as much light through as it did.

    1 - (1 - opacity)^(1/2) for opacities[N] in 0..1, finite also at both ends (Rota Bulò et al. 2024, "Revising
    Densification in Gaussian Splatting").
    """
    parts = torch.bincount(rows.source, minlength=len(opacities))[rows.source]
    old = opacities[rows.source].clamp(LEAST, 1 - LEAST)
    return (1 - (1 - old) ** (1 / parts)).logit() - old.logit()


def _room(model: HumanModel | SceneModel, rules: Rules, rounds_left: int) -> int:
    return max(0, rules.cap - len(model)) // max(1, rounds_left)


def _regrow(optimizer: Optimizer, parameter: torch.nn.Parameter, rows: Plan) -> torch.nn.Parameter:
    """The parameter [N,...] with the rows of the plan; its Adam moments follow their rows and are 0 for new ones."""
    grown = torch.nn.Parameter(parameter.detach()[rows.source])
    state = optimizer.state.pop(parameter, None)
    if state is not None:
        moved = dict(state)
        for name in ("exp_avg", "exp_avg_sq"):
            moments = state[name][rows.source]
            moments[rows.fresh] = 0
            moved[name] = moments
        optimizer.state[grown] = moved
    for group in optimizer.param_groups:
        group["params"] = [grown if p is parameter else p for p in group["params"]]
    return grown


def displacement(axes: Tensor, rows: Plan, generator: torch.Generator) -> Tensor:
    """Offsets [M,3] in metres: new rows are drawn from their parent's own Gaussian, `axes`[N,3,3]; old rows stay."""
    noise = torch.randn(len(rows.source), 3, 1, generator=generator).to(axes)
    return (axes[rows.source] @ noise)[:, :, 0] * rows.fresh[:, None]
