"""Runs the stages that no pipeline names: in this process, without the cache. How errors without a stage's own words are said."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hugs_cli.cache import child
from stages.contract import Job, StageError, load_stage


class StageFailed(StageError):
    """A stage or a command ended without a result: exit code 1. `traceback` is filled if the cause is a bug."""

    traceback: str = ""


def run_directly(module: str, job: Job, settings: Mapping[str, Any] | None = None, **inputs: Any) -> None:
    """Run the stage in `module` with `settings`, and the defaults for the rest; StageError, whatever goes wrong in it."""
    stage = load_stage(module)
    try:
        stage.run(job, stage.params(**(settings or {})), **inputs)
    except Exception as error:
        raise in_words(error, module.rpartition(".")[2]) from error


def in_words(error: Exception, what: str) -> StageError:
    """Any error that ends `what`, as one that can be shown."""
    return error if isinstance(error, StageError) else failed(child.error_event(error, ""), what, "what stands above")


def failed(event: Mapping[str, Any], what: str, report: str) -> StageFailed:
    """The error that a child's event stands for; a bug is to be reported with `report`."""
    if event["event"] == "error":
        return StageFailed(event["problem"], event["hint"], event["facts"])
    hint = f"this is a fault in hugs, not in your clip; please report it with {report}"
    error = StageFailed(f"{what} has a bug: {event['problem']}", hint)
    error.traceback = event.get("traceback", "")
    return error
