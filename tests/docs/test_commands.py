"""Every command in the documents is one that exists: its options, its stages, settings, pipelines, axes and modules.

They are parsed by the real command line, and the cheap ones run; test_examples.py says where others are.
"""

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import yaml

from hugs_cli import app, pipelines, within
from hugs_cli.studies import variants
from tests.docs.documents import CHEAP, ROOT, commands, documents, hints, lines

CODES = dict.fromkeys(("hugs doctor", "hugs doctor --json"), (0, 1))  # 1 where models are missing
HUGS = typer.main.get_command(app.app)
SETTING = re.compile(r"([a-z]+)\.([a-z_0-9]+)(=\S+)?")
STAGES = pipelines.load("default").stages


def parsed(words: list[str], example: bool) -> tuple[str, dict]:
    """The command and its values, as the command line reads them; running text may leave arguments out."""
    group = HUGS.make_context("hugs", list(words))
    name, command, rest = HUGS.resolve_command(group, list(words))
    try:
        return name, command.make_context(name, rest, parent=group).params
    except Exception as error:
        if example or type(error).__name__ != "MissingParameter":  # of click, or of typer's own copy of it
            raise
        return name, {}


def check_hugs(words: list[str], example: bool) -> None:
    if words[0].isupper() or words in (["--help"], ["--version"]):
        return
    command, values = parsed(words, example)
    pipeline_name = values.get("pipeline") or "default"
    base, _, last = pipeline_name.rpartition(".")
    pipeline = pipelines.load(base if base and within.is_time(last) else pipeline_name, values.get("set_") or ())
    pipeline.upstream(values.get("stages") or [])  # refuses unknown stages
    learned = pipeline.stages["train"].params if "train" in pipeline.stages else None
    if values.get("within") and values["within"] != "TIME":
        assert within.is_time(values["within"])
    if command == "costs":
        assert set(values.get("axis") or ()) <= set(variants.AXES)
    if command == "ablate":
        parts = set(values.get("part") or variants.ABLATIONS) - {"none"}
        assert all(pipelines.variant(pipeline, part).stages["train"].params != learned for part in parts), (
            "it measures nothing"
        )


def check_make(words: list[str], example: bool) -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {word for word in words if "=" not in word} <= targets


def check_pip(words: list[str], example: bool) -> None:
    """Options are pip's; only the checkout is installed, with extras that it has."""
    assert words[0] == "install"
    (target,) = [word for word in words[1:] if not word.startswith("-")]
    extra = re.fullmatch(r"\.(?:\[(\w+)\])?", target)
    assert extra
    assert not extra[1] or re.search(rf"^{extra[1]} = \[", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)


def check_python(words: list[str], example: bool) -> None:
    assert words[0] == "-m"
    spec = importlib.util.find_spec(words[1])
    assert spec and spec.origin
    source = Path(spec.origin).read_text(encoding="utf-8")
    assert "__main__" in source
    for option in (word for word in words[2:] if word.startswith("--")):
        assert f'"{option}"' in source, f"{words[1]} has no {option}"


def check_hooks(words: list[str], example: bool) -> None:
    """The hooks are of this repository alone, and what they start is there."""
    assert words == ["install"]
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repo["repo"] == "local"
    for hook in repo["hooks"]:
        assert hook["language"] == "system" and re.match(r"\.venv/bin/(ruff|lint-imports|python) ?", hook["entry"])


CHECKS = {"hugs": check_hugs, "make": check_make, "pip": check_pip, "python": check_python, "pre-commit": check_hooks}


@pytest.mark.parametrize(("document", "command"), commands())
def test_commands_exist(document, command):
    program, *words = shlex.split(command)
    CHECKS[program](words, (document, command) in lines())


FILLED = ("default", "train", "10m")
ELSEWHERE = {
    "hugs": "the program",
    "python demo.py --save_pkl": "of WHAM",
    "python -m ensurepip": "of Python",
    "npx @playcanvas/splat-transform FILE out.ply": "run by hand: 2.7.1 makes .ply of .compressed.ply, .sog, .spz version 4",
}
OPTIONS = {
    text for name in HUGS.commands for one in HUGS.commands[name].params for text in (*one.opts, *one.secondary_opts)
}


@pytest.mark.parametrize("hint", sorted(hints()))
def test_commands_that_the_product_says_exist(hint):
    """With any of FILLED for what is filled in; an option alone is one of a command, and a setting one of a pipeline."""
    if hint in ELSEWHERE or hint.startswith("ffmpeg"):
        return
    if hint.startswith("--"):
        words = hint.split()
        assert {word for word in words if word.startswith("--")} <= OPTIONS
        for stage, name in re.findall(r"--set ([a-z]+)\.([a-z_0-9]+)", hint):
            known = [pipelines.load(one).stages.get(stage) for one in ("default", "zju", "neuman")]
            assert stage == "stage" or any(one and name in type(one.params).model_fields for one in known)
        return
    problem: Exception | None = None
    for filled in FILLED:
        program, *words = shlex.split(re.sub(r"(?<=--within )X\b", "10m", hint))
        try:
            return CHECKS[program]([filled if word == "X" else word for word in words], False)
        except Exception as error:
            problem = error
    raise AssertionError(hint) from problem


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        ("hugs walk dance.mp4", "walk"),
        ("hugs run dance.mp4 --fast", "--fast"),
        ("hugs run dance.mp4 paint", "paint"),
        ("hugs run dance.mp4 --set train.no=1", "'no'"),
        ("hugs ablate dance.mp4 --pipeline preview --part no_lbs", "measures nothing"),
    ],
)
def test_a_command_that_does_not_exist_is_noticed(command, problem):
    with pytest.raises(Exception, match=problem):
        check_hugs(shlex.split(command)[1:], True)


@pytest.mark.slow
@pytest.mark.parametrize("command", sorted(CHEAP))
def test_cheap_commands_run(command):
    start = [sys.executable, "-c", "from hugs_cli import main; main()", *shlex.split(command)[1:]]
    done = subprocess.run(start, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode in CODES.get(command, (0,)), done.stderr
    assert done.stdout


@pytest.mark.parametrize("document", documents(), ids=lambda d: d.name)
def test_settings_exist(document):
    """`train.steps` and `survey.shadow=always` are settings, and the value is one that the setting takes."""
    for span in document.spans():
        found = SETTING.fullmatch(span)
        if found and found[1] in STAGES and found[2] not in ("json", "npz", "html", "py"):
            value = found[3] or f"={json.dumps(STAGES[found[1]].params.model_dump(mode='json')[found[2]])}"
            pipelines.load("default", [f"{found[1]}.{found[2]}{value}"])
