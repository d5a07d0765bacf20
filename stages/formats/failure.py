"""failure.npz: the state of a training that broke down, to repeat its last step."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npz, take
from stages.formats.facts import Facts, NotJson, Whole, parse

HINT = "give the failure.npz that the train stage wrote when it broke down"


class Failure(Facts):
    """The facts of the run that failed; `params` are its settings, `sfm`, `smpl` and `survey` its folders.

    `decisions` are those by which it trained: a training that has little time leaves out what `survey` found.
    """

    error: str
    step: Whole
    seed: Whole
    device: str
    threads: Whole
    params: dict[str, Any]
    decisions: dict[str, bool]
    sfm: str
    smpl: str
    survey: str


def write_failure(path: Path, state: bytes, facts: dict[str, Any]) -> None:
    """Write `failure.npz`, without pickles: the training's `state` as torch saves it, and `facts` of the run as JSON."""
    np.savez(path, state=np.frombuffer(state, np.uint8), facts=json.dumps(facts))


def read_failure(path: Path) -> tuple[bytes, Failure]:
    """The state and the facts that `write_failure` wrote; StageError for another kind of file."""
    arrays = read_npz(path, HINT)
    state, facts = (take(arrays, key, path, HINT) for key in ("state", "facts"))
    try:
        failure = parse(str(facts), Failure)
        if state.dtype != np.uint8:
            raise ValueError(f"state is {state.dtype}, not bytes")
    except NotJson as error:
        raise StageError(f"facts in {path} are not JSON", HINT, [str(error)]) from error
    except ValueError as error:
        raise StageError(f"{path} is not what training leaves", HINT, [str(error)]) from error
    return state.tobytes(), failure
