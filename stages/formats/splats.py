"""avatar.npz and scene.npz: the trained person and scene as Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, write_npz
from stages.formats.clothes import clothes_of
from stages.formats.gestures import gesture_arrays, gestures_of
from stages.records import JOINTS, Avatar, Scene

STORED = {"parents": np.int32, "version": np.int32, "invented": np.uint8, "normals": np.float16}
VERSION = 2  # of files with clothes, the others have 1; those of 0.1.0 and 0.2.0 say none
HINT = "train again: `hugs run VIDEO train --force`"
HIGHER = (0, 3, 8, 15)  # coefficients a colour beside the first, for degrees 0 to 3
_ROWS = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (3,),
    "shN": (None, 3),
    "lbs_weights": (JOINTS,),
}
_REST = {"joints": (24, 3), "parents": (24,), "betas": (10,), "canonical_pose": (69,)}

CASTERS = {"caster_middles": (JOINTS, 3), "caster_covariances": (JOINTS, 3, 3)}

S = TypeVar("S", bound=Scene)


def write_splats(path: Path, splats: Scene | Avatar) -> None:
    """Write a scene or an avatar as an .npz without pickles, of float32 arrays but for those of STORED.

    `antialias`, `invented`, `clothes`, `casters`, `normals`, `fingers` and `face` get arrays only where set, see `gesture_arrays`;
    `version` is that which first had clothes with bones, else 1.
    """
    arrays = {name: np.asarray(getattr(splats, name)) for name in _always(type(splats))}
    arrays["version"] = np.asarray(1)
    if splats.antialias:
        arrays["antialias"] = np.ones(())
    if splats.invented is not None:
        arrays["invented"] = splats.invented
    if isinstance(splats, Avatar) and splats.clothes is not None:
        arrays |= splats.clothes.arrays() | {"version": np.asarray(VERSION)}
    if isinstance(splats, Avatar) and splats.casters is not None:
        arrays |= dict(zip(CASTERS, splats.casters, strict=True))
    if isinstance(splats, Avatar) and splats.normals is not None:
        arrays["normals"] = np.asarray(splats.normals)
    arrays = {k: v.astype(STORED.get(k, np.float32)) for k, v in arrays.items()}
    write_npz(path, arrays | (gesture_arrays(splats) if isinstance(splats, Avatar) else {}))


def read_scene(path: Path) -> Scene:
    """Read `scene.npz`; StageError where arrays are missing, of unequal length, not finite, or have what cannot be."""
    return _read(path, Scene)


def read_avatar(path: Path) -> Avatar:
    """Read `avatar.npz`; raises StageError as `read_scene` does, and where skinning weights are no shares."""
    return _read(path, Avatar)


def _read(path: Path, kind: type[S]) -> S:
    return gathered(kind, read_npz(path, HINT), path.name, HINT)


def gathered(kind: type[S], arrays: Mapping[str, np.ndarray], name: str, hint: str) -> S:
    """The scene or avatar in the arrays of the file `name`; StageError as `read_avatar`."""

    def one(key: str) -> np.ndarray:
        return checked(arrays.get(key, np.zeros(())), (), key, name, hint)

    if one("version") > VERSION:
        facts = [f"its version is {int(one('version'))}, {VERSION} known"]
        raise StageError(f"{name} was made by a newer hugs", "update hugs", facts)
    if missing := [key for key in _always(kind) if key not in arrays]:
        problem = f"{name} does not hold the Gaussians of the {kind.__name__.lower()}"
        facts = [f"missing arrays: {', '.join(missing)}"]
        raise StageError(problem, "give the file that the train stage wrote", facts)
    more: dict[str, Any] = {"antialias": bool(one("antialias"))}
    rows = arrays["means"].shape[0] if arrays["means"].ndim else 1
    shapes: dict[str, tuple[int | None, ...]] = {key: (rows, *shape) for key, shape in _ROWS.items()} | _REST
    if "invented" in arrays:
        more["invented"] = checked(arrays["invented"], (rows,), "invented", name, hint).astype(bool)
    if kind is Avatar:
        more["clothes"] = clothes = clothes_of(arrays, name, hint)
        shapes["lbs_weights"] = (rows, JOINTS + (len(clothes) if clothes else 0))
        more["fingers"], more["face"] = gestures_of(arrays, rows, name, hint)
        if all(key in arrays for key in CASTERS):
            parts = [checked(arrays[key], shape, key, name, hint) for key, shape in CASTERS.items()]
            more["casters"] = (parts[0], parts[1])
        if "normals" in arrays:
            more["normals"] = checked(arrays["normals"], (rows, 3), "normals", name, hint).astype(np.float32)
    found = kind(**more | {key: checked(arrays[key], shapes[key], key, name, hint) for key in _always(kind)})
    if facts := impossible(found):
        raise StageError(f"{name} is damaged", hint, facts)
    return found


def impossible(splats: Scene) -> list[str]:
    """What Gaussians and skeletons cannot have, in words; nothing where all is well."""
    facts = []
    wrong = {
        "a scale that is not positive": ~(splats.scales > 0).all(1),
        "an opacity that is not in 0..1": ~((splats.opacities >= 0) & (splats.opacities <= 1)),
        "a quaternion of zeros": ~splats.quats.any(1),
    }
    for what, rows in wrong.items():
        if rows.any():
            facts.append(f"{rows.sum()} Gaussians have {what}, the first is row {rows.argmax()}")
    if splats.shN.shape[1] not in HIGHER:
        facts.append(f"shN has {splats.shN.shape[1]} coefficients a colour, degrees 0 to 3 have 0, 3, 8 and 15")
    if isinstance(splats, Avatar):
        if not len(splats):
            facts.append("it has no Gaussians")
        low, sums = splats.lbs_weights.min(1), splats.lbs_weights.sum(1)
        wrong = (low < -1e-6) | ~(np.abs(sums - 1) < 1e-3)
        if wrong.any():
            row = int(wrong.argmax())
            told = f"row {row} sums to {sums[row]:.4f}, its least is {low[row]:.4g}"
            facts.append(f"skinning weights of {wrong.sum()} Gaussians are below 0 or do not sum to one: {told}")
        root, *others = np.asarray(splats.parents).tolist()
        if root != -1 or not all(0 <= parent < joint for joint, parent in enumerate(others, start=1)):
            facts.append("its joints are not a tree with each parent before its child")
    return facts


def _always(kind: type[Scene]) -> list[str]:
    return [f.name for f in fields(kind) if not f.kw_only]
