"""The command line itself: what it loads, exit codes, words of refusal."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hugs_cli import app
from tests.made.flow import LONGEST
from tests.made.said import holds

ROOT = Path(__file__).parents[2]
HEAVY = {"torch", "cv2", "pycolmap", "numpy", "scipy", "numba", "av", "OpenImageIO", "trimesh", "rich"}


def modules_after(folder: Path, *args: str) -> set[str]:
    """Run `hugs ARGS` and return the modules it loaded."""
    code = (
        f"import sys; sys.path[:0] = [{str(folder)!r}, {str(ROOT)!r}]; sys.argv[1:] = {list(args)!r}\n"
        "from hugs_cli import app\n"
        "try: app.main()\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print('LOADED', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return {name.partition(".")[0] for name in done.stdout.rpartition("LOADED")[2].split()}


def test_help_and_the_list_of_stages_load_nothing_heavy(tmp_path):
    assert not modules_after(tmp_path, "--help") & HEAVY
    assert not modules_after(tmp_path, "run", "--help") & HEAVY


def processor_seconds(flow, command: str) -> float:
    """What a command takes; unlike the clock's, seconds of the processor bear other work beside them."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    flow.start(command=command).communicate(timeout=LONGEST)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.slow
def test_a_run_with_nothing_to_do_is_quick_and_loads_nothing_heavy(made):
    args = ["run", "clip.mp4", "--pipelines-file", "pipelines.yaml"]
    loaded = modules_after(made.folder, *args)
    assert "flow" in loaded and not loaded & HEAVY
    run, status = (min(processor_seconds(made, command) for _ in range(2)) for command in ("run", "status"))
    assert run < 2 * status  # 1.0 measured


@pytest.mark.parametrize(
    ("args", "problem", "hint"),
    [
        (["--set", "two.wort=1"], ("default", "two", "setting", "wort"), "word"),
        (["tow"], ("default", "stage", "tow"), "two"),
        (["--pipeline", "othr"], ("pipelines.yaml", "pipeline", "othr"), "other"),
        (["--masks", "nowhere"], ("--masks", "nowhere"), "path"),
        (["--smpl-fit", "clip.mp4"], ("default", "--smpl-fit"), "another pipeline"),
        (["--work", "clip.mp4/x"], ("write", "clip.mp4/x/clip"), "--work"),
    ],
)
def test_wrong_usage_is_refused_in_our_words(flow, args, problem, hint):
    _, err = flow.hugs(*args, code=2)
    first, *rest = err.splitlines()
    assert holds(first, "error", *problem)
    assert rest[-2] == "" and holds(rest[-1], "hint", hint)
    assert "Traceback" not in err


def test_missing_video_and_unknown_option(flow):
    flow.video.unlink()
    assert holds(flow.hugs(code=2)[1], "error", "video", "clip.mp4")
    assert "--wrok" in flow.hugs("--wrok", "x", code=2)[1]


@pytest.mark.slow
def test_two_clips_of_one_name_do_not_mix(made):
    (made.folder / "b").mkdir()
    (made.folder / "b/clip.mp4").write_text("others")
    made.video = made.folder / "b/clip.mp4"
    process = made.start()
    process.communicate(timeout=LONGEST)
    made.video.rename(made.folder / "clip.mp4")
    assert made.ran()["one"] == ["inputs.video changed"]


