"""The model files that the stages need. No pipeline names it; `hugs doctor` runs it."""

from __future__ import annotations

from pathlib import Path

from stages import contract
from stages.contract import Job


class Params(contract.Params):
    fetch: bool = False
    """Bring every file that is missing."""


def run(job: Job, params: Params) -> None:
    """Report each model file in an event of its own; StageError where one cannot be fetched."""
    from stages.estimators import assets

    body = Path(assets.__file__).with_name("free_body.npz")
    job.emit({"event": "model", "name": "free body", "here": body.is_file(), "why": "ships with hugs"})
    for name, asset in assets.ASSETS.items():
        if params.fetch and not assets.present(name):
            assets.fetch(name, job.note)
        job.emit({"event": "model", "name": name, "here": assets.present(name), "why": asset.why})
