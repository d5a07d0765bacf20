"""How landmarks of another program lie to BlazePose's of the same pictures: what was turned, scaled or exchanged shows there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.contract import StageError
from stages.formats.landmarks import MIRRORED, NAMES
from stages.records import SeenLandmarks

SURE = 0.5
LEAST = 5  # frames that both show, from which on they are compared
OFF = 0.1  # of the person's height, by the median of the points: farther, it is somebody else or another moment
ASTRAY = 0.15  # the same of one point: it is another point of the body
EXCHANGED = 0.8  # share of the distance with sides as given under which they are exchanged
SAME, ALIKE = 0.05, 0.2  # share by which a scale may differ from 1, and the scale of one axis from the other's
SHIFT = 0.04  # of the height
SIDES = tuple(
    int(side)
    for side in "256 320 360 384 426 480 512 540 568 576 600 640 720 768 800 848 854 864 896 960 1024 1080 1152 1200 1280 "
    "1344 1440 1536 1600 1792 1920 2048 2160 2304 2560 2704 2880 3072 3200 3840 4096 5120 7680".split()
)
"""Longer sides that pictures have, in px."""


@dataclass(frozen=True)
class Agreement:
    """`xy * scale + shift` lies `off` of the person's height from BlazePose's in `frames` frames, with sides `swapped` or not."""

    scale: np.ndarray
    shift: np.ndarray
    swapped: bool
    off: float
    frames: int


def compare(
    xy: np.ndarray, confidence: np.ndarray, seen: np.ndarray, visibility: np.ndarray, height: np.ndarray
) -> Agreement | None:
    """Scale and shift of each axis that bring `xy` [F,33,2] px nearest to what BlazePose has `seen` [F,33,2] px (NaN: nobody),
    which makes the person `height` [F] px tall; None where fewer than LEAST frames have both."""
    found = []
    for swapped in (False, True):
        order = MIRRORED if swapped else np.arange(len(NAMES))
        both = np.isfinite(xy[:, order]).all(-1) & np.isfinite(seen).all(-1)
        both &= (confidence[:, order] >= SURE) & (visibility >= SURE)
        frames = np.flatnonzero(both.sum(1) >= LEAST)
        if len(frames) < LEAST:
            return None
        g, p = xy[:, order][both], seen[both]
        ranges = [np.diff(np.percentile(part, (10, 90), axis=0), axis=0)[0] for part in (g, p)]
        sign = [np.sign(np.corrcoef(g[:, k], p[:, k])[0, 1]) or 1.0 for k in (0, 1)]
        scale = np.array(sign) * ranges[1] / np.maximum(ranges[0], 1e-9)
        shift = np.median(p - g * scale, axis=0)
        gap = np.linalg.norm(xy[:, order] * scale + shift - seen, axis=-1) / height[:, None]
        off = float(np.median([np.median(gap[i, both[i]]) for i in frames]))
        found.append(Agreement(scale, shift, swapped, off, len(frames)))
    return found[1] if found[1].off < EXCHANGED * found[0].off else found[0]


def correction(
    found: Agreement, size: tuple[int, int], height: float, name: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Exact scale and shift of a plain mistake that explains what was `found` in pictures of `size` px, and words for it.

    y up, a mirrored picture, exchanged sides, or pictures of another size. StageError for anything else.
    """
    facts = [
        f"after the best scale and shift they lie {100 * found.off:.0f} % of the person's height from the person, "
        f"in {found.frames} frames",
        f"x = {found.scale[0]:.2f} x {found.shift[0]:+.0f}, y = {found.scale[1]:.2f} y {found.shift[1]:+.0f}, "
        f"px of {size[0]}x{size[1]}",
    ]
    hint = "let the network run on this very video, whole and upright; or leave out --landmarks"
    if found.off > OFF:
        raise StageError(f"the landmarks of {name} are not where the person is", hint, facts)
    sign, each = np.sign(found.scale), np.abs(found.scale)
    whole, words = float(each[1]), []
    if abs(each[0] / whole - 1) > ALIKE:
        raise StageError(f"the landmarks of {name} are of pictures of another shape", hint, facts)
    if abs(whole - 1) > SAME:
        longer = max(size) / whole
        near = min(SIDES, key=lambda side: abs(side / longer - 1))
        whole = max(size) / near if abs(near / longer - 1) < SAME / 2 else whole
        words.append(f"are of pictures {max(size) / whole:.0f} px long: scaled by {whole:.3g}")
    else:
        whole = 1.0
    if sign[1] < 0:
        words.append("have y going up: turned about")
    if sign[0] < 0:
        words.append("are of mirrored pictures: turned about")
    if found.swapped:
        words.append("have left and right exchanged in all frames: exchanged back")
    expected = np.where(sign < 0, size, 0)
    if (np.abs(found.shift - expected) > SHIFT * height + SAME * np.array(size) * (each != 1)).any():
        raise StageError(f"the landmarks of {name} are shifted: their pictures were cut or padded", hint, facts)
    return sign * whole, expected.astype(float), words


