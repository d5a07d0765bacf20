"""Cast shadow: does the floor darken where the body would take the light of some lamp?"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from stages.avatar.body.joints import ANKLES, HEAD
from stages.avatar.cameras.pinhole import project
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.pictures import background_mask, brightness, sample

DARKNESS = 0.08  # share of the light that is taken
LIKENESS = 0.15  # least correlation of predicted shadow and measured darkness
UNIT = "of the floor's light taken"
REACH, STEP = 1.7, 0.04  # m: how far from the person the floor is looked at, and how finely
LEAST = 8  # frames that must see a spot of the floor
TILTS, TURNS = np.radians([0, 12, 24, 36, 48, 60]), np.arange(16) * np.pi / 8  # lamps that are tried
LOW = 0.3  # of its correlation that a lamp at the last of TILTS loses: of two that explain as much, the higher one is likelier
EVERY = 2  # vertex of the body: dense enough for the grid
LARGEST = 1.0  # log brightness: more than this is something else that hides the floor


def detect(evidence: ClipEvidence) -> Finding:
    """How much of the best-fitting lamp's light the body takes from the floor.

    Spots of the floor are compared with themselves in other frames only, so its pattern does not matter. Tried are lamps
    in all directions, of which low ones are less likely; the shadow of each is the body laid down on the floor along its light.
    Where the mask is empty nobody takes any: bodies there are only filled in.
    """
    floor = _FloorPatch(evidence)
    logs = np.stack([floor.logs(evidence, i) for i in evidence.sampled])
    spots = np.isfinite(logs).sum(0) >= LEAST
    if spots.sum() < 100:
        return unmeasured(UNIT, DARKNESS, "too little of the floor is seen around the person")
    logs = logs[:, spots]
    light = (logs - np.nanmedian(logs, 0)).clip(-LARGEST, LARGEST)
    there = [bool((evidence.clip.mask(i) > 127).any()) for i in evidence.sampled]
    bodies = [body[::EVERY] if seen else body[:0] for body, seen in zip(evidence.bodies, there, strict=True)]

    def try_lamp(tilt: float, turn: float) -> tuple[float, float, np.ndarray, tuple[float, float]]:
        shadow = np.stack([floor.shadow(body, tilt, turn)[spots] for body in bodies])
        return *_correlate(light, shadow), (tilt, turn)

    def cost(found: tuple[float, float, np.ndarray, tuple[float, float]]) -> float:
        return _cost(found[0], found[-1][0])

    best = min((try_lamp(tilt, turn) for tilt in TILTS for turn in (TURNS if tilt else TURNS[:1])), key=cost)
    for share in (0.5, 0.25):
        tilt, turn = best[-1]
        near = [(tilt + share * a * TILTS[1], turn + share * b * TURNS[1]) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        best = min([best, *(try_lamp(*lamp) for lamp in near if lamp != best[-1])], key=cost)
    likeness, slope, seen, lamp = best
    strength = np.full(len(evidence.clip.names), np.nan)
    strength[evidence.sampled] = seen
    taken = max(float(1 - np.exp(slope)), 0.0)
    found = compare(taken, UNIT, DARKNESS, ("darkens the floor", "none"),
                  strongest_frames(evidence.clip.names, strength), -likeness > LIKENESS)  # fmt: skip
    return replace(found, start=(*floor.direction_to(*lamp).tolist(), taken))


def _cost(likeness: float, tilt: float) -> float:
    """The correlation of a lamp `tilt` rad from overhead, which is best at -1, worse by LOW for low ones."""
    return likeness * (1 - LOW * tilt / float(TILTS[-1]))


def _correlate(light: np.ndarray, shadow: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Correlation and slope of `light` [F,P] (NaN: not seen) by `shadow` [F,P] within each spot; darkness of frames [F]."""
    known = np.isfinite(light)
    count = known.sum(0)

    def center_rows(values: np.ndarray) -> np.ndarray:
        values = np.where(known, values, 0.0)
        return np.where(known, values - values.sum(0) / count, 0.0)

    x, y = center_rows(shadow.astype(float)), center_rows(light)
    spread = (x**2).sum()
    if spread < 1e-9:
        return 0.0, 0.0, np.zeros(len(light))
    return float((x * y).sum() / np.sqrt(spread * (y**2).sum() + 1e-12)), float((x * y).sum() / spread), -(x * y).sum(1)


class _FloorPatch:
    """A patch of the floor around the person: spots on a grid, and axes `right`, `ahead`, `up`."""

    def __init__(self, evidence: ClipEvidence):
        bodies, model = evidence.bodies, evidence.clip.body_model
        joints = np.einsum("jv,fvk->fjk", model.J_regressor, bodies)
        up = (joints[:, HEAD] - joints[:, ANKLES].mean(1)).mean(0)
        self.up = up / np.linalg.norm(up)
        self.level = float(np.median((bodies @ self.up).min(1)))
        self.right = np.cross(self.up, np.eye(3)[np.abs(self.up).argmin()])
        self.right /= np.linalg.norm(self.right)
        self.ahead = np.cross(self.up, self.right)
        self.middle = np.median(joints[:, 0] @ np.stack([self.right, self.ahead], 1), 0)
        self.side = round(2 * REACH / STEP)
        at = (np.arange(self.side) + 0.5) * STEP - REACH
        a, b = np.meshgrid(at + self.middle[0], at + self.middle[1], indexing="ij")
        self.spots = (a[..., None] * self.right + b[..., None] * self.ahead + self.level * self.up).reshape(-1, 3)

    def logs(self, evidence: ClipEvidence, i: int) -> np.ndarray:
        """Log brightness of the spots [P] in frame `i`, its gain taken off; NaN where the floor is not seen."""
        clip = evidence.clip
        pixels, z = project(self.spots, clip.viewmats[i], clip.Ks[i])
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [clip.width, clip.height]).all(1)
        grey, free = brightness(clip.images(i)), background_mask(clip.mask(i))
        pixels = np.where(inside[:, None], pixels, 0)
        value = sample(grey, pixels)
        inside &= free[tuple(pixels.astype(int).T[::-1])]
        gain = evidence.gains[i]
        return np.where(inside & (value > 4), np.log(np.maximum(value, 1)), np.nan) - (gain if np.isfinite(gain) else 0)

    def direction_to(self, tilt: float, turn: float) -> np.ndarray:
        """The direction [3] to a lamp `tilt` rad from overhead, towards `turn`; of length 1."""
        level = np.cos(turn) * self.right + np.sin(turn) * self.ahead
        return np.cos(tilt) * self.up + np.sin(tilt) * level

    def shadow(self, body: np.ndarray, tilt: float, turn: float) -> np.ndarray:
        """bool [P]: the spots that a body [V,3] hides from a lamp `tilt` rad from overhead, towards `turn`."""
        height = (body @ self.up - self.level).clip(0)
        along = np.tan(tilt) * np.array([np.cos(turn), np.sin(turn)])
        flat = body @ np.stack([self.right, self.ahead], 1) - self.middle - height[:, None] * along
        cell = np.floor((flat + REACH) / STEP).astype(int)
        cell = cell[((cell >= 0) & (cell < self.side)).all(1)]
        covered = np.zeros((self.side, self.side), np.uint8)
        covered[cell[:, 0], cell[:, 1]] = 1
        return cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).ravel() > 0
