"""Shoes that stand off the foot, on the person of a shot: what a bare body cannot show."""

from __future__ import annotations

import numpy as np
import torch

from stages.avatar.body.joints import ANKLES, FEET
from stages.avatar.body.smpl import vertex_normals
from stages.records import BodyModel
from tests.made.synthetic.cloth import Particles
from tests.made.synthetic.garments import Garment

UPPER = 0.004
"""m that the leather is off the skin."""
TALL = 0.07
"""m over the bare sole up to which a shoe reaches."""
EDGE = 0.004
"""m over the bare sole up to which rubber is seen."""
DOWN = (0.2, 0.8)
"""How far down the skin faces, from -1 to 1, where the sole begins and where it is all of it."""
LEATHER, RUBBER = (0.12, 0.12, 0.16), (0.9, 0.9, 0.88)
"""RGB, 0..1."""


def shoes(model: BodyModel, betas: np.ndarray, sole: float) -> Garment:
    """Both shoes, whose soles are `sole` m thick: the skin of the feet, pushed outwards, its underside down by `sole`.

    They keep the arch and go with the skin they come from; every point of them is pinned.
    """
    rest = (model.v_template + model.shapedirs @ betas).astype(np.float64)
    ground = rest[:, 1].min()
    foot = (model.lbs_weights[:, [*ANKLES, *FEET]].sum(1) > 0.5) & (rest[:, 1] < ground + TALL)
    faces = model.faces[foot[model.faces].all(1)]
    rows, faces = np.unique(faces, return_inverse=True)
    normals = vertex_normals(torch.from_numpy(rest), torch.from_numpy(model.faces.astype(np.int64))).numpy()[rows]
    places = rest[rows] + UPPER * normals
    under = np.interp(-normals[:, 1], DOWN, (0, 1))
    places[:, 1] -= under * (sole - UPPER)
    places[:, 1] = np.maximum(places[:, 1], ground - sole)
    weights = np.asarray(model.lbs_weights, np.float64)[rows]
    faces = faces.reshape(-1, 3)
    pinned = np.ones(len(rows), bool)
    rods = np.empty((0, 2), np.int64)
    worn = Particles(places, weights, pinned, np.zeros(len(rows)), rods)
    chart = np.stack([np.zeros(len(rows)), places[:, 1] - ground], 1)[faces]

    def paint(at: np.ndarray) -> np.ndarray:
        return np.where(at[:, 1:] < EDGE, RUBBER, LEATHER)

    return Garment(worn, faces, chart, paint)