def astray(
    xy: np.ndarray, confidence: np.ndarray, seen: np.ndarray, visibility: np.ndarray, height: np.ndarray
) -> list[int]:
    """Points of the 33 that lie, by the median over the frames, ASTRAY of the height from where BlazePose has them."""
    sure = np.isfinite(xy).all(-1) & np.isfinite(seen).all(-1) & (confidence >= SURE) & (visibility >= SURE)
    gap = np.linalg.norm(xy - seen, axis=-1) / height[:, None]
    return [k for k in range(len(NAMES)) if sure[:, k].sum() >= LEAST and np.median(gap[sure[:, k], k]) > ASTRAY]


def turned(
    world: np.ndarray, confidence: np.ndarray, tracks: Sequence[SeenLandmarks | None], viewmats: np.ndarray
) -> tuple[np.ndarray, str]:
    """The 3D landmarks `world` [F,33,3] in each camera's axes, about as large as BlazePose's, and a word where they had others.

    Kept as they are where that is as near to BlazePose's as any turn or mirroring, the same in each of the cameras or in the
    world of `viewmats` [F,4,4] (Kabsch 1976). StageError where fewer than LEAST frames can be compared.
    """
    theirs = np.stack(
        [np.full((len(NAMES), 3), np.nan) if t is None else np.asarray(t.world, np.float64) for t in tracks]
    )
    sure = np.isfinite(world).all(-1) & np.isfinite(theirs).all(-1) & (confidence >= SURE)
    frames = np.flatnonzero(sure.sum(1) >= LEAST)
    if len(frames) < LEAST:
        fact = f"{len(frames)} frames show a person and have 3D landmarks"
        raise StageError("the axes of the 3D landmarks cannot be found", "give landmarks with 2D", [fact])
    ours = np.full_like(world, np.nan)
    a, b, turns = [], [], []
    for i in frames:
        ours[i] = world[i] - world[i, sure[i]].mean(0)
        a.append(ours[i, sure[i]])
        b.append(theirs[i, sure[i]] - theirs[i, sure[i]].mean(0))
        turns += [viewmats[i, :3, :3]] * int(sure[i].sum())
    one, two, turn = np.concatenate(a), np.concatenate(b), np.stack(turns)
    in_world = (two[:, None] @ turn)[:, 0]
    fitted = [np.eye(3), _nearest_turn(one, two), _nearest_turn(one, in_world)]
    gaps = [np.linalg.norm(_scaled(one @ r.T, target) - target) for r, target in zip(fitted, (two, two, in_world))]
    best = 0 if gaps[0] < 1.15 * min(gaps) else int(np.argmin(gaps[1:])) + 1
    each = np.broadcast_to(fitted[best], (len(world), 3, 3)) if best < 2 else viewmats[:, :3, :3] @ fitted[2]
    found = world @ each.transpose(0, 2, 1)
    found *= (two * two).sum() ** 0.5 / max((one * one).sum() ** 0.5, 1e-9)
    mirrored = np.linalg.det(fitted[best]) < 0
    said = ["", "the axes of each camera, turned", "axes of a world of their own"][best] + (
        ", mirrored" if mirrored else ""
    )
    return found, said


def _nearest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The orthogonal matrix that brings points [N,3] nearest to others."""
    u, _, vt = np.linalg.svd(b.T @ a)
    return u @ vt


def _scaled(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a * ((a * b).sum() / max((a * a).sum(), 1e-9))
