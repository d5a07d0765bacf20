"""Which results of a store are in use: what all pipelines of all clips that have the store link to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from hugs_cli.cache.workspace import LOCK, USERS, Stamp, Workspace, is_result, result_behind


def pipeline_links(workspace: Workspace) -> Iterator[Path]:
    """What lies in the folders of all pipelines that have the store; OSError for one that cannot be listed."""
    owner = workspace.beside("runs.jsonl")
    own = {os.path.realpath(workspace.root), *([str(owner.parent)] if owner.exists() else [])}
    for user in own | workspace.users():
        for folder in os.scandir(user):
            if folder.is_dir() and folder.name != workspace.store.name:
                yield from (Path(entry.path) for entry in os.scandir(folder.path))


def garbage(workspace: Workspace) -> list[Path]:
    """Results that no pipeline links to, and leftovers of stopped or killed runs; OSError where that cannot be known."""
    linked = set()
    for link in pipeline_links(workspace):
        if not link.is_symlink() and link.is_dir():
            os.listdir(link)  # a copy of a result, whose stamp says which one: it must be readable
        linked.add(result_behind(link))
    found = [Path(entry.path) for entry in os.scandir(workspace.store)]
    gone = linked - {one.name for one in found}
    return sorted(one for one in found if is_result(one) and one.name not in linked and not former(one) & gone)


def former(result: Path) -> set[str]:
    """The names that a result had before it was accepted: links still have them where `hugs accept` was killed."""
    stamp = Stamp.read(result)
    return {f"{stamp.stage}-{one['instead_of'][:8]}" for one in stamp.accepted} if stamp else set()


def strays(workspace: Workspace) -> list[Path]:
    """What lies in the store and was not made by a run."""
    return sorted(one for one in workspace.store.glob("*") if not is_result(one) and one.name not in (LOCK, USERS))


def relink(workspace: Workspace, old: Path, new: Path) -> None:
    """Point every pipeline's link from one result to another."""
    for link in pipeline_links(workspace):
        if result_behind(link) == old.name:
            workspace.point(link, new)
