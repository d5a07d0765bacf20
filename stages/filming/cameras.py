"""The cameras of a film: of the scene's clip, around its people, after them, before them, or given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from stages.avatar.cameras.pinhole import camera_centers, look_at, pinhole
from stages.avatar.motion.between import between
from stages.avatar.rasterize import Camera
from stages.contract import StageError
from stages.filming.cast import Actor
from stages.filming.setting import Setting
from stages.formats.cameras import read_cameras

KINDS = ("clip", "still", "orbit", "follow", "before")
AUTO = "auto"  # one of them, see framing.py
SIZE = (640, 360)  # px, where nothing says it
FOCAL = 1.6  # of the shorter side, where no clip tells it
CROWN = 0.25  # m of head above the joint of that name
ROOM = 1.2  # times as far as people just fit
ASIDE, ABOVE = 0.4, 0.15  # of the way ahead: where `before` stands
CALM = 0.6  # s: `follow` turns no faster than people move on average over that time
TURN = 20.0  # s at least that `orbit` takes for a round


def cameras_of(
    kind: str,
    count: int,
    fps: float,
    size: tuple[int, int] | None,
    setting: Setting,
    cast: Sequence[Actor],
    frame: int | None = None,
) -> list[Camera]:
    """The camera of each of `count` pictures, for a `kind` of KINDS or the path of a cameras.npz in the film's world.

    Those that stand are where the clip's was at a `frame`, None: its middle one. StageError where it needs a clip and the scene has
    none, or where given cameras do not fit.
    """
    if kind not in KINDS:
        return _given(Path(kind), count, size)
    clip = setting.clip
    if clip is None and kind in ("clip", "still", "follow"):
        others = "orbit, before, or a file of cameras"
        facts = [f"camera: {kind}"]
        raise StageError("the scene has no clip whose camera could be used", f"take `camera:` {others}", facts)
    if kind in ("orbit", "before") or clip is None:
        return _around(kind, count, fps, size or SIZE, setting, cast)
    row = len(clip.names) // 2 if frame is None else frame
    width, height = size or (clip.width, clip.height)
    K = _resized(clip.Ks[row], (clip.width, clip.height), (width, height))
    if kind == "still":
        return [Camera.of(clip.viewmats[row], K, width, height)] * count
    if kind == "follow":
        return _following(clip.viewmats[row], K, width, height, count, fps, setting, cast)
    views = _to_and_fro(clip.viewmats, setting.times, count, fps)
    return [Camera.of(view, K, width, height) for view in views]


def _given(path: Path, count: int, size: tuple[int, int] | None) -> list[Camera]:
    given = read_cameras(path)
    if len(given) not in (1, count):
        facts = [f"{len(given)} cameras in {path}", f"{count} pictures of the motion"]
        raise StageError("cameras and motion do not belong together", "give one camera, or one per picture", facts)
    own = given.width, given.height
    Ks = given.Ks if size is None else [_resized(K, own, size) for K in given.Ks]
    views = [Camera.of(*view, *(size or own)) for view in zip(given.viewmats, Ks, strict=True)]
    return views * count if len(views) == 1 else views


def _resized(K: np.ndarray, old: tuple[int, int], new: tuple[int, int]) -> np.ndarray:
    """The lens for another size of picture: as much as fits of what the old one shows, about the same middle."""
    scale = max(new[0] / old[0], new[1] / old[1])
    resized = K.copy()
    resized[:2, :2] *= scale
    resized[:2, 2] = (K[:2, 2] - np.array(old) / 2) * scale + np.array(new) / 2
    return resized


def _to_and_fro(viewmats: np.ndarray, times: np.ndarray, count: int, fps: float) -> np.ndarray:
    """viewmats [count,4,4] along the clip's path at its own pace, back when it ends, and so on."""
    order = np.argsort(times, kind="stable")
    order = order[np.diff(times[order], prepend=-np.inf) > 0]
    if len(order) < 2:
        return np.tile(viewmats[order], (count, 1, 1))
    path, at = viewmats[order], times[order] - times[order[0]]
    wanted = np.arange(count) / fps % (2 * at[-1])
    wanted = np.where(wanted > at[-1], 2 * at[-1] - wanted, wanted)
    turns = Slerp(at, Rotation.from_matrix(path[:, :3, :3]))(wanted).as_matrix()
    centers = camera_centers(path)
    return _views(turns, between(wanted, at, centers))


def _views(turns: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    views = np.tile(np.eye(4), (len(eyes), 1, 1))
    views[:, :3, :3], views[:, :3, 3] = turns, -(turns @ eyes[..., None])[..., 0]
    return views


def crowd(pictures: Sequence[int], cast: Sequence[Actor], up: np.ndarray) -> np.ndarray:
    """Where people are in each of N pictures: joints and crowns [N,P,3] m."""
    joints = np.concatenate([actor.joints(pictures) for actor in cast], 1)
    heads = joints[:, 15::24] + CROWN * up * np.array([actor.scale for actor in cast])[:, None]
    return np.concatenate([joints, heads], 1)


def _around(
    kind: str, count: int, fps: float, size: tuple[int, int], setting: Setting, cast: Sequence[Actor]
) -> list[Camera]:
    """Around all that people do, a round or more; or before it, a little aside, all of it in view."""
    ground, (width, height) = setting.ground, size
    K = pinhole(FOCAL * min(size), width, height)
    points = ((crowd(range(count), cast, ground.up) - ground.point) @ ground.turn).reshape(-1, 3)
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    reach = max(float(np.linalg.norm(points - middle, axis=1).max()), 0.5)
    away = ROOM * reach / np.sin(np.arctan(0.5 / FOCAL))
    ahead = np.array([ASIDE, ABOVE, 1.0])
    ahead /= np.linalg.norm(ahead)
    rounds = max(1, round(count / fps / TURN)) if kind == "orbit" else 0
    views = []
    for angle in np.linspace(0, 2 * np.pi * rounds, count, endpoint=False):
        cos, sin = np.cos(angle), np.sin(angle)
        way = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ ahead
        eye, target = (ground.point + ground.turn @ point for point in (middle + away * way, middle))
        views.append(Camera.of(look_at(eye, target, ground.up), K, width, height))
    return views


def _following(
    view: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    count: int,
    fps: float,
    setting: Setting,
    cast: Sequence[Actor],
) -> list[Camera]:
    """From where the clip's middle camera stood, turned so that people stay in the middle of the picture."""
    eye = camera_centers(view)
    middle = crowd(range(count), cast, setting.ground.up).mean(1)
    middle = gaussian_filter1d(middle, CALM * fps, axis=0, mode="nearest")
    return [Camera.of(look_at(eye, target, setting.ground.up), K, width, height) for target in middle]
