"""failure.npz: what a training that broke down leaves, so that its last step can be taken again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npz, take
from stages.formats.facts import mismatch

HINT = "give the failure.npz that the train stage wrote when it broke down"
FACTS = {"error": str, "step": int, "seed": int, "device": str, "threads": int, "params": {}}
FACTS |= dict.fromkeys(("sfm", "smpl", "survey"), str)
"""What is taken from the facts."""


def write_failure(path: Path, state: bytes, facts: dict[str, Any]) -> None:
    """Write `failure.npz`, without pickles: the training's `state` as torch saves it, and `facts` of the run as JSON."""
    np.savez(path, state=np.frombuffer(state, np.uint8), facts=json.dumps(facts))


def read_failure(path: Path) -> tuple[bytes, dict[str, Any]]:
    """The state and the facts that `write_failure` wrote; StageError for another kind of file."""
    arrays = read_npz(path, HINT)
    state, facts = (take(arrays, key, path, HINT) for key in ("state", "facts"))
    try:
        found = json.loads(str(facts))
    except (ValueError, RecursionError) as error:
        raise StageError(f"facts in {path} are no JSON", HINT, [str(error)]) from error
    wrong = mismatch(found, FACTS, "") or ("" if state.dtype == np.uint8 else f"state is {state.dtype}, not bytes")
    if wrong:
        raise StageError(f"{path} is not what training leaves", HINT, [wrong])
    return state.tobytes(), found
