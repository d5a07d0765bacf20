"""Two people who cross, learned together, against each learned alone with the other masked away; and what more people cost.

    python -m tests.benchmarks.people cross WORK [--seeds 7 8] [--steps 1000] [--shadow 0] [--json out.json]
    python -m tests.benchmarks.people follow [--seeds 7 8] [--json out.json]
    python -m tests.benchmarks.people memory [--people 1 2 3 4] [--json out.json]

`cross` trains with true inputs (tests/made/pair.py) and asks frames that were not trained on: each avatar, drawn alone over
white, against that person as if the other were not there; the whole picture beside the people; and the empty scene against the
empty room. Alone means the same loss with the other's pixels left out, of the person and of the scene. `follow` asks whether
the built-in tracker exchanges the two: whose true mask the mask of each covers, frame by frame. `memory` takes a few steps of a
default training of a 960x540 clip with so many people, and tells the most memory that the process had.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages import train
from stages.avatar.drawing.cast import Moment
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.rasterize import Camera, Layer
from stages.contract import Job, peak_memory
from stages.formats.clip import load_people
from stages.formats.images import write_image
from stages.masks import apart
from stages.training.beginning.start import Task, build
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from tests.benchmarks.host import tell
from tests.made.pair import Pair, make_pair, write_stages
from tests.made.truth import psnr

PARAMS = {"human_points": 7_000, "human_cap": 10_000, "scene_cap": 25_000, "scene_fill": 12_000}
SIZE = {"width": 320, "height": 180, "frames": 30}
SMALL = {"width": 192, "height": 108, "frames": 15}
SMALL_PARAMS = {"human_cap": 8_000, "scene_cap": 8_000, "scene_fill": 4_000}


def trainings(folders: dict[str, Path], steps: int, seed: int, decisions: dict[str, bool]) -> Iterator[tuple[str, Fit]]:
    """The training of both, and of each with the other masked away; none has begun."""
    people = load_people(folders["sfm"], folders["smpl"])
    params = train.Params(steps=steps, **PARAMS)
    for name in ("both", "first", "second"):
        fit = build(Task(people, params, decisions, {}, seed), lambda text: None)
        yield name, fit if name == "both" else only(fit, name == "second", seed)


def only(fit: Fit, second: bool, seed: int) -> Fit:
    """The training of one of two people, in which the other's pixels teach nobody."""
    who = fit.people[int(second)]
    models = fit.full, fit.train, [Starting(who.body, who.human, who.outline)], fit.scene, fit.params, fit.options
    return Fit(*models, torch.Generator().manual_seed(seed), effects=FrameEffects(fit.effects.shadow))


@torch.no_grad()
def asked(fit: Fit, pair: Pair, whom: Sequence[int], frames: list[int], folder: Path) -> dict[str, Any]:
    """Of each of `whom` the mean PSNR dB in `frames`; of the picture beside people; and of the empty scene."""
    found: dict[str, list[float]] = {}
    cast = fit.cast()
    for i in frames:
        height, width = pair.views[0].masks.shape[1:]
        camera = Camera(fit.full.viewmats[i], fit.full.Ks[i], width, height)
        free = np.maximum(*(one.masks[i] for one in pair.views)) == 0
        moment = cast.at(i, cast.people)
        for k, one in zip(whom, moment.people, strict=True):
            (drawn,) = Moment([one]).draw(camera, [Layer(background=torch.ones(3))])
            rows, columns = (np.flatnonzero(pair.whole[k, i].any(axis)) for axis in (1, 0))
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            shown = bytes_of(drawn.image)
            found.setdefault(f"person {k + 1}", []).append(psnr(shown[box], pair.alone[k, i][box]))
            write_image(folder / f"{i:06d}_person{k + 1}.png", np.concatenate([pair.alone[k, i], shown], 1))
        whole = bytes_of(Moment((), moment.scene).draw(camera)[0].image)
        empty = bytes_of(Moment((), cast.scene).draw(camera)[0].image)
        found.setdefault("beside people", []).append(psnr(whole[free], pair.views[0].images[i][free]))
        found.setdefault("empty room", []).append(psnr(empty, pair.rooms[i]))
        write_image(folder / f"{i:06d}_room.png", np.concatenate([pair.views[0].images[i], empty], 1))
    return {name: float(np.mean(values)) for name, values in found.items()}


def bytes_of(image: torch.Tensor) -> np.ndarray:
    return np.rint(255 * image.clamp(0, 1).numpy()).astype(np.uint8)


