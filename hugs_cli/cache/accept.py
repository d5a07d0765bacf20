"""`hugs accept`: keeps results where only code has changed, under the key of the present code."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial

from hugs_cli.cache import garbage
from hugs_cli.cache.engine import now, uninterrupted
from hugs_cli.cache.freshness import Session, Verdict
from hugs_cli.cache.workspace import Accepted, Stamp
from hugs_cli.console import Console


def accept(session: Session, wanted: list[str], console: Console) -> dict[str, tuple[Verdict, Stamp | None]]:
    """Keep the results of the wanted stages where only code has changed: folder and stamp get the new key, the content
    stays. Returns each wanted stage's verdict and the new stamp of an accepted one."""
    with session.workspace.lock(console.waiting):
        return session.acceptable(wanted, partial(rekey, session))


def rekey(session: Session, verdict: Verdict) -> Stamp | None:
    """Give the last result the key of the present code, and return its new stamp. None, and nothing is done, where it is
    damaged."""
    last, recipe, new = verdict.last, verdict.recipe, verdict.folder
    folder = session.workspace.linked(verdict.stage)
    if not (last and folder and recipe and new) or last.damage(folder) or new.exists():
        return None
    how: Accepted = {"when": now(), "instead_of": last.key, "changes": list(map(str, verdict.reasons))}
    stamp = replace(last, key=recipe.key, code=recipe.code, inputs=recipe.inputs, accepted=[*last.accepted, how])
    with uninterrupted():
        stamp.write(folder)
        os.rename(folder, new)
        garbage.relink(session.workspace, folder, new)
        session.workspace.log_run(stage=verdict.stage, pipeline=session.pipeline.name, result="accepted", **how)
    return stamp
