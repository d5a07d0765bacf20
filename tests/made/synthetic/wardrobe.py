"""What the person of a synthetic clip may wear or carry that does not stay on the body."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from stages.records import BodyModel
from tests.made.synthetic.accessories import ACCESSORIES
from tests.made.synthetic.garments import DressedBody, Garment, bag, coat, ponytail, skirt

SWINGING: dict[str, Callable[[DressedBody, np.random.Generator], Garment]] = {
    "skirt": skirt, "coat": coat, "ponytail": ponytail, "bag": bag,
}  # fmt: skip
MAKERS = SWINGING | ACCESSORIES


def make_garments(names: Sequence[str], model: BodyModel, betas: np.ndarray, rng: np.random.Generator) -> list[Garment]:
    """The garments of those names of MAKERS for the body of a shape, cut and coloured by chance."""
    return [MAKERS[name](DressedBody(model, betas), rng) for name in names]
