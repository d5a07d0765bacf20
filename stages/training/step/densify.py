"""Where Gaussians are added and removed: clone, split and prune, each set with its own statistics and its own cap."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.model.human import HumanModel
from stages.avatar.model.scene import SceneModel
from stages.training.seen import far_from_surface
from stages.training.settings import Params
from stages.training.step.person import PersonLearner
from stages.training.step.schedule import HUMAN_GROWTH, SCENE_GROWTH, SETTLE, Options, Progress

GROWN = 2e-4  # mean absolute gradient, in loss per half image side, from which a Gaussian is under-fitted
FILLS = 10  # at most; each at most doubles a set
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
        scene.means.add_(moved)
        scene.log_scales[rows.child] -= math.log(SHRINK)
    growth.start(len(scene), scene.means.device)
    return rows


def grow_human(
    human: HumanModel,
    optimizer: Optimizer,
    growth: Growth,
    rules: Rules,
    rounds_left: int,
    surface: Tensor,
    generator: torch.Generator,
) -> Plan:
    """Densify the person in place, as `grow_scene`; sizes and opacities are those decoded now.

    Those far from the canonical person's `surface`[S,3] m go.
    """
    with torch.no_grad():
        person, *_ = human()
    lost = far_from_surface(person.means, surface)
    room = _room(human, rules, rounds_left)
    rows = plan(growth, person.scales.amax(1), person.opacities, rules, room, lost)
    moved = displacement(person.rotations * person.scales[:, None, :], rows, generator)
    thinned = thinner(person.opacities, rows)
    for owner, name in human.rows():
        setattr(owner, name, _regrow(optimizer, getattr(owner, name), rows))
    for name in human.ROWS:
        setattr(human, name, getattr(human, name)[rows.source])
    with torch.no_grad():
        human.xyz.add_(moved)
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


class Densifier:
    """Adds and removes Gaussians on schedule, up to their caps, and settles the scene's last colours.

    `statistics` are by set, "scene" and the name of each person. `settled` [N], or None until then, are the Gaussians of the
    scene with their last colours.
    """

    def __init__(
        self,
        people: Sequence[PersonLearner],
        scene: SceneModel | None,
        params: Params,
        options: Options,
        generator: torch.Generator,
    ):
        self.people, self.scene, self.params, self.options = people, scene, params, options
        self.generator = generator
        self.settled: Tensor | None = None
        self.statistics: dict[str, Growth] = {}
        for person in people:
            self.statistics[person.name] = Growth(len(person.human), person.human.xyz.device)
        if scene is not None:
            self.statistics["scene"] = Growth(len(scene), scene.means.device)

    def grow(self, progress: Progress, adam: dict[str, Optimizer]) -> None:
        """Densify the sets that are due before the next step."""
        step, done, phase, group = progress.step, progress.done, progress.phase, self.params.views_per_decode
        every = max(1, round(phase.whole * (SETTLE - SCENE_GROWTH[0]) / self.options.growth_rounds))
        scene_grows = self.scene is not None and phase.scene
        if scene_grows and SCENE_GROWTH[0] <= done <= SCENE_GROWTH[1] and step % every == 0:
            self.grow_scene(adam, GROWN, progress.rounds_left(every))
        every = 3 * every // group * group or group
        if phase.human and HUMAN_GROWTH[0] <= done <= HUMAN_GROWTH[1] and step % every == 0:
            self.grow_people(adam, GROWN, progress.rounds_left(every))

    def grow_scene(self, adam: dict[str, Optimizer], grad: float, rounds_left: int) -> None:
        """Densify the scene where the screen gradient is at least `grad`."""
        if self.scene is None:
            return
        rules = Rules(grad, 0.01 * self.options.extent, 0.5 * self.options.extent, 0.3, 0.005, self.params.scene_cap)
        grow_scene(self.scene, adam["scene"], self.statistics["scene"], rules, rounds_left, self.generator)
        self.settled = None

    def grow_people(self, adam: dict[str, Optimizer], grad: float, rounds_left: int) -> None:
        """Densify each person, if they may grow, where the screen gradient is at least `grad`."""
        rules = Rules(grad, 0.01, 0.1, 0.3, 0.005, self.params.human_cap)
        for person in self.people if self.params.human_densify else ():
            state = adam[person.name], self.statistics[person.name]
            rows = grow_human(person.human, *state, rules, rounds_left, person.surface, self.generator)
            person.follow(rows.source)

    def fill_up(self, adam: dict[str, Optimizer]) -> None:
        """Bring every set that may grow to its cap at once, as it would be after densification."""
        for _ in range(FILLS):
            before = self._sizes()
            self.grow_scene(adam, 0.0, 1)
            self.grow_people(adam, 0.0, 1)
            if self._sizes() == before:
                return

    def _sizes(self) -> list[int]:
        return [len(growth.count) for growth in self.statistics.values()]

    def settle(self, progress: Progress, optimizer: Optimizer, last_colors: Callable[[SceneModel], Tensor]) -> None:
        """Once growth is over: `last_colors` gives some of the scene's Gaussians their last colours, and tells which [N]."""
        if self.scene is None or self.settled is not None or not progress.phase.scene or progress.done <= SETTLE:
            return
        self.settled = last_colors(self.scene)
        for colors in self.scene.colors():
            optimizer.state[colors]["exp_avg"][self.settled] = 0

    def keep_settled(self) -> None:
        """Zero the gradients of colours that are settled."""
        if self.scene is not None and self.settled is not None:
            for colors in self.scene.colors():
                if colors.grad is not None:
                    colors.grad[self.settled] = 0

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        settled = None if self.settled is None else self.settled.clone()
        return {"statistics": {n: growth.state() for n, growth in self.statistics.items()}, "settled": settled}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        for name, growth in self.statistics.items():
            growth.load(state["statistics"][name])
        self.settled = None if state["settled"] is None else state["settled"].clone()
