"""The model files that the stages need, and whether films keep their colours. No pipeline names it; `hugs doctor` runs it."""

from __future__ import annotations

from pathlib import Path

from stages import contract
from stages.contract import Job

SAME = 3  # of 255, by which the colours of a film may be off


class Params(contract.Params):
    fetch: bool = False
    """Bring every file that is missing."""


def run(job: Job, params: Params) -> None:
    """Report each model file, and how films are decoded, in an event of its own; StageError where one cannot be fetched."""
    from stages.estimators import assets
    from stages.formats.film_pixels import patch_off

    body = Path(assets.__file__).with_name("free_body.npz")
    job.emit({"event": "model", "name": "free body", "here": body.is_file(), "why": "ships with hugs"})
    off = patch_off()
    job.emit(
        {"event": "model", "name": "film colours", "here": off <= SAME, "why": f"{off} of 255 off in a tagged patch"}
    )
    for name, asset in assets.ASSETS.items():
        if params.fetch and not assets.present(name):
            assets.fetch(name, job.note)
        job.emit({"event": "model", "name": name, "here": assets.present(name), "why": asset.why})
