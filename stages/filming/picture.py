"""One picture of a film: people and scene as one set of Gaussians, each person's shadow on the scene and on the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import Casters, Shadow
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import with_gain
from stages.filming.cast import Actor


def shaded(lit: Splats, shadow: Shadow | None, bodies: Sequence[Casters]) -> Splats:
    """Scene or person with the shadows that `bodies` cast on them."""
    if shadow is None or not bodies:
        return lit
    share = shadow.light_past(lit.means, bodies)
    return lit._replace(sh=with_gain(lit.sh, share[:, None]))


def everybody(
    scene: Splats | None, shadow: Shadow | None, cast: Sequence[Actor], picture: int, shading: Shading | None = None
) -> list[Splats]:
    """The people of a picture, in their order, then the scene; all with the scene's antialiasing, or the last person's.

    People are in the light `shading` of the film's world, None: even light. Nobody's shadow falls on themselves: the clip
    that they were learned from has it already.
    """
    bodies = [] if shadow is None else [actor.casters(picture) for actor in cast]
    people = [actor.splats(picture) for actor in cast]
    people = people if shading is None else [shading(person) for person in people]
    sets = [shaded(person, shadow, bodies[:i] + bodies[i + 1 :]) for i, person in enumerate(people)]
    sets += [] if scene is None else [shaded(scene, shadow, bodies)]
    return [one._replace(antialias=sets[-1].antialias) for one in sets]


def draw_picture(
    scene: Splats | None,
    shadow: Shadow | None,
    cast: Sequence[Actor],
    picture: int,
    camera: Camera,
    background: float,
    shading: Shading | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W], float32, of one moment."""
    with torch.no_grad():
        sets = everybody(scene, shadow, cast, picture, shading)
        like = sets[0].means
        layer = Layer(background=torch.full((3,), background).to(like))
        (drawn,) = draw_together(sets, camera.to(like), [layer])
    return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()
