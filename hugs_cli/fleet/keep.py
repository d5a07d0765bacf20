"""`--keep`: of a finished clip some stages' results stay, and what its page shows and links; the rest is let go.

A clip of which results were let go is done as long as its sources, settings and seed are the same, and what was kept is there.
Its code does not count: nothing can be made anew of results that are gone.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from hugs_cli.cache import garbage
from hugs_cli.cache.fingerprint import digest
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.report import PAGE
from hugs_cli.cache.workspace import STAMP, Stamp, read_json, result_behind, size_of, write_json

RECORD = "kept.json"  # in the pipeline's folder
LINK = re.compile(rb'(?:href|src)="([^":#?]+)"')


def record(session: Session, keep: Sequence[str]) -> dict[str, Any]:
    """What is known of a clip of which all but some results, `keep` among them, were let go; empty where it is none, or not
    any more."""
    found = read_json(session.workspace.links / RECORD)
    kept = found.get("kept")
    if not isinstance(kept, dict) or not set(keep) <= set(kept) or found.get("made_of") != made_of(session):
        return {}
    for name, key in kept.items():
        folder = session.workspace.linked(name)
        stamp = folder and Stamp.read(folder)
        if not folder or not stamp or stamp.key != key or stamp.damage(folder):
            return {}
    return found


def made_of(session: Session) -> str:
    """The digest of a clip's sources, and of the settings and seeds of all stages."""
    sources = {name: session.workspace.source(name, path) for name, path in session.sources.items()}
    stages = {
        name: [stage.module, stage.settings(), session.seeds.get(name, session.seed)]
        for name, stage in session.pipeline.stages.items()
    }
    return digest([sources, stages])


def let_go(session: Session, keep: Sequence[str], result: dict[str, Any]) -> dict[str, Any]:
    """Remove the results of all other stages, except those that another pipeline links to, and what nothing links to.

    Returns `result` (see `plan.result_of`) with what was `kept`, the bytes `freed`, and the pages that are left. Where it is
    killed, the next call goes on.
    """
    workspace = session.workspace
    kept = {name: stamp.key for name in keep if (one := workspace.linked(name)) and (stamp := Stamp.read(one))}
    facts = {"made_of": made_of(session), "kept": kept, "result": result}
    write_json(workspace.links / RECORD, facts)
    own, size = os.path.realpath(workspace.links), size_of(workspace.store)
    links = [link for link in garbage.pipeline_links(workspace) if os.path.realpath(link.parent) != own]
    elsewhere, shown = set(map(result_behind, links)), linked_files(workspace.links / PAGE)
    for name in session.pipeline.stages:
        folder = workspace.linked(name)
        if name in keep or folder is None or not folder.is_dir() or folder.name in elsewhere:
            continue
        (folder / STAMP).unlink(missing_ok=True)  # first: what lacks files is no result
        for file in [one for one in folder.rglob("*") if one.is_symlink() or not one.is_dir()]:
            way = file.relative_to(folder).as_posix()
            if f"{name}/{way}" not in shown and f"{folder.name}/{way}" != result["picture"]:
                file.unlink()
        for inner in sorted((one for one in folder.rglob("*") if one.is_dir()), reverse=True):
            if not any(inner.iterdir()):
                inner.rmdir()
        if not any(folder.iterdir()):
            folder.rmdir()
            (workspace.links / name).unlink()
    for left in garbage.garbage(workspace):
        shutil.rmtree(left)
    pages = [page for page in result["pages"] if (workspace.links / page).is_file()]
    result = result | {"pages": pages, "kept": list(kept), "freed": size - size_of(workspace.store)}
    write_json(workspace.links / RECORD, facts | {"result": result})
    return result


def linked_files(page: Path) -> set[str]:
    """What a page links to, beside or below it; nothing where there is no page."""
    try:
        return {unquote(one.decode(errors="replace")) for one in LINK.findall(page.read_bytes())}
    except OSError:
        return set()
