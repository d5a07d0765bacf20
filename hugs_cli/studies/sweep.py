"""Varies one axis at a time around a pipeline, within a budget of time, and compares what each level costs and buys.

Each case is a variant with its own name (`default.steps_1000`) and cached like every result: a sweep that was stopped,
or ran out of budget, continues from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from hugs_cli import times
from hugs_cli.cache import engine
from hugs_cli.cache.engine import Ran, device_of
from hugs_cli.cache.freshness import Session, Verdict
from hugs_cli.cache.workspace import decisions
from hugs_cli.console import Console
from hugs_cli.direct import StageFailed
from hugs_cli.pipelines import UsageError, unknown
from hugs_cli.studies import comparison, costs
from hugs_cli.studies.comparison import METRICS, REGIONS, SEEDED, Case, expected
from hugs_cli.studies.variants import AXES, level_name
from hugs_cli.words import count, duration


@dataclass(frozen=True)
class Level:
    """One axis at one level; `times` is the time of its stage relative to the pipeline's."""

    axis: str
    stage: str
    times: float


@dataclass(frozen=True)
class Sweep:
    """The trainings of a sweep: `levels` by variant, `cases` in the order in which they spend the budget."""

    levels: dict[str, Level]
    cases: list[Case]
    left_out: list[str]
    """Why axes were left out: the pipeline lacks them, or they change nothing on the clip."""


@dataclass
class Forecast:
    """Forecasts the time of cases from the finished ones."""

    levels: dict[str, Level]
    seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    """Variant -> stage -> seconds."""

    def learn(self, case: Case, stages: Iterable[Ran | Verdict]) -> None:
        """Remember how long the stages of a finished case took."""
        self.seconds[case.variant] = {one.stage: one.stamp.seconds for one in stages if one.stamp}

    def of(self, case: Case, verdicts: dict[str, Verdict]) -> dict[str, float] | None:
        """Seconds of each stage that would run, or None while the pipeline itself was never finished."""
        open_ = [name for name, verdict in verdicts.items() if not verdict.fresh]
        known = self.seconds.get(case.variant) or self.seconds.get("")
        if not open_:
            return {}
        if known is None:
            return None
        level = None if case.variant in self.seconds else self.levels.get(case.variant)
        return {name: known[name] * (level.times if level and level.stage == name else 1.0) for name in open_}


def sweep(session: Session, axes: Sequence[str], seeds: int) -> Sweep:
    """All cases: the pipeline with every seed (the noise), then each level of each axis, seed by seed.

    UsageError for an axis that is not known, and where there is nothing to vary.
    """
    for name in axes:
        if name not in AXES:
            raise unknown("axis", name, AXES, "hugs costs --axis")
    levels: dict[str, Level] = {}
    left_out = []
    for name in axes or AXES:
        axis, stage = AXES[name], session.pipeline.stages.get(AXES[name].stage)
        if stage is None or not set(axis.settings) <= set(type(stage.params).model_fields):
            left_out.append(f"{session.pipeline.name} has no setting for {name}")
            continue
        own = tuple(getattr(stage.params, setting) for setting in axis.settings)
        levels |= {level_name(name, level): Level(name, axis.stage, times) for level, times in axis.of(own).items()}
    found = comparison.cases(session, ("", *levels), seeds) if levels else []
    called = without_idle_axes(Sweep(levels, sorted(found, key=lambda case: case.variant != ""), left_out))
    if not called.levels:
        hint = "`hugs stages` shows the settings of a pipeline"
        raise UsageError(f"pipeline {session.pipeline.name} has none of the settings to vary", hint, called.left_out)
    return called


def without_idle_axes(sweep: Sweep) -> Sweep:
    """The sweep without axes of effects that survey turned off, once survey is fresh."""
    about = {level.axis: AXES[level.axis].effect for level in sweep.levels.values() if AXES[level.axis].effect}
    if not about or "survey" not in sweep.cases[0].session.pipeline.stages:
        return sweep
    session = sweep.cases[0].session
    verdict = session.verdicts(session.pipeline.upstream(["survey"]))["survey"]
    found = decisions(verdict.folder, "survey") if verdict.fresh and verdict.folder else {}
    idle = {axis: effect for axis, effect in about.items() if found.get(effect) is False}
    levels = {name: level for name, level in sweep.levels.items() if level.axis not in idle}
    cases = [case for case in sweep.cases if not case.variant or case.variant in levels]
    said = [
        f"{axis} changes nothing where {effect} is off: `--set survey.{effect}=always`" for axis, effect in idle.items()
    ]
    return Sweep(levels, cases, [*sweep.left_out, *said])


def plan(sweep: Sweep, budget: float) -> list[tuple[Case, str, float | None]]:
    """Each case, its state, and the seconds that it would take (0: cached; None: not known before the first is run).

    States: cached, now, later (when another `budget`, in seconds, is given).
    """
    forecast, verdicts = Forecast(sweep.levels), [case.session.verdicts(case.stages) for case in sweep.cases]
    for case, found in zip(sweep.cases, verdicts, strict=True):
        if all(verdict.fresh for verdict in found.values()):
            forecast.learn(case, found.values())
    planned: list[tuple[Case, str, float | None]] = []
    counted: set[tuple[str, str]] = set()
    for i, (case, found) in enumerate(zip(sweep.cases, verdicts, strict=True)):
        known = forecast.of(case, found)
        if known is None:
            planned.append((case, "now" if budget and i == 0 else "later", None))
            continue
        need = sum(s for name, s in known.items() if name in SEEDED or (case.variant, name) not in counted)
        counted |= {(case.variant, name) for name in known}
        state = "cached" if not known else "now" if need <= budget else "later"
        budget -= need if state == "now" else 0.0
        planned.append((case, state, need))
    return planned


