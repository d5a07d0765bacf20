"""Locks: one at a time, and never on a file elsewhere."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

import pytest

from hugs_cli.cache.locks import locked
from hugs_cli.cache.workspace import Workspace
from hugs_cli.pipelines import UsageError


def test_the_second_waits_for_the_first_and_is_told_who_that_is(tmp_path):
    order: list[str] = []

    def second() -> None:
        with locked(tmp_path / "lock", lambda holder: order.append(holder)):
            order.append("second")

    with locked(tmp_path / "lock", pytest.fail):
        thread = threading.Thread(target=second)
        thread.start()
        while not order:
            pass
        order.append("first")
    thread.join()
    assert order == [f"process {os.getpid()}", "first", "second"]


@pytest.mark.parametrize("name", [".lock", "runs.jsonl", "sources.json", "default", "store"])
def test_a_link_in_a_work_folder_of_somebody_else_changes_nothing_elsewhere(tmp_path, name):
    """Locks are emptied, logs are added to, and small files are replaced: never through a link."""
    precious = tmp_path / "precious"
    precious.write_text("precious")
    workspace = Workspace(Path("clip.mp4"), tmp_path / "work", "default")
    workspace.root.mkdir(parents=True)
    (workspace.root / name).symlink_to(precious)
    (tmp_path / "clip.mp4").write_text("pixels")
    for act in (
        workspace.create,
        lambda: workspace.log_run(stage="train"),
        lambda: workspace.source("video", tmp_path / "clip.mp4"),
        lambda: workspace.lock(pytest.fail).__enter__(),
        lambda: workspace.link("train", workspace.folder("train", "a" * 8)),
    ):
        with contextlib.suppress(Exception):  # refused
            act()
    assert precious.read_text() == "precious" and len(os.listdir(tmp_path)) == 3


@pytest.mark.parametrize("stage", ["../../../precious/x", "..", "a/b", "Train", ""])
def test_a_stamp_of_somebody_else_moves_nothing_out_of_the_store(tmp_path, stage):
    """A copy of a result in the place of a link goes to the store, under the name that its stamp says."""
    from tests.made.finished import stamp

    workspace = Workspace(Path("clip.mp4"), tmp_path / "work", "default")
    workspace.create()
    (workspace.links / "train").mkdir()
    stamp(stage, "a" * 8).write(workspace.links / "train")
    with pytest.raises(UsageError, match=r"default/train\b"):
        workspace.link("train", workspace.folder("train", "b" * 8))
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_dir()) == [
        "clip",
        "default",
        "store",
        "train",
        "work",
    ]
