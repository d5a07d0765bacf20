"""Variants of the real pipelines: their names, and the settings that they stand for."""

from __future__ import annotations

import pytest

from hugs_cli.pipelines import UsageError, load
from hugs_cli.studies.variants import AXES, level_name
from tests.made.said import holds


@pytest.mark.parametrize("name", ["default", "preview", "paper"])
def test_every_level_of_every_axis_is_a_pipeline_with_those_settings_and_no_others(name):
    base = load(name)
    for axis_name, axis in AXES.items():
        stage = base.stages[axis.stage]
        own = tuple(getattr(stage.params, setting) for setting in axis.settings)
        levels = axis.of(own)
        assert own not in levels and levels and min(levels.values()) > 0
        for level in levels:
            variant = load(f"{name}.{level_name(axis_name, level)}")
            new = variant.stages[axis.stage].params
            assert new.model_dump() == stage.params.model_dump() | dict(zip(axis.settings, level, strict=True))
            assert {n for n, s in variant.stages.items() if s != base.stages[n]} == {axis.stage}


def test_levels_are_around_what_the_pipeline_has():
    assert AXES["steps"].of((4000,)) == {(1000,): 0.25, (2000,): 0.5, (8000,): 2.0}
    assert list(AXES["caps"].of((40_000, 80_000))) == [(20_000, 40_000), (80_000, 160_000)]
    assert AXES["points"].of((110_000,)) == {(7_000,): pytest.approx(0.6 / 2.7), (27_500,): pytest.approx(1 / 2.7)}
    assert level_name("half", (0.0,)) == "half_0" and level_name("perceptual", ("vgg", 4)) == "perceptual_vgg_4"


@pytest.mark.parametrize(
    ("variant", "problem", "facts"),
    [
        ("step_100", ("variant", "step_100"), ()),
        ("steps", ("variant", "steps"), ()),
        ("caps_100", ("variant", "caps_100"), ()),
        ("steps_many", ("stage train", "settings"), ("train.steps", "many")),
        ("steps_0", ("stage train", "settings"), ("train.steps", "greater than 0")),
    ],
)
def test_other_names_and_values_are_refused(variant, problem, facts):
    with pytest.raises(UsageError) as caught:
        load(f"default.{variant}")
    assert holds(caught.value.problem, "default", *problem) and holds(" ".join(caught.value.facts), *facts)
