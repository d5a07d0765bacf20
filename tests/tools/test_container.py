"""The containers: what the program that tries Dockerfile knows, and that it ends as nobody's root."""

import pytest

from tests.made.command import ROOT
from tests.tools.container import SUITES, State, Step, do, steps

FILES = ("Dockerfile", "Dockerfile.gpu")


def test_each_line_of_the_dockerfile_is_one_that_is_tried(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(
        "tests.tools.container.inside", lambda root, state, command, mounts: ran.append((state.user, command))
    )
    monkeypatch.setattr("tests.tools.container.subprocess.run", lambda *words, **how: ran.append(("", words[0][0])))
    monkeypatch.setattr("tests.tools.container.copy", lambda *given: None)
    state = State()
    for step in steps((ROOT / "Dockerfile").read_text()):
        do(tmp_path, state, step, {})
    assert ran[0] == ("", "debootstrap") and state.user == "hugs" and state.folder == "/clips"
    assert [user for user, command in ran if "hugs d" in command] == ["hugs", "hugs"]
    with pytest.raises(SystemExit, match="ADD"):
        do(tmp_path, state, Step("ADD", "x /"), {})


@pytest.mark.parametrize("name", FILES)
def test_both_begin_and_end_alike(name):
    found = list(steps((ROOT / name).read_text()))
    assert [step.rest for step in found if step.word == "USER"] == ["hugs"]
    assert found[-1] == Step("ENTRYPOINT", '["hugs"]')
    assert name != "Dockerfile" or found[0].rest in SUITES
