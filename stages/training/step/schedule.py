"""When and how fast: learning rates, the phases of a run, and how far it is."""

from __future__ import annotations

from typing import Any, NamedTuple

LR_HUMAN = {"xyz": 4e-4, "triplane": 4e-3, "appearance": 4e-3, "geometry": 2e-3, "deformation": 4e-4}
LR_OWN = {  # corrections of each Gaussian's own: six times the paper's rates for explicit Gaussians, ours where it has none
    "turn": 6e-3,
    "scale": 3e-2,
    "opacity": 0.3,
    "sh": 1.5e-2,
    "offset": 8e-4,  # this and the next without networks alone; they take a step when networks would
    "skin": 4e-3,
}
LR_SCENE = {  # `means` in units of the scene's extent
    "means": 6e-4,
    "quats": 4e-3,
    "log_scales": 2e-2,
    "logit_opacities": 0.1,
    "sh0": 1e-2,
    "shN": 5e-3,  # a tenth brings back 0.9 dB of a glossy room in 400 steps, half of it 1.9
}
LR_FRAMES = {
    "pose": 1e-3,
    "place": 1e-3,
    "gain": 1e-2,  # a frame is seen few times: 1e-3 brings back 1.2 of the 3.0 dB that exposure costs in 400 steps, this 2.7
    "turn": 3e-4,
    "shift": 1e-3,
    "swing": 3e-2,
    "face": 8e-2,
}
LR_EFFECTS = {
    "slope": 3e-2,
    "darkness": 3e-2,
    "softness": 1e-2,
    "density": 1e-2,
    "size": 1e-2,
    "shutter": 1e-2,
    "readout": 1e-2,
    "swings": 5e-3,
    "bands": 1e-2,
}
LAST_MEANS = 0.01  # of the first rate, reached exponentially at the end
LAST_OTHERS = 0.1  # likewise, from SETTLE on: no densification and falling rates at the end are worth 0.3 dB (D14)
SETTLE = 0.65
SCENE_GROWTH = (0.06, SETTLE)  # shares of the steps between which each set is densified
HUMAN_GROWTH = (0.15, SETTLE)
LATE = 0.99  # last share of the schedule at which steps are timed
FROZEN = 10**9  # steps of a schedule that hardly moves
SCENE_FIRST = 0.5  # share of the steps that the scene has to itself where the two are not learned jointly


class Options(NamedTuple):
    """What the clip, not a setting, decides about a training: `extent` in m, and what is learned."""

    extent: float
    refine_pose: bool = True
    learn_face: bool = False
    refine_camera: bool = False
    exposure: bool = False
    antialias: bool = False
    growth_rounds: int = 20


class Phase(NamedTuple):
    """`steps` steps from `first` on, over the schedule's shares `start` to 1; `human`, `scene`: which sets learn."""

    first: int
    steps: int
    human: bool
    scene: bool
    start: float = 0.0

    def done(self, step: int) -> float:
        """Share of the schedule that is behind a step."""
        return self.start + (1 - self.start) * (step - self.first) / self.steps

    @property
    def whole(self) -> float:
        """Steps that the whole schedule takes at this phase's pace."""
        return self.steps / (1 - self.start)


def phases(steps: int, joint: bool) -> tuple[Phase, ...]:
    """One phase in which both learn; or first the scene alone, then the person before a scene that is finished."""
    if joint:
        return (Phase(0, steps, True, True),)
    first = int(SCENE_FIRST * steps)
    return Phase(0, first, False, True), Phase(first, steps - first, True, False)


class Progress:
    """How far a training is: the number of its next `step`, and its `phases`."""

    def __init__(self, steps: int, joint: bool):
        self.step = 0
        self.phases = phases(steps, joint)

    @property
    def phase(self) -> Phase:
        """The phase of the next step."""
        return next(phase for phase in reversed(self.phases) if phase.first <= self.step)

    @property
    def done(self) -> float:
        """Share of the phase's schedule behind us."""
        return self.phase.done(self.step)

    @property
    def share(self) -> float:
        """Share of the whole run behind us, each phase counted the same."""
        return (self.phases.index(self.phase) + self.done) / len(self.phases)

    @property
    def total(self) -> int:
        """Steps of the whole run."""
        return self.phases[-1].first + self.phases[-1].steps

    def retime(self, left: int) -> None:
        """Let `left` > 0 more steps finish the schedule of the last phase, from where it is."""
        *before, last = self.phases
        self.phases = (*before, last._replace(first=self.step, steps=left, start=last.done(self.step)))

    def freeze(self, done: float = LATE) -> None:
        """Stay at a share of the last phase's schedule from now on, however many steps are taken."""
        self.phases = (self.phases[-1]._replace(first=self.step, steps=FROZEN, start=done),)

    def rounds_left(self, every: int) -> int:
        """Densifications still to come, one every so many steps, this one included."""
        phase = self.phase
        return int((phase.first + (SETTLE - phase.start) * phase.whole - self.step) // every) + 1

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"step": self.step, "phases": [tuple(phase) for phase in self.phases]}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.step, self.phases = state["step"], tuple(Phase(*phase) for phase in state["phases"])


def rate(name: str, done: float) -> float:
    """Factor on the rate of `name` at the share `done` of a phase: 1 down to LAST_MEANS or LAST_OTHERS."""
    if name in ("means", "xyz", "offset"):
        return LAST_MEANS**done
    return LAST_OTHERS ** max(0.0, (done - SETTLE) / (1 - SETTLE))