@pytest.mark.parametrize("module", ["typer", "hugs_cli.app"])
def test_ctrl_c_while_the_command_is_loaded_is_no_error(tmp_path, module):
    """The signal comes while the first of our imports runs, and when all are done but nothing listens yet."""
    code = f"import os, signal, sys; sys.path.insert(0, {str(ROOT)!r}); from hugs_cli import main\n"
    code += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background job ignores it
    if module == "typer":
        (tmp_path / "typer.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGINT)")
        code += f"sys.path.insert(0, {str(tmp_path)!r})\n"
    else:
        code += "from hugs_cli.cache import child; child.prepare = lambda: os.kill(os.getpid(), signal.SIGINT)\n"
    done = subprocess.run([sys.executable, "-c", code + "main()"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 130 and holds(done.stderr, "stopped") and done.stderr.count("\n") == 1


def test_stages_lists_settings_with_their_meaning(flow):
    flow.arguments = lambda command, *words: [command, *words, "--pipelines-file", "pipelines.yaml"]
    args = ("four", "--pipeline", "other")
    out, _ = flow.hugs(*args, command="stages")
    assert holds(out, "default", "Four.", "* other", "Another.", "four", "two, three", "Write one file.")
    assert holds(out, "Write one file.", "word = z", "What to write.", "delay = 0.0", "Seconds", "hold", "A file")
    rows = json.loads(flow.hugs(*args, "--json", command="stages")[0])
    assert rows["stages"][0]["params"] == {"word": "z", "delay": 0.0, "hold": ""}


def test_render_without_a_finished_run_says_what_to_run(flow):
    _, err = flow.hugs("--cameras", "c.npz", "--out", "o", command="render", code=2)
    assert holds(err, "error", "train", "clip.mp4", "default", "hint", "hugs run clip.mp4")


def test_gc_without_results_is_refused(flow):
    assert holds(flow.hugs(command="gc", code=2)[1], "error", "clip.mp4", "work")


def test_help_of_all_commands_fits_80_columns(tmp_path):
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from hugs_cli import main; main()"
    env = {**os.environ, "COLUMNS": "80", "NO_COLOR": "1"}
    command = [sys.executable, "-c", code, "--help"]
    out = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env, check=True).stdout
    assert "..." not in out.replace("[ARGS]...", "") and max(map(len, out.splitlines())) <= 80
    listed = out.partition("--help ")[2].splitlines()
    for group, names in app.COMMANDS.items():
        place = listed.index(f"{group}:") + 1
        assert [line.split()[0] for line in listed[place : place + len(names)]] == [*names], "a line each"


def test_the_version_is_that_of_the_package(tmp_path):
    result = CliRunner().invoke(app.app, ["--version"])
    assert result.exit_code == 0 and result.output.startswith(f"hugs {version('hugs-avatar')}")
    assert {"python", "torch", "cpu:"} <= set(result.output.split()), result.output


@pytest.mark.parametrize("command", ["run", "status", "why", "accept", "ablate", "costs", "demo"])
@pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
def test_seeds_that_training_cannot_take_are_refused_at_once(tmp_path, monkeypatch, command, seed):
    monkeypatch.chdir(tmp_path)
    args = [] if command == "demo" else ["clip.mp4"]
    result = CliRunner().invoke(app.app, [command, *args, "--seed", str(seed)])
    assert result.exit_code == 2 and "Invalid value for '--seed'" in result.output
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_folder_that_may_only_be_read_can_be_looked_at(flow):
    """Nothing can be written beside a plain file, which is what a read-only disk is for the memory of code."""
    for args in (["status"], ["why"], ["run", "--dry-run"]):
        out, err = flow.hugs("--work", "clip.mp4", *args[1:], command=args[0])
        assert "one" in out and "first run" in out and err == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a\nb.mp4", "a\x1b[31mred.mp4", "a\x9b31m\u2028b.mp4"])
def test_control_characters_of_a_name_stay_out_of_the_terminal(flow, name):
    flow.edit("one", "[video])", "[video]); job.note(video.name); job.warn(video.name)")
    flow.video = flow.video.rename(flow.folder / name)
    flow.arguments = lambda command, *words: [command, *words]
    shown = name.encode("unicode_escape").decode()
    place = ("--pipelines-file", "pipelines.yaml")
    for command, args, code in (
        ("run", (name, "one", *place), 0),
        ("status", (name, *place), 0),
        ("gc", (name,), 0),
        ("run", (f"no{name}", *place), 2),
    ):
        out, err = flow.hugs(*args, command=command, code=code)
        assert not set(out + err) & set("\x1b\x9b\u2028") and "b.mp4" not in (out + err).split("\n")
        if command == "run" and not code:
            assert out == f"work/{shown.removesuffix('.mp4')}/default/one\n"
            assert err.count(f"warning: {shown}") == 1 and err.count(shown) >= 3