def cross(work: Path, seeds: list[int], steps: int, shadow: float) -> list[dict[str, Any]]:
    rows = []
    for seed in seeds:
        pair, place = make_pair(seed=seed, shadow=shadow, **SIZE), work / f"seed{seed}_{shadow:g}"
        folders = write_stages(pair, place)
        decisions = {"pose_refinement": False, "shadow": shadow > 0}
        heldout = [i for i in range(len(pair.views[0])) if load_people(folders["sfm"], folders["smpl"])[0].heldout[i]]
        row: dict[str, Any] = {"seed": seed}
        for name, fit in trainings(folders, steps, seed, decisions):
            while fit.progress.step < steps:
                fit.advance()
            (place / name).mkdir()
            row[name] = asked(fit, pair, {"both": [0, 1], "first": [0], "second": [1]}[name], heldout, place / name)
            print(json.dumps({"seed": seed, name: row[name]}), flush=True)
        row["loses"] = {
            "person 1": row["first"]["person 1"] - row["both"]["person 1"],
            "person 2": row["second"]["person 2"] - row["both"]["person 2"],
            "beside people": max(row[one]["beside people"] for one in ("first", "second"))
            - row["both"]["beside people"],
            "empty room": max(row[one]["empty room"] for one in ("first", "second")) - row["both"]["empty room"],
        }
        rows.append(row)
    return rows


def follow(seeds: list[int]) -> list[dict[str, Any]]:
    """How often each identity covers whom, and how much of the true mask."""
    from stages.estimators.person.blazepose import BlazePose
    from stages.estimators.person.identities import follow_everybody
    from stages.estimators.person.outline import outline
    from stages.estimators.person.sightings import everybody

    network, rows = BlazePose(), []
    for seed in seeds:
        pair, said = make_pair(seed=seed, width=640, height=360), []
        images, names = list(pair.views[0].images), [f"{i:06d}" for i in range(len(pair.views[0]))]
        job = Job(Path(), emit=lambda event, said=said: said.append(event.get("text", "")))
        people = everybody(job, network, images)
        row: dict[str, Any] = {"seed": seed, "seen": len(people), "of": len(names)}
        if len(people) > 1:
            tracks = follow_everybody(job, network, images, names, people)
            covers = np.full((len(people), len(names)), -1)
            for i in range(len(names)):
                drawn = [
                    np.zeros(images[i].shape[:2], np.float32)
                    if t[i] is None
                    else outline(network, images[i], t[i].next_roi)
                    for t in tracks
                ]
                _, own = apart([np.rint(255 * one).astype(np.uint8) for one in drawn])
                for k, mask in enumerate(own):
                    hits = [((mask > 127) & (one.masks[i] > 127)).sum() for one in pair.views]
                    if max(hits) > 0:
                        covers[k, i] = int(np.argmax(hits))
            first = [int(np.bincount(one[one >= 0], minlength=1).argmax()) for one in covers]
            for k, who in enumerate(first):
                row[f"identity {k + 1}"] = {
                    "covers person": who + 1,
                    "in": int((covers[k] == who).sum()),
                    "another in": int(((covers[k] >= 0) & (covers[k] != who)).sum()),
                    "not seen in": int((covers[k] < 0).sum()),
                }
        rows.append(row | {"said": said})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def memory(people: list[int]) -> list[dict[str, Any]]:
    """A process for each, since memory is never given back."""
    rows = []
    for count in people:
        command = [sys.executable, "-m", "tests.benchmarks.people", "steps", "--people", str(count)]
        rows.append(
            json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def steps_of(count: int) -> dict[str, Any]:
    """A few steps, at the sizes that default trainings end with, of a clip that repeats two people."""
    import tempfile
    import time
    from dataclasses import replace

    pair = make_pair(width=960, height=540, frames=10)
    with tempfile.TemporaryDirectory() as folder:
        folders = write_stages(pair, Path(folder))
        two = load_people(folders["sfm"], folders["smpl"])
        clips = [replace(two[k % 2], person=1 + k % 2, alone=False) for k in range(count)]
        fit = build(Task(clips, train.Params(), {"pose_refinement": True}), lambda text: None)
    before = peak_memory()
    fit.half_until = 0.0
    fit.densifier.fill_up(fit.adam)
    began = time.perf_counter()
    for _ in range(8):
        fit.advance()
    seconds = (time.perf_counter() - began) / 8
    return {
        "people": count,
        "gaussians": fit.sizes(),
        "MiB": peak_memory() / 2**20,
        "MiB before": before / 2**20,
        "s a step": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["cross", "follow", "memory", "steps"])
    parser.add_argument("work", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, nargs="+", default=[7, 8])
    parser.add_argument("--people", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--shadow", type=float, default=0.0)
    parser.add_argument("--small", action="store_true", help="192x108, 15 frames")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.what == "steps":
        print(json.dumps(steps_of(given.people[0])))
        return
    if given.small:
        SIZE.update(SMALL)
        PARAMS.update(SMALL_PARAMS)
    if given.what == "cross" and given.work is None:
        parser.error("cross needs a WORK folder")
    rows = {
        "cross": lambda: cross(given.work, given.seeds, given.steps, given.shadow),
        "follow": lambda: follow(given.seeds),
        "memory": lambda: memory(given.people),
    }[given.what]()
    tell({"rows": rows}, given.json)


if __name__ == "__main__":
    main()
