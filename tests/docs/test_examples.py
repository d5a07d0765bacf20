"""Each command of the documents is run by a test; of the few that are not it is written here why."""

from __future__ import annotations

import ast

import pytest

from tests.docs.documents import CHEAP, ROOT, commands, of_finished_runs
from tests.docs.promises import TRAINED
from tests.made.documented import HUGS

AVATARS = "tests/test_avatars_end_to_end.py::test_every_kind_of_run_is_animated_composed_and_rendered"
ELSEWHERE = {
    "hugs demo": "tests/test_end_to_end.py::flow",
    "hugs doctor --fetch": "tests/hugs_cli/test_doctor.py::test_fetch_brings_only_what_is_missing",
    "hugs run dance.mp4 --person all": "tests/test_two_people_end_to_end.py::run",
    "hugs animate dance.mp4 moves.bvh --who 2": AVATARS,
    "hugs animate other.mp4 motion.bvh": AVATARS,
    "python -m stages.train failure.npz": "tests/stages/test_train.py::"
    "test_h01_h05_a_training_that_breaks_down_leaves_what_is_needed_to_see_it_again",
    "hugs run CLIP --json": "tests/hugs_cli/test_within.py::run",
    "hugs ablate FOLDER --pipeline neuman --part none": "tests/docs/promises.py::spread",
}
"""The command -> the test, or its fixture, that runs it with other names."""
NOT_RUN = {
    "make": "an environment of its own, or hours; test_commands.py looks for the target",
    "pip": "it changes the environment; test_commands.py looks for the extra",
    "pre-commit": "it changes the checkout; test_commands.py looks for what its hooks start",
    "python": "a tool for developers; test_commands.py looks for it and its options",
}
"""Programs whose commands are not run here."""


def is_name(command: str) -> bool:
    """Whether a text only names a command, of those that are given what to take."""
    words = command.split()
    taken = HUGS.commands[words[1]].params if len(words) == 2 else []
    return any(one.param_type_name == "argument" for one in taken)


def test_each_command_is_run_or_it_is_known_why_not():
    said = {command for _, command in commands()}
    run = {*TRAINED, *CHEAP, *of_finished_runs(), *ELSEWHERE}
    left = {one for one in said - run if one.split()[0] not in NOT_RUN and not is_name(one)}
    assert not left, "name the test that runs it"
    assert not {*TRAINED, *ELSEWHERE} - said, "no longer in a document"
    unrun = sorted(one for one in said - run if one.split()[0] in NOT_RUN)
    print(f"{len(said & run)} commands are run, {len(unrun)} are not:")
    print(*(f"  {one}: {NOT_RUN[one.split()[0]]}" for one in unrun), sep="\n")


@pytest.mark.parametrize("test", sorted(set(ELSEWHERE.values())))
def test_the_tests_that_run_them_are_there(test):
    file, name = test.split("::")
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
