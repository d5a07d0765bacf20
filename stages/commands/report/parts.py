"""Which part of the report comes from which stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stages.commands.report import clip, results
from stages.contract import StageError, StageRecord

Folders = Mapping[str, Path]
Part = Mapping[str, Any]
PARTS: dict[str, tuple[tuple[str, ...], Callable[..., Part]]] = {
    "frames": (("frames",), clip.frames),
    "masks": (("frames", "masks"), clip.outlines),
    "sfm": (("sfm",), clip.cameras),
    "smpl": (("sfm", "smpl"), clip.body),
    "survey": (("survey",), results.measured),
    "train": (("train",), results.training),
    "gained": (("survey", "train"), results.effects),
    "export": (("export",), results.files),
    "render": (("sfm", "render"), results.films),
    "evaluate": (("frames", "sfm", "evaluate"), results.accuracy),
}
"""Name -> the stages whose results it shows, and what makes it: values of the template by name."""
EMPTY: dict[str, Any] = dict.fromkeys(
    "size sheet outlines map overlays rungs mapper measures scene effects live curve parts files viewer films headline gaussians "
    "accuracy comparisons protocol beside_paper compared".split()
)
"""The values of parts that are not there yet."""


def parts_of(
    done: Folders,
    begun: Folders,
    records: Mapping[str, StageRecord],
    known: dict[tuple[str, str], Any],
) -> tuple[dict[str, Any], list[StageError]]:
    """The template's values from finished stages, and from a training that is `begun`; and why some could not be made."""
    values, trouble = dict(EMPTY), []
    for name, (needs, make) in PARTS.items():
        if not set(needs) <= set(done):
            continue
        key = name, " ".join(str(done[need]) for need in needs)
        try:
            if key not in known:
                known[key] = make(**{need: done[need] for need in needs})
            values |= known[key]
        except StageError as error:
            trouble.append(error)
    try:
        values |= results.so_far(begun["train"], known) if "train" in begun else {}
    except StageError as error:  # it may just have ended, and its folder has another name
        trouble.append(error)
    return values | {"times": results.stage_times(records)}, trouble
