"""How much longer it takes to pose a person because their clothes have bones: the same person with and without, in turns.

    python -m tests.benchmarks.posing work/clip/default/train/avatar.npz [--poses 120] [--json out.json]

Without, what each bone of the clothes moves goes with the skeleton's bones that carry it. Poses are by chance; a pose by
itself and all as one motion, milliseconds a pose on one thread, no picture is drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from stages import records
from stages.avatar.drawing.avatar import PosedAvatar, load_avatar, pose_avatar
from stages.formats.splats import read_avatar
from tests.benchmarks.host import clock, summary, tell, use_threads

ROUNDS = 7  # of both, in turns; the first warms up


def undressed(avatar: records.Avatar) -> records.Avatar:
    """The same Gaussians on the skeleton alone."""
    weights, count = avatar.lbs_weights, len(avatar.joints)
    assert avatar.clothes is not None
    own = weights[:, count:] @ avatar.clothes.carriers
    return replace(avatar, lbs_weights=weights[:, :count] + own, clothes=None)


def in_motion(who: PosedAvatar) -> None:
    """Pose somebody as in each frame of a motion, whose bones are found at once."""
    for i in range(len(who.transl)):
        who.splats(i)


def measure(avatar: records.Avatar, poses: int) -> dict[str, object]:
    """Milliseconds a pose, and how many times as long it takes with bones of clothes."""
    use_threads(1)
    both, rng = {"with": load_avatar(avatar), "without": load_avatar(undressed(avatar))}, np.random.default_rng(0)
    parts = [torch.as_tensor(rng.normal(0, 0.3, (poses, size))).float() for size in (3, 69, 3)]
    single: dict[str, list[float]] = {name: [] for name in both}
    motion: dict[str, list[float]] = {name: [] for name in both}
    for turn in range(ROUNDS):
        for name, one in both.items():
            alone = [clock(lambda i=i, one=one: pose_avatar(one, *(part[i] for part in parts))) for i in range(poses)]
            whole = clock(lambda one=one: in_motion(PosedAvatar(one, *parts))) / poses
            if turn:
                single[name] += alone
                motion[name].append(whole)
    found: dict[str, object] = {"gaussians": len(avatar), "bones": len(avatar.clothes)}
    for kind, times in (("a pose by itself", single), ("a motion", motion)):
        told = {name: summary(values) for name, values in times.items()}
        found[kind] = told | {"ratio": told["with"]["median"] / told["without"]["median"]}
    return found


def main() -> None:
    """Print the times; write them as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--poses", type=int, default=120)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    avatar = read_avatar(asked.avatar)
    if avatar.clothes is None:
        parser.error(f"nobody in {asked.avatar} wears clothes that have bones")
    tell(measure(avatar, asked.poses), asked.json)


if __name__ == "__main__":
    main()
