"""Which results are garbage: whatever parts of a work folder are links, copies, or cannot be read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from hugs_cli.cache import accept
from hugs_cli.cache.freshness import CodeChanged, Recipe, Verdict
from hugs_cli.cache.garbage import garbage
from hugs_cli.cache.workspace import Stamp, Workspace
from tests.made.finished import stamp

USED, UNUSED = "a" * 8, "b" * 8


def filled(work: Path, clip: str = "clip") -> Workspace:
    """A clip with a result in use, of a pipeline called default, and one that is not."""
    workspace = Workspace(Path(f"{clip}.mp4"), work, "default")
    workspace.create()
    for key in (USED, UNUSED):
        folder = workspace.folder("train", key)
        folder.mkdir()
        (folder / "avatar.npz").write_text(key)
        stamp("train", key).write(folder)
    workspace.link("train", workspace.folder("train", USED))
    return workspace


def unused(workspace: Workspace) -> list[str]:
    return [one.name for one in garbage(workspace)]


def store_elsewhere(one: Workspace, room: Path) -> None:
    shutil.move(one.store, room / "big")
    one.store.symlink_to(room / "big")


def store_elsewhere_of_that_name(one: Workspace, room: Path) -> None:
    (room / "disk/lost+found").mkdir(parents=True)
    shutil.move(one.store, room / "disk/store")
    one.store.symlink_to(room / "disk/store")


def pipeline_elsewhere(one: Workspace, room: Path) -> None:
    shutil.move(one.links, room / "links")
    one.links.symlink_to(room / "links")


def clip_elsewhere(one: Workspace, room: Path) -> None:
    shutil.move(one.root, room / "root")
    one.root.symlink_to(room / "root")


def chain(one: Workspace, room: Path) -> None:
    (one.links / "train").rename(one.links / "first")
    (one.links / "train").symlink_to("first")
    (one.links / "first").rename(room / "first")
    (room / "first").unlink()
    (room / "first").symlink_to(one.folder("train", USED).absolute())
    (one.links / "train").unlink()
    (one.links / "train").symlink_to(room / "first")


def absolute(one: Workspace, room: Path) -> None:
    (one.links / "train").unlink()
    (one.links / "train").symlink_to(one.folder("train", USED).absolute())


def copy_in_the_links_place(one: Workspace, room: Path) -> None:
    (one.links / "train").unlink()
    shutil.copytree(one.folder("train", USED), one.links / "train")


LINKED = [store_elsewhere, store_elsewhere_of_that_name, pipeline_elsewhere, clip_elsewhere, chain, absolute,
          copy_in_the_links_place]  # fmt: skip


@pytest.mark.parametrize("change", LINKED, ids=lambda change: change.__name__)
def test_what_is_linked_by_any_way_is_in_use_and_a_new_link_leads_there(
    tmp_path: Path, change: Callable[[Workspace, Path], None]
) -> None:
    one = filled(tmp_path / "work")
    change(one, tmp_path)
    one.create()
    assert unused(one) == [f"train-{UNUSED}"]
    assert one.linked("train") == one.folder("train", USED)
    one.link("train", one.folder("train", UNUSED))
    assert (one.links / "train/avatar.npz").read_text() == UNUSED and unused(one) == [f"train-{USED}"]
    one.link("train", one.folder("train", USED))
    assert (one.links / "train/avatar.npz").read_text() == USED


@pytest.mark.parametrize("name", ["store", "big"])
def test_clips_that_share_a_store_keep_each_others_results_and_lock_each_other_out(tmp_path: Path, name: str) -> None:
    """One work folder was copied and its store linked, or both stores were put on a larger disk, as one."""
    one = filled(tmp_path / "work")
    other = Workspace(Path("clip.mp4"), tmp_path / "copy", "mine")
    if name == "big":
        store_elsewhere(one, tmp_path)
    other.root.mkdir(parents=True)
    other.store.symlink_to(os.path.realpath(one.store))
    for workspace in (one, other):
        workspace.create()
    other.link("train", other.folder("train", UNUSED))
    assert unused(one) == unused(other) == []
    held = []
    with one.lock(pytest.fail):
        handle = os.open(other.beside(".lock"), os.O_RDWR)
        held.append(os.path.samestat(os.fstat(handle), os.stat(one.beside(".lock"))))
        os.close(handle)
    assert held == [True]
    shutil.rmtree(other.root)
    assert unused(one) == [f"train-{UNUSED}"], "who is gone uses nothing"


@pytest.mark.skipif(os.geteuid() == 0 and not hasattr(os, "seteuid"), reason="root may read everywhere")
@pytest.mark.parametrize("part", ["default", "default/train", "store", "."])
def test_where_something_cannot_be_listed_nothing_is_garbage(tmp_path: Path, part: str) -> None:
    one = filled(tmp_path / "work")
    copy_in_the_links_place(one, tmp_path)
    (one.root / part).chmod(0)
    for folder in (tmp_path, *tmp_path.parents):
        if os.stat(folder).st_uid == os.geteuid() and str(folder).startswith("/tmp/"):
            folder.chmod(0o755)
    was = os.geteuid()
    if was == 0:
        os.chown(one.root / part, 1, 1)
        os.seteuid(65534)
    try:
        with pytest.raises(PermissionError):
            garbage(one)
    finally:
        os.seteuid(was)
        (one.root / part).chmod(0o755)


@pytest.mark.parametrize("step", ["rename", "relink", "log_run", None])
def test_accept_killed_after_any_step_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str | None):
    one = filled(tmp_path / "work")
    last = Stamp.read(one.folder("train", USED))
    recipe = Recipe("train", 0, {"stages.train": "edited"}, {}, {})
    verdict = Verdict(
        "train", (CodeChanged("stages.train", "edited"),), recipe, one.folder("train", recipe.key), None, last
    )
    session = type("Session", (), {"workspace": one, "pipeline": type("Pipeline", (), {"name": "default"})})()

    def kill(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if step:
            target = {"rename": accept.os, "relink": accept.garbage, "log_run": one}[step]
            patch.setattr(target, step, kill)
        try:
            accept.rekey(session, verdict)
        except KeyboardInterrupt:
            assert step
    assert unused(one) == [f"train-{UNUSED}"]
    found = one.linked("train")
    kept = [folder for folder in (one.folder("train", recipe.key), found) if folder and Stamp.read(folder)]
    assert kept and Stamp.read(kept[0]).key == recipe.key and (kept[0] / "avatar.npz").read_text() == USED
