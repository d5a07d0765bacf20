"""The command line itself: what it loads, exit codes, words of refusal."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hugs_cli import app, app_compare, app_show
from hugs_cli.pipelines import UsageError

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


@pytest.mark.slow
def processor_seconds(flow, command: str) -> float:
    """What a command takes; unlike the clock's, seconds of the processor bear other work beside them."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    flow.hugs(command=command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.slow
def test_a_run_with_nothing_to_do_is_quick_and_loads_nothing_heavy(flow):
    flow.hugs()
    args = ["run", "clip.mp4", "--pipelines-file", "pipelines.yaml"]
    loaded = modules_after(flow.folder, *args)
    assert "flow" in loaded and not loaded & HEAVY
    run, status = (min(processor_seconds(flow, command) for _ in range(3)) for command in ("run", "status"))
    assert run < 2 * status  # 1.0 measured


@pytest.mark.parametrize(
    ("args", "problem", "hint"),
    [
        (["--set", "two.wort=1"], "pipeline default, stage two: no setting 'wort'", "did you mean `word`?"),
        (["tow"], "pipeline default: no stage 'tow'", "did you mean `two`?"),
        (["--pipeline", "othr"], "pipelines.yaml: no pipeline 'othr'", "did you mean `other`?"),
        (["--masks", "nowhere"], "no file for --masks at nowhere", "check the path"),
        (["--smpl-fit", "clip.mp4"], "no stage of pipeline default reads --smpl-fit", "leave it out"),
        (["--work", "clip.mp4/x"], "cannot write to clip.mp4/x/clip", "--work"),
    ],
)
def test_wrong_usage_is_refused_in_our_words(flow, args, problem, hint):
    _, err = flow.hugs(*args, code=2)
    first, *rest = err.splitlines()
    assert first == f"error: {problem}"
    assert rest[-2] == "" and rest[-1].startswith("hint: ") and hint in rest[-1]
    assert "Traceback" not in err


def test_missing_video_and_unknown_option(flow):
    flow.video.unlink()
    assert "error: no video at clip.mp4\n" in flow.hugs(code=2)[1]
    assert "--wrok" in flow.hugs("--wrok", "x", code=2)[1]


@pytest.mark.slow
def test_two_clips_of_one_name_do_not_mix(flow):
    flow.hugs()
    (flow.folder / "b").mkdir()
    (flow.folder / "b/clip.mp4").write_text("others")
    flow.video = flow.folder / "b/clip.mp4"
    process = flow.start()
    process.communicate(timeout=60)
    flow.video.rename(flow.folder / "clip.mp4")
    assert flow.ran()["one"] == ["inputs.video changed"]


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
    assert (done.returncode, done.stderr) == (130, "stopped; finished stages are kept\n")


def test_stages_lists_settings_with_their_meaning(flow):
    args = ["stages", "four", "--pipelines-file", "pipelines.yaml", "--pipeline", "other"]
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); from hugs_cli import main; main()",
    ]
    out = subprocess.run([*command, *args], capture_output=True, text=True, cwd=flow.folder, check=True).stdout
    assert out == (
        "  default     Four.\n* other       Another.\n\nfour  <- two, three\n  Write one file.\n"
        "    word = z   What to write.\n    delay = 0.0   Seconds to wait before the end.\n"
    )
    rows = json.loads(subprocess.run([*command, *args, "--json"], capture_output=True, cwd=flow.folder).stdout)
    assert rows["stages"][0]["params"] == {"word": "z", "delay": 0.0}


def test_render_without_a_finished_run_says_what_to_run(flow):
    _, err = flow.hugs("--cameras", "c.npz", "--out", "o", command="render", code=2)
    assert err == "error: no finished train of clip.mp4 in pipeline default\n\nhint: `hugs run clip.mp4`\n"


def test_gc_without_results_is_refused(flow):
    assert "error: no results of clip.mp4 in work" in flow.hugs(command="gc", code=2)[1]


def test_help_of_all_commands_fits_80_columns(tmp_path):
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from hugs_cli import main; main()"
    env = {**os.environ, "COLUMNS": "80", "NO_COLOR": "1"}
    command = [sys.executable, "-c", code, "--help"]
    out = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env, check=True).stdout
    assert "..." not in out.replace("[ARGS]...", "") and max(map(len, out.splitlines())) <= 80
    assert len(out.partition("Commands:")[2].splitlines()) == 13, "a line each"


@pytest.mark.parametrize("command", ["run", "status", "why", "accept", "ablate", "costs"])
def test_every_command_on_a_clip_passes_all_options_on(monkeypatch, command):
    opened = []

    def refuse(*args):
        opened.append(args)
        raise UsageError("enough")

    for module in (app, app_compare, app_show):
        monkeypatch.setattr(module, "open_session", refuse)
    names = [
        "pipeline",
        "set",
        "masks",
        "person",
        "cameras",
        "smpl-fit",
        "body-model",
        "seed",
        "work",
        "pipelines-file",
    ]
    options = [f"--{name}={i if name == 'seed' else name}" for i, name in enumerate(names)]
    CliRunner().invoke(app.app, [command, "clip.mp4", *options])
    values = [[name] if name == "set" else i if name == "seed" else name for i, name in enumerate(names)]
    paths = {"masks", "cameras", "smpl-fit", "body-model", "work", "pipelines-file"}
    wanted = [Path(str(value)) if name in paths else value for name, value in zip(names, values, strict=True)]
    assert opened == [(Path("clip.mp4"), *wanted)]
