"""pipelines.yaml: what is refused and how it is said; and the real file against the real stages."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from hugs_cli import pipelines
from hugs_cli.options import RunOptions
from hugs_cli.pipelines import SOURCES, UsageError, load
from tests.made.said import holds

REAL = yaml.safe_load(pipelines.FILE.read_text())
HEAVY = ("torch", "cv2", "pycolmap", "numpy", "scipy", "numba", "av", "OpenImageIO", "trimesh")


@pytest.fixture
def refused(importable):
    """Loads the flow's default pipeline after a change of the file's text; the error it gives."""
    flow = importable
    file = flow.folder / "pipelines.yaml"

    def change(old: str = "", new: str = "", name: str = "default", overrides: tuple[str, ...] = ()) -> UsageError:
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))
        with pytest.raises(UsageError) as caught:
            load(name, overrides, file)
        return caught.value

    return change


def test_a_pipeline_is_read_in_running_order_with_what_it_extends(importable):
    file = importable.folder / "pipelines.yaml"
    other = load("other", ["two.word=b", "four.delay=2"], file)
    assert list(other.stages) == ["one", "two", "three", "four"]
    assert other.stages["four"].settings() == {"word": "z"}
    assert other.stages["four"].settings(speed_only=True) == {"delay": 2.0, "hold": ""}
    assert other.stages["two"].params.word == "b" and other.stages["three"].resumes
    assert load("default", (), file).stages["four"].settings() == {"word": "a"}  # what extends it changes nothing here
    assert other.upstream(["two"]) == ["one", "two"]
    assert pipelines.names(file) == {"default": "Four.", "other": "Another."}


@pytest.mark.parametrize(
    ("old", "new", "problem", "hint"),
    [
        ("doc: Four.", "docs: Four.", ("default", "key", "docs"), "doc"),
        ("{needs: [video]", "{need: [video]", ("default", "one", "key", "need"), "needs"),
        ("[video]", "[vidoe]", ("default", "one", "need", "vidoe"), "video"),
        ("module: flow.two", "module: flow.tow", ("default", "two", "module", "flow.tow"), "name"),
        ("[two, three]", "[two]", ("four", "needs", "flow.four.run()", "differ"), "names"),
        ("[video]", "[four]", ("default", "circle"), "remove"),
        ("flow.one}", "flow.one, params: {wrod: b}}", ("default", "one", "setting", "wrod"), "word"),
        ("flow.one}", "flow.one, params: {delay: x}}", ("one", "settings"), "hugs stages one"),
        ("doc: Four.", "extends: default", ("default", "extends", "itself"), "pipelines.yaml"),
        ("  stages:\n", "  stages: [\n", ("pipelines.yaml", "YAML"), "correct"),
        ("needs: [video], ", "needs: [{video: 1}], ", ("one", "need"), "one, two"),
        ("needs: [video], ", "", ("default", "one", "needs", "missing"), "needs: [video]"),
    ],
)
def test_what_is_wrong_is_refused_and_named(refused, old, new, problem, hint):
    error = refused(old, new)
    assert holds(error.problem, *problem) and holds(error.hint, hint)


def test_wrong_overrides_and_names_are_refused(refused):
    assert holds(refused(name="defualt").hint, "default")
    assert holds(refused(overrides=("one.wort=b",)).hint, "word")
    assert holds(refused(overrides=("tree.word=b",)).hint, "three")
    assert holds(refused(overrides=("word=b",)).hint, "--set stage.param=value")
    error = refused(overrides=("one.delay=soon",))
    assert len(error.facts) == 1 and holds(error.facts[0], "one.delay", "number", "soon")


def test_an_error_inside_a_stage_module_is_not_called_a_missing_module(importable):
    importable.write("two", "import no_such_library\n")
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        load("default", (), importable.folder / "pipelines.yaml")


@pytest.mark.parametrize("name", REAL)
def test_needs_equal_what_each_stage_takes(name):
    for stage in load(name).stages.values():
        keywords = inspect.signature(importlib.import_module(stage.module).run).parameters
        takes = [p.name for p in keywords.values() if p.kind is p.KEYWORD_ONLY]
        assert set(takes) == set(stage.needs), stage.name
        assert list(keywords)[:2] == ["job", "params"]
        assert all(need in SOURCES or need in load(name).stages for need in takes)
        assert stage.doc, f"{stage.name} says nothing of what it does"


def test_stage_modules_are_light_and_know_no_other_stage():
    """Each in a fork of a process that has loaded what all share."""
    code = (
        "import importlib, os, sys, stages.contract\n"
        "for name in sys.argv[1:]:\n"
        "    if os.fork() == 0:\n"
        "        importlib.import_module(f'stages.{name}')\n"
        "        print(name, *sys.modules, flush=True)\n"
        "        os._exit(0)\n"
        "    os.wait()\n"
    )
    names = [*REAL["default"]["stages"], "neuman", "zju", "calibrated"]
    root = Path(pipelines.FILE).parent
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True, cwd=root)
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, *_ in lines] == names, done.stderr
    for name, *loaded in lines:
        assert f"stages.{name}" in loaded and not set(HEAVY) & set(loaded), name
        assert not {f"stages.{other}" for other in REAL["default"]["stages"] if other != name} & set(loaded), name


def test_a_person_and_cameras_given_on_the_command_line_reach_their_stages(tmp_path):
    model = tmp_path / "sparse"
    session = RunOptions(person="2", cameras=model, set_=["masks.invert=never"]).session(tmp_path / "clip.mp4")
    assert (
        session.pipeline.stages["masks"].params.person == "2"
        and session.pipeline.stages["masks"].params.invert == "never"
    )
    assert session.sources["cameras"] == model and "cameras" in session.pipeline.stages["sfm"].needs
    assert "cameras" not in load("neuman").stages["sfm"].needs, "the data set brings its own"


@pytest.mark.parametrize("name", ["010", "1:30", "no", "1_0", "~", "0x10", "1e3", "null", "a: b", "[", "2", ""])
def test_a_person_is_named_by_what_was_typed(tmp_path, name):
    session = RunOptions(person=name).session(tmp_path / "clip.mp4")
    assert session.pipeline.stages["masks"].params.person == name


def test_a_person_in_set_is_named_by_what_was_typed_save_for_what_yaml_calls_nothing(tmp_path):
    for typed, read in {"010": "010", "1:30": "1:30", "no": "no", "1_0": "1_0", "2": "2", "null": None}.items():
        session = RunOptions(set_=[f"masks.person={typed}"]).session(tmp_path / "clip.mp4")
        assert session.pipeline.stages["masks"].params.person == read
    with pytest.raises(UsageError, match="settings are not valid"):
        RunOptions(set_=["masks.person=true"]).session(tmp_path / "clip.mp4")


LAUGHS = "a0: &a0 [ha, ha]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "most"),
    [
        ("default: " + "[" * 100_000 + "]" * 100_000, 50),
        ("default: " + "{a: " * 100_000, 50),
        ("".join("\n" + " " * i + "a:" for i in range(2_000)), 50),
        (LAUGHS, 10000),
        ("default: &a [*a]", 10000),
    ],
    ids=["lists", "mappings", "indents", "laughs", "itself"],
)
def test_a_file_that_is_too_deep_or_unfolds_without_end_is_refused_at_once(tmp_path, text, most):
    file = tmp_path / "pipelines.yaml"
    file.write_text(text)
    code = "import resource, sys; resource.setrlimit(resource.RLIMIT_CPU, (20, 20)); from hugs_cli import main; main()"
    args = ["status", "clip.mp4", "--pipelines-file", str(file)]
    root = Path(pipelines.FILE).parent
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, cwd=root)
    assert done.returncode == 2, done.stderr[-2000:]
    assert holds(done.stderr, "error", "pipelines.yaml", "YAML", most, "hint")
    assert len(done.stderr) < 1000


def test_a_setting_that_is_too_deep_is_refused(refused):
    error = refused(overrides=(f"one.word={'[' * 5_000}",))
    assert "[[[..." in error.problem and holds(error.facts[0], 50)


@pytest.mark.parametrize("value", [".inf", "-.inf", ".nan", "1e400"])
def test_no_setting_of_any_stage_is_endless(value):
    """A length that never ends took all memory, or ended in a traceback."""
    numbers = [
        f"{stage}.{name}"
        for stage, one in load("default").stages.items()
        for name, field in type(one.params).model_fields.items()
        if field.annotation in (float, float | None)
    ]
    assert len(numbers) > 5
    for name in numbers:
        with pytest.raises(UsageError):
            load("default", [f"{name}={value}"])


@pytest.mark.parametrize(
    "setting", ["render.motion_seconds=1e12", "render.fps=100000", "render.turntable_frames=10000000"]
)
def test_films_of_the_result_have_a_length_that_ends(setting):
    with pytest.raises(UsageError):
        load("default", [setting])
