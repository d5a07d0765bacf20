"""What all stages share."""

from __future__ import annotations

import importlib.util
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stages import contract
from stages.contract import Job, StageError, listed, load_stage, whole
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.spz import write_spz
from stages.formats.images import write_image
from stages.formats.video import write_alpha_video, write_video
from stages.records import Scene


@pytest.mark.parametrize(("platform", "unit"), [("darwin", 1), ("linux", 1024)])
def test_memory_is_counted_in_bytes_on_every_system(monkeypatch, platform, unit):
    """getrusage(2): ru_maxrss is bytes on macOS and kilobytes on Linux."""
    monkeypatch.setattr(sys, "platform", platform)
    spec = importlib.util.spec_from_file_location("contract_there", contract.__file__)
    there = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "contract_there", there)
    spec.loader.exec_module(there)

    class Usage:
        ru_maxrss = 3_000

    monkeypatch.setattr(there.resource, "getrusage", lambda who: Usage)
    assert there.peak_memory() == 3_000 * unit


def test_an_error_reads_whole_where_nothing_formats_it():
    assert str(StageError("no floor", "give one", ["2 frames", "1 body"])).splitlines() == [
        "no floor",
        "  2 frames",
        "  1 body",
        "hint: give one",
    ]
    assert str(StageError("no floor")) == "no floor"


def test_a_checkout_names_its_commit_beside_the_version():
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent)
    commit = f"+{head.stdout[:8]}" if head.returncode == 0 else ""
    assert contract.build() == f"{contract.version()}{commit}" and re.fullmatch(r"\d+\.\d+\.\d+", contract.version())


def scene() -> Scene:
    rows = np.random.default_rng(0).random((4000, 4), np.float32)
    return Scene(rows[:, :3], rows, rows[:, :3], rows[:, 0], rows[:, :3], np.zeros((4000, 0, 3), np.float32))


NOISE = np.random.default_rng(0).integers(0, 255, (64, 96, 4), np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "a.mp4": lambda out: write_video(out, [NOISE[..., :3]] * 9, 4),
    "a.mov": lambda out: write_alpha_video(out, [NOISE] * 9, 4),
    "a.png": lambda out: write_image(out, NOISE),
    "a.ply": lambda out: write_ply(out, scene()),
    "a.spz": lambda out: write_spz(out, scene()),
    "a.html": lambda out: out.write_text("page" * 10_000),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_output_is_whole_or_as_it_was_on_a_full_disk(tmp_path: Path, name: str) -> None:
    """As large as a disk with 4 kB left lets files be."""
    out, job = tmp_path / name, Job(tmp_path)
    with job.writes(out) as part:
        WRITERS[name](part)
    first, before = out.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    out.write_text("as it was")
    assert len(first) > 4_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, before[1]))
    try:
        with pytest.raises(Exception, match=r"(?i)too large|cannot write|no room|errno"), job.writes(out) as part:
            WRITERS[name](part)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert out.read_text() == "as it was" and os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["a", "a.png", ".hidden", "a" * 250 + ".mp4", "a." + "b" * 250, "\U00020000" * 60])
def test_a_file_appears_whole_under_any_name_and_in_the_place_of_a_link(tmp_path: Path, name: str) -> None:
    out, heard = tmp_path / name, []
    (tmp_path / "theirs").write_text("theirs")
    out.symlink_to("theirs")
    with Job(tmp_path, emit=heard.append).writes(out) as part:
        part.write_text("new")
        assert (
            out.read_text() == "theirs"
            and part.suffix == out.suffix[-16:] * (len(out.suffix) < 17)
            and part.parent == out.parent
        )
    assert out.read_text() == "new" and not out.is_symlink() and (tmp_path / "theirs").read_text() == "theirs"
    assert [event["event"] for event in heard] == ["writes"] and len(os.listdir(tmp_path)) == 2
    with pytest.raises(KeyboardInterrupt), whole(out) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert out.read_text() == "new" and len(os.listdir(tmp_path)) == 2


def test_settings_that_only_commands_give_are_not_listed():
    shown = listed(load_stage("stages.train").params)
    assert "steps" in shown and not {"seconds", "reserve", "reserve_least"} & {*shown}
    assert not {"keep", "code"} & {*listed(load_stage("stages.commands.compose").params)}
