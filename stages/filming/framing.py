"""How a film's cameras show its people: what is cut off, whose backs are seen; and the still camera that shows them best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stages.avatar.body.joints import FEET, HEAD, HIPS, SHOULDERS
from stages.avatar.cameras.pinhole import camera_centers, look_at, pinhole
from stages.avatar.rasterize import Camera
from stages.filming.cameras import AUTO, CROWN, cameras_of, crowd
from stages.filming.cast import Actor
from stages.filming.setting import Setting
from stages.formats.images import evenly

EVERY = 0.2  # s between the pictures that are looked at
FRAMES = 15  # of the clip that may be the camera
SAID, CUT, BACKS = 0.05, 0.25, 0.6  # of the pictures: more is said, and in how many cuts, and backs, are too much
SOLE = 0.06  # m under a foot's joint
MARGIN, TURNS = 1.15, 4  # times as much as people need, and how often the camera is turned to them anew
WIDEST = 0.45  # of the longer side, the shortest focal length: 96 degrees
NEAR = 0.1  # m from the camera
Size = tuple[int, int] | None


class Framing(NamedTuple):
    """Shares of the pictures in which a camera cuts off somebody's `head`, their `feet`, leaves them out altogether (`gone`), and
    sees their `back`.
    """

    head: float
    feet: float
    gone: float
    back: float

    @property
    def cut(self) -> float:
        """The share of pictures in which they are not whole, at least."""
        return self.gone + max(self.head, self.feet)


def framed(
    kind: str, count: int, fps: float, size: Size, setting: Setting, cast: Sequence[Actor]
) -> tuple[list[Camera], str]:
    """The cameras of a film as `cameras_of`, and, of the kind `auto`, which they are, in words.

    auto: a still camera, that of the clip's middle frame, or of the one that cuts off least, if it shows people whole, or there a
    wider one that does; where all frames see backs in most of the motion, and where there is no clip, as `before`.
    """
    stage = count, fps, size, setting, cast
    if kind != AUTO:
        return cameras_of(kind, *stage), ""
    if setting.clip is None:
        return cameras_of("before", *stage), ""
    names = setting.clip.names
    middle = len(names) // 2
    rows = {middle, *evenly(len(names), FRAMES)}
    found = {}
    for row in sorted(rows, key=lambda row: abs(row - middle)):
        cameras = cameras_of("still", *stage, frame=row)
        seen = framings(cameras, fps, setting, cast)
        found[row] = max(one.cut for one in seen), backs(seen), cameras
    fronts = {row: cut for row, (cut, back, _) in found.items() if back <= BACKS}
    if not fronts:
        told = f"the scene's clip sees backs in {100 * found[middle][1]:.0f} % of the motion"
        return cameras_of("before", *stage), f"{told}: the camera stands before them (`camera: clip`, if it should not)"
    if fronts.get(middle, 1.0) <= CUT:
        return found[middle][2], ""
    best = min(fronts, key=lambda row: fronts[row])
    if fronts[best] <= CUT:
        return found[best][2], f"the camera is that of frame {names[best]} of the scene's clip, which shows them best"
    points = crowd(range(0, count, max(1, round(EVERY * fps))), cast, setting.ground.up).reshape(-1, 3)
    wide = {row: widened(found[row][2][0], points, setting.ground.up) for row in fronts}
    best = max(wide, key=lambda row: float(wide[row].K[0, 0]))
    wider = float(found[best][2][0].K[0, 0] / wide[best].K[0, 0])
    told = f"the camera is where that of frame {names[best]} of the scene's clip was, turned to them"
    return [wide[best]] * count, told + (f", and {wider:.1f} times as wide" if wider > 1.05 else "")


def widened(camera: Camera, points: np.ndarray, up: np.ndarray) -> Camera:
    """A camera where this one stands, turned to all `points` [N,3] m, and as much wider as they need, up to WIDEST."""
    view, size = camera.viewmat.double().cpu().numpy(), np.array([camera.width, camera.height])
    eye, ahead = camera_centers(view), points.mean(0)
    for _ in range(TURNS):
        view = look_at(eye, ahead, up)
        x, y, z = view[:3, :3] @ points.T + view[:3, 3:]
        tangents = np.stack([x, y]) / np.maximum(z, NEAR)
        low, high = tangents.min(1), tangents.max(1)
        ahead = eye + view[:3, :3].T @ [*(low + high) / 2, 1]
    fits = (size / 2 / np.abs([low, high]).max(0) / MARGIN).min()
    focal = min(float(camera.K[0, 0]), max(float(fits), WIDEST * size.max()))
    return Camera.of(view, pinhole(focal, camera.width, camera.height), camera.width, camera.height)


def framings(cameras: Sequence[Camera], fps: float, setting: Setting, cast: Sequence[Actor]) -> list[Framing]:
    """How the camera of each picture of a film shows each person."""
    rows, up = range(0, len(cameras), max(1, round(EVERY * fps))), setting.ground.up
    seen = [cameras[row] for row in rows]
    return [_framing(actor.joints(rows), actor.scale, up, seen) for actor in cast]


def _framing(joints: np.ndarray, scale: float, up: np.ndarray, cameras: Sequence[Camera]) -> Framing:
    """How cameras [N] show somebody with joints [N,24,3] m, `scale` times as large as they are."""
    views, Ks = (np.stack([part.double().cpu().numpy() for part in parts]) for parts in list(zip(*cameras))[:2])
    size = np.array([[[camera.width, camera.height]] for camera in cameras])
    crown, soles = joints[:, [HEAD]] + CROWN * scale * up, joints[:, FEET] - SOLE * scale * up
    local = np.concatenate([crown, soles, joints], 1) @ views[:, :3, :3].mT + views[:, None, :3, 3]
    pixels = (local @ Ks.mT)[..., :2] / np.maximum(local[..., 2:], NEAR)
    out = (local[..., 2] < NEAR) | ((pixels < 0) | (pixels > size)).any(2)
    gone = out.all(1)
    head, feet = out[:, 0] & ~gone, out[:, 1 : 1 + len(FEET)].any(1) & ~gone
    across = sum(joints[:, left] - joints[:, right] for left, right in (HIPS, SHOULDERS))
    eyes = camera_centers(views)
    back = (np.cross(across, up) * (eyes - joints[:, 0])).sum(1) < 0
    return Framing(*(float(part.mean()) for part in (head, feet, gone, back)))


def shows(seen: Sequence[Framing]) -> bool:
    """Whether people are whole and seen from the front in most of the pictures."""
    return max(one.cut for one in seen) <= CUT and backs(seen) <= BACKS


def backs(seen: Sequence[Framing]) -> float:
    """In which share of the pictures backs are seen, in the mean of all people."""
    return float(np.mean([one.back for one in seen]))


def faults(seen: Sequence[Framing], cast: Sequence[Actor]) -> list[str]:
    """Sentences about people whom the camera cuts off in more than SAID of the pictures, and about backs in more than BACKS."""
    found = []
    for one, actor in zip(seen, cast, strict=True):
        parts = {"their head": one.head, "their feet": one.feet, "all of them": one.gone}
        told = [f"{part} in {100 * share:.0f} %" for part, share in parts.items() if share > SAID]
        if told:
            found.append(f"the camera cuts off {actor.name}: {', '.join(told)} of the pictures")
    if (share := backs(seen)) > BACKS:
        found.append(f"the camera sees backs in {100 * share:.0f} % of the pictures")
    return found
