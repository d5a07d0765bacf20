"""How loose clothes move with the pose: optional arrays of `avatar.npz`, each named `clothes_...` there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from stages.formats.arrays import checked, take


@dataclass(frozen=True)
class Clothes:
    """M nodes on the body at rest, each with an offset for each of K features of the pose.

    nodes[M,3] m, offsets[M,3,K] m, features = (body_pose - mean[69]) @ axes[69,K], held within low[K] and high[K].
    A Gaussian at rest takes the offsets of the nodes around it, see `avatar.effects.clothing`, and is then skinned.
    """

    nodes: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    offsets: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays as the file names them."""
        return {f"clothes_{f.name}": np.asarray(getattr(self, f.name)) for f in fields(self)}

    @property
    def largest(self) -> float:
        """The largest offset in m that a feature at its limit causes: what a viewer that ignores clothes gets wrong."""
        reach = np.maximum(abs(self.low), abs(self.high))
        return float(np.linalg.norm(self.offsets * reach, axis=1).max(initial=0))


def clothes_of(arrays: Mapping[str, np.ndarray], name: str, hint: str) -> Clothes | None:
    """The clothes in the arrays of the file `name`, None without them; StageError for missing ones and wrong shapes."""
    found = {key.removeprefix("clothes_"): value for key, value in arrays.items() if key.startswith("clothes_")}
    if not found:
        return None
    nodes = checked(take(found, "nodes", name, hint), (None, 3), "nodes", name, hint)
    low = checked(take(found, "low", name, hint), (None,), "low", name, hint)
    shapes = {"mean": (69,), "axes": (69, len(low)), "high": low.shape, "offsets": (*nodes.shape, len(low))}
    rest = {key: checked(take(found, key, name, hint), shape, key, name, hint) for key, shape in shapes.items()}
    return Clothes(nodes=nodes, low=low, **rest)
