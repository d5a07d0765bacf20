"""What training leaves: the person and the scene as Gaussians, in `avatar.npz` and `scene.npz`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz
from stages.formats.clothes import Clothes, clothes_of

HINT = "train again: `hugs run VIDEO train --force`"
_ROWS = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (3,),
    "shN": (None, 3),
    "lbs_weights": (24,),
}
_REST = {"joints": (24, 3), "parents": (24,), "betas": (10,), "canonical_pose": (69,)}


@dataclass(frozen=True)
class Scene:
    """N Gaussians in the world frame, metres.

    means[N,3], quats[N,4] (w x y z, unit), scales[N,3] > 0, opacities[N] in 0..1, sh0[N,3], shN[N,K-1,3]
    with K = (degree+1)^2; colour = 0.5 + 0.28209479 sh0 + higher terms. `antialias`: they were learned with opacities
    lowered as the screen's blur widens a Gaussian (Mip-Splatting, https://arxiv.org/abs/2311.16493), and want to be drawn so.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh0: np.ndarray
    shN: np.ndarray
    antialias: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Avatar(Scene):
    """N Gaussians in the canonical da-pose frame, metres, and all that posing them needs.

    lbs_weights[N,24] (rows sum to 1), joints[24,3] rest joints at `betas`, parents[24] (root -1), betas[10],
    canonical_pose[69] axis-angle of the pose in which the Gaussians stand; `clothes`, or None, move before skinning.
    """

    lbs_weights: np.ndarray
    joints: np.ndarray
    parents: np.ndarray
    betas: np.ndarray
    canonical_pose: np.ndarray
    clothes: Clothes | None = field(default=None, kw_only=True)


def write_splats(path: Path, splats: Scene | Avatar) -> None:
    """Write a scene or an avatar as an .npz of float32 arrays (parents int32), without pickles.

    `antialias` and `clothes` have arrays only where they are.
    """
    arrays = {name: np.asarray(getattr(splats, name)) for name in _always(type(splats))}
    if splats.antialias:
        arrays["antialias"] = np.ones(())
    if isinstance(splats, Avatar) and splats.clothes is not None:
        arrays |= splats.clothes.arrays()
    np.savez(path, **{k: v.astype(np.int32 if k == "parents" else np.float32) for k, v in arrays.items()})


def read_scene(path: Path) -> Scene:
    """Read `scene.npz`; raises StageError when arrays are missing, of unequal length, not finite, or a quaternion is zero."""
    return _read(path, Scene)


def read_avatar(path: Path) -> Avatar:
    """Read `avatar.npz`; raises StageError as `read_scene` does, and when skinning weights do not sum to one."""
    avatar = _read(path, Avatar)
    off = np.abs(avatar.lbs_weights.sum(1) - 1)
    if len(off) and off.max() > 1e-3:
        raise StageError(
            "the avatar's skinning weights do not sum to one",
            facts=[f"{path.name}: row {int(off.argmax())} sums to {1 + off.max():.4f}"],
            hint=HINT,
        )
    return avatar


def _read(path: Path, kind: type) -> Scene | Avatar:
    names = _always(kind)
    data = read_npz(path, HINT)
    more = {"antialias": bool(checked(data.get("antialias", np.zeros(())), (), "antialias", path.name, HINT))}
    if kind is Avatar:
        more["clothes"] = clothes_of(data, path.name, HINT)
    missing = [n for n in names if n not in data]
    if missing:
        raise StageError(
            f"{path.name} does not hold the Gaussians of the {kind.__name__.lower()}",
            facts=[f"missing arrays: {', '.join(missing)}"],
            hint="give the file that the train stage wrote",
        )
    lengths = {n: len(np.atleast_1d(data[n])) for n in names if n in _ROWS}
    bad = [n for n in names if data[n].dtype.kind == "f" and not np.isfinite(data[n]).all()]
    zero = np.flatnonzero(~data["quats"].any(-1)) if data["quats"].ndim == 2 else []
    if len(set(lengths.values())) != 1 or bad or len(zero):
        raise StageError(
            f"{path.name} is damaged",
            facts=[
                f"rows: {lengths}",
                f"arrays with values that are not finite: {', '.join(bad) or 'none'}",
                f"rows whose quaternion is zero: {', '.join(map(str, zero[:5])) or 'none'}",
            ],
            hint=HINT,
        )
    shapes = {n: (lengths["means"], *shape) for n, shape in _ROWS.items()} | _REST
    return kind(**{n: checked(data[n], shapes[n], n, path.name, HINT) for n in names}, **more)


def _always(kind: type) -> list[str]:
    return [f.name for f in fields(kind) if not f.kw_only]
