"""The options that commands share, and those that a run keeps for the commands on its results."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from hugs_cli import app, options
from hugs_cli.cache.workspace import OPTIONS, Workspace
from hugs_cli.console import Console
from hugs_cli.options import RunOptions
from hugs_cli.pipelines import UsageError
from tests.made.flow import Flow
from tests.made.said import holds

CLIP = Path("clip.mp4")


@pytest.mark.parametrize("command", ["run", "status", "why", "accept", "ablate", "costs"])
def test_every_command_on_a_clip_passes_all_options_on(monkeypatch, command):
    opened = []

    def refuse(given, video):
        opened.append((given, video))
        raise UsageError("enough")

    monkeypatch.setattr(RunOptions, "session", refuse)
    names = [
        "set",
        "masks",
        "person",
        "cameras",
        "smpl-fit",
        "landmarks",
        "face",
        "body-model",
        "height",
        "scale",
        "pipeline",
        "work",
        "pipelines-file",
    ]
    CliRunner().invoke(app.app, [command, "clip.mp4", "--seed=7", *(f"--{name}={name}" for name in names)])
    paths = (Path(name) for name in ("cameras", "smpl-fit", "landmarks", "face", "body-model"))
    places = "pipeline", Path("work"), Path("pipelines-file")
    assert opened == [(RunOptions(["set"], Path("masks"), "person", *paths, ["height"], "scale", 7, *places), CLIP)]


def test_lengths_that_nobody_has_or_that_fit_nothing_are_refused_at_once(tmp_path):
    def facts(**given):
        with pytest.raises(UsageError) as error:
            RunOptions(work=tmp_path, **given).session(CLIP)
        return f"{error.value} {error.value.hint} {error.value.facts}"

    for tall in ("0.4", "tall"):
        assert holds(facts(height=[tall]), "smpl.height", tall)
    assert holds(facts(height=["1.85", "1.70"]), "person 2", "--person all")
    assert holds(facts(scale="2.31"), "smpl.scale") and holds(facts(scale="cameras"), "--cameras")
    both = RunOptions(
        work=tmp_path, height=["6'1\"", "2=1,70"], person="all", scale="cameras", cameras=tmp_path
    ).session(CLIP)
    assert both.pipeline.stages["smpl"].params.height == {1: pytest.approx(1.8542), 2: 1.7}


def test_a_pipelines_name_has_no_such_seed_either(tmp_path):
    for seed in (2**63, "9" * 5_000):
        with pytest.raises(UsageError, match=r"\bseed\d+\b"):
            RunOptions(pipeline=f"default.seed{seed}").session(tmp_path / "clip.mp4")
    largest = 2**63 - 1
    assert RunOptions(pipeline=f"default.seed{largest}").session(tmp_path / "clip.mp4").seeds["train"] == largest


def test_the_largest_seeds_can_be_used():
    """Numpy and torch take them, also those that a study counts up to."""
    for seed in (0, options.MAX_SEED, options.MAX_SEED + 1000):
        assert torch.Generator().manual_seed(seed).initial_seed() == seed
        np.random.default_rng(seed)


@pytest.mark.parametrize(
    "name", ["plain", "größe 東 'q\" $x", "b\udcff\udc80ytes", "\udce4/in\udcffside", "\x1b[31m\n"]
)
@pytest.mark.parametrize("option", ["masks", "cameras", "smpl_fit", "landmarks", "face", "body_model"])
def test_a_path_of_any_name_is_kept_and_read_back(tmp_path, option, name):
    """Names are bytes on a disk, and may be none of UTF-8."""
    place, given = Workspace(CLIP, tmp_path, "default"), RunOptions(work=tmp_path, **{option: tmp_path / name})
    place.links.mkdir(parents=True)
    place.keep_options(given.values())
    written = (place.links / OPTIONS).stat().st_ino
    place.keep_options(given.values())
    assert (place.links / OPTIONS).stat().st_ino == written, "nothing new to write"
    said = io.StringIO()
    last = RunOptions(work=tmp_path).of_last_run(CLIP, Console(err=said))
    assert getattr(last, option) == tmp_path / name
    assert holds(said.getvalue(), "with the options", f"--{option.replace('_', '-')}")


def test_every_path_that_a_run_is_given_is_among_those():
    hints = get_type_hints(options.Kept)
    paths = {"masks", "cameras", "smpl_fit", "landmarks", "face", "body_model"}
    assert {one for one in hints if "Path" in str(hints[one])} == paths


@pytest.fixture(scope="session")
def ran(tmp_path_factory) -> Flow:
    """A clip after a run with masks, a seed and a setting; to be copied."""
    flow = Flow(tmp_path_factory.mktemp("ran"))
    (flow.folder / "masks.txt").write_text("outlines")
    flow.hugs("--masks", "masks.txt", "--seed", "3", "--set", "two.word=b")
    return flow


@pytest.fixture
def kept(ran, tmp_path) -> Flow:
    """A fresh copy of it, which stands where the run stood."""
    flow = ran.copied(tmp_path)
    file = flow.work / "clip/default" / OPTIONS
    file.write_text(file.read_text().replace(str(ran.folder), str(tmp_path)))
    return flow


def states(flow: Flow, *args: str) -> tuple[set[str], str]:
    """The states of all stages, and what was said beside them."""
    out, err = flow.hugs(*args, "--json", command="status")
    return {row["state"] for row in json.loads(out)}, err


@pytest.mark.slow
def test_commands_on_results_take_the_options_of_the_run(kept):
    found, said = states(kept)
    assert found == {"fresh"}
    assert holds(said, "last run", "default") and said.endswith(": --set two.word=b --masks masks.txt --seed 3\n")
    assert "three is fresh" in kept.hugs("three", command="why")[0]
    kept.edit("helper", "[:10_000]", "[:10_001]")
    assert kept.hugs(command="accept")[0].count("accepted: ") == 4
    assert list(kept.ran("--masks", "masks.txt", "--seed", "3", "--set", "two.word=b")) == []


@pytest.mark.slow
def test_other_options_take_the_place_of_the_runs_and_are_said(kept):
    found, said = states(kept, "--seed", "0", "--set", "four.word=d")
    assert "stale" in found and holds(said, "default", "--set two.word=b --masks masks.txt --seed 3")
    assert said.endswith("): --set four.word=d --seed 0\n")
    same = ("--seed", "3", "--set", "two.word=b", "--masks", str(kept.folder / "masks.txt"))
    assert states(kept, *same) == ({"fresh"}, "")
    assert list(kept.ran()) == ["one", "two", "three", "four"], "a run takes what it is given"
    assert states(kept) == ({"fresh"}, ""), "and that is kept"


@pytest.mark.slow
def test_an_older_work_folder_has_no_options_and_broken_ones_are_not_taken(kept):
    file = kept.work / "clip/default" / OPTIONS
    whole = json.loads(file.read_text())
    broken = [b"", b"[]", b"[" * 100_000, b'{"seed": "3"}', json.dumps(whole | {"seed": -1}).encode(), b'{"masks": 1}']
    broken += [b'{"masks": "/\\ud800"}', b'{"seed": true}', b'{"seed": 3.0}']
    broken += [json.dumps(whole | {"pipelines_file": "theirs.yaml"}).encode(), b'{"set_": [1]}', b"\xff"]
    for content in [*broken, json.dumps(whole | {"person": "x" * options.LARGEST}).encode()]:
        file.write_bytes(content)
        given = RunOptions(work=kept.work)
        said = io.StringIO()
        assert given.of_last_run(CLIP, Console(err=said)) == given
        assert holds(said.getvalue(), "options", "default", "cannot be read")
    file.unlink()
    os.mkfifo(file)
    assert "stale" in states(kept)[0]
    file.unlink()
    found, said = states(kept)
    assert "stale" in found and said == ""


@pytest.mark.slow
def test_hostile_options_name_no_code_and_obey_no_terminal(kept):
    file = kept.work / "clip/default" / OPTIONS
    hostile = json.loads(file.read_text()) | {"masks": "/nowhere/\x1b[31mred\x00"}
    file.write_text(json.dumps(hostile))
    _, err = kept.hugs(command="status", code=2)
    assert "\x1b" not in err and holds(err, "--masks", "/nowhere/\\x1b[31mred\\x00")
    file.write_text(json.dumps(hostile | {"masks": str(kept.folder)}))
    assert holds(kept.hugs(command="status", code=2)[1], "error", "source")
    file.write_text(json.dumps(hostile | {"set_": ["two.word=\x1b[2J"]}))
    assert holds(kept.hugs(command="status", code=2)[1], "error", "control characters")


@pytest.mark.slow
def test_the_only_pipeline_with_results_is_taken_and_said(made):
    links = made.work / "clip"
    (links / "default").rename(links / "other")
    for hostile in ("\x1b[31m", "-p", "Other"):
        (links / hostile).mkdir()
    assert holds(states(made)[1], "pipeline other", "only", "clip.mp4")
    said = io.StringIO()
    for stages, name in (((), "other"), (("one",), "other"), (("one", "export"), "default")):
        assert options.pipeline_of(CLIP, made.work, None, Console(err=said), *stages) == name
    assert options.pipeline_of(CLIP, made.work, "draft", Console(err=said)) == "draft"
    (links / "other.10m").mkdir()
    (links / "other.10m/one").symlink_to("../other/one")
    assert options.pipeline_of(CLIP, made.work, None, Console(err=said)) == "default"
    assert said.getvalue().count("\n") == 2
