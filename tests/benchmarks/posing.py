"""How long it takes to pose a person: many poses at once beside one by one, and with bones of clothes beside without.

    python -m tests.benchmarks.posing work/clip/default/train/avatar.npz [--poses 120] [--json out.json]

Without, what each bone of the clothes moves goes with the skeleton's bones that carry it. Poses are by chance; a pose by
itself, all as one motion, and 64 at once, milliseconds a pose on one thread, in turns, no picture is drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from hugs.avatar import Avatar
from stages import records
from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
from stages.formats.splats import read_avatar
from tests.benchmarks.host import clock, summary, tell, use_threads
from tests.made.learned import pose_avatar

AT_ONCE = 64  # poses
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


def at_once(avatar: records.Avatar, poses: int = AT_ONCE) -> dict[str, object]:
    """Milliseconds a pose of as many at once and of each by itself, as Python asks for them, and the ratio of both."""
    use_threads(1)
    who, rng = Avatar(avatar, load_avatar(avatar)), np.random.default_rng(0)
    rows = [rng.normal(0, 0.3, (poses, size)) for size in (69, 3, 3)]
    single: list[float] = []
    together: list[float] = []
    for turn in range(ROUNDS):
        alone = clock(lambda: [who.pose(*(part[i] for part in rows)).sets for i in range(poses)]) / poses
        whole = clock(lambda: who.pose(*rows).sets) / poses
        if turn:
            single.append(alone)
            together.append(whole)
    told = {"by itself": summary(single), "at once": summary(together)}
    return told | {"poses": poses, "ratio": told["at once"]["median"] / told["by itself"]["median"]}


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
    clothes = {} if avatar.clothes is None else measure(avatar, asked.poses)
    tell({"gaussians": len(avatar), "many at once": at_once(avatar), **clothes}, asked.json)


if __name__ == "__main__":
    main()
