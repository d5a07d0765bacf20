"""Runs the stages that no pipeline names: in this process, without the cache."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.contract import Job, load_stage


def run_directly(module: str, job: Job, settings: Mapping[str, Any] | None = None, **inputs: Any) -> None:
    """Run the stage in `module` with `settings`, and the defaults for the rest."""
    stage = load_stage(module)
    stage.run(job, stage.params(**(settings or {})), **inputs)
