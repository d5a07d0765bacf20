"""What a finished training leaves in a folder."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.contract import whole
from stages.formats.cameras import write_cameras
from stages.formats.effects import write_effects
from stages.formats.people import folder_of
from stages.formats.poses import write_poses
from stages.formats.splats import write_splats
from stages.training.results import Result
from stages.training.run import COLUMNS


def write(out: Path, result: Result) -> None:
    """Write avatar.npz, scene.npz, body.npz, curve.csv and train.json; effects.npz and cameras.npz where learned.

    Those of further people are in people/2 and so on.
    """
    for person, (avatar, body) in enumerate(result.people, 1):
        folder = folder_of(out, person)
        folder.mkdir(parents=True, exist_ok=True)
        write_splats(folder / "avatar.npz", avatar)
        write_poses(folder / "body.npz", body)
    if result.scene is not None:
        write_splats(out / "scene.npz", result.scene)
    if result.effects is not None:
        write_effects(out / "effects.npz", result.effects)
    if result.cameras is not None:
        write_cameras(out / "cameras.npz", result.cameras)
    write_curve(out, result.curve)
    (out / "train.json").write_text(json.dumps(result.facts, indent=1))


def write_curve(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write curve.csv: rows of `stages.training.run.COLUMNS`."""
    with whole(out / "curve.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