def summary(sweep: Sweep, planned: list[tuple[Case, str, float | None]], budget: float, device: str) -> str:
    """One line: '57 trainings: 6 cached, 51 to do, about 8h 10m; budget 2h 00m: 12 of them now'."""
    states = [state for _, state, _ in planned]
    cached, now, left = states.count("cached"), states.count("now"), len(states) - states.count("cached")
    said = f"{count(len(states), 'training')}: {cached} cached, {left} to do"
    if not left:
        return said
    seconds = [need for _, state, need in planned if state != "cached"]
    known = [need for need in seconds if need is not None]
    if len(known) < len(seconds):
        levels = {variant: (level.stage, level.times) for variant, level in sweep.levels.items()}
        guess = times.total(one for _, one in expected(sweep.cases, device_of(device)[0], levels))
        return f"{said}, {times.said(guess)}; more precisely when the first is done"
    return f"{said}, about {duration(sum(known))}; budget {duration(budget)}: {now} of them now"


def plan_lines(planned: list[tuple[Case, str, float | None]]) -> list[str]:
    """The plan as lines, a case each."""
    about = ["" if not need else f"about {duration(need)}" for _, _, need in planned]
    return [
        f"  {case.session.pipeline.name:<28}seed {case.seed:<4}{state:<8}{said}".rstrip()
        for (case, state, _), said in zip(planned, about, strict=True)
    ]


def run(sweep: Sweep, budget: float, device: str, console: Console) -> dict[str, Any]:
    """Bring cases up to date until `budget` seconds are spent, and compare what is there; see `result`.

    A level that fails is reported and skipped; a failure of the pipeline itself ends the sweep.
    """
    began, forecast, done, failed = time.monotonic(), Forecast(sweep.levels), [], {}
    for i, case in enumerate(sweep.cases):
        if case not in sweep.cases:
            continue
        console.only_new, console.countdown = i > 0, None
        known = forecast.of(case, case.session.verdicts(case.stages))
        left = max(0.0, budget - (time.monotonic() - began))
        fits = left > 0 if known is None else sum(known.values()) <= left
        if not fits:
            continue
        console.say(f"{case.session.pipeline.name}  seed {case.seed}   {i + 1} of {len(sweep.cases)}")
        try:
            ran = engine.run(case.session, case.stages, frozenset(), device, console)
        except StageFailed as error:
            if not case.variant or error.traceback:
                raise
            console.error(error)
            failed[case.session.workspace.links.name] = error.problem
            continue
        done.append(case)
        forecast.learn(case, ran)
        if known is None and any(one.state == "done" for one in ran):
            left, sweep = max(0.0, budget - (time.monotonic() - began)), without_idle_axes(sweep)  # survey is fresh now
            console.say(summary(sweep, plan(sweep, left), left, device))
    if not done:
        raise UsageError("nothing of this sweep has been run", "give it a budget in minutes: `--budget 120`")
    return result(sweep, done, failed)


def result(sweep: Sweep, done: Sequence[Case], failed: dict[str, str]) -> dict[str, Any]:
    """`costs.compared` of what is done, the pipeline first, then axis by axis; `left`, how many cases wait; `failed`.

    Each row has its `axis` ('' for the pipeline), `times` the pipeline's seconds (and `expected_times`, which puts levels
    in order), and in its scores the `difference` to the pipeline's and the `noise`: the standard deviation over its own
    seeds, or else over the pipeline's.
    """
    runs = [costs.run_of(case.session.workspace.links) for case in done]
    found = costs.compared([run for run in runs if run])
    name = sweep.cases[0].session.pipeline.name
    order = {f"{name}.{variant}" if variant else name: variant for variant in ("", *sweep.levels)}
    found["rows"].sort(key=lambda row: list(order).index(row["pipeline"]))
    base = found["rows"][0]
    for row in found["rows"]:
        variant = order[row["pipeline"]]
        row["axis"], row["expected_times"] = "", 1.0
        if variant:
            row["axis"], row["expected_times"] = sweep.levels[variant].axis, sweep.levels[variant].times
            row["times"] = {part: row["seconds"][part] / base["seconds"][part] for part in ("total", "train")}
        for region, metric in product(REGIONS, METRICS):
            add_difference(row["scores"][region][metric], base["scores"][region][metric] if variant else None)
    found["notes"] += [f"{links} failed: {problem}" for links, problem in failed.items()]
    found["notes"] += sweep.left_out
    left = len(sweep.cases) - len(done) - len(failed)
    found["notes"] += [f"{count(left, 'training')} left for another budget; run it again"] if left else []
    return {"pipeline": name, "seeds": sorted({case.seed for case in done}), "left": left, "failed": failed} | found


def add_difference(numbers: dict[str, Any], base: dict[str, Any] | None) -> None:
    """Add `difference`, `noise` and `within_noise` to the numbers of one row, given the pipeline's own.

    Within the noise: two standard errors of the difference of both means, or less.
    """
    numbers["noise"] = numbers["spread"] if numbers["spread"] is not None or base is None else base["spread"]
    if base is None or numbers["mean"] is None or base["mean"] is None:
        return
    numbers["difference"] = numbers["mean"] - base["mean"]
    if numbers["noise"] is not None:
        error = numbers["noise"] * math.sqrt(1 / len(numbers["values"]) + 1 / len(base["values"]))
        numbers["within_noise"] = abs(numbers["difference"]) <= 2 * error
