"""One picture of a film: people and scene as one set of Gaussians, each person's shadow on the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from stages.avatar.effects.shadow import Shadow
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import with_gain
from stages.filming.cast import Actor


def shaded(scene: Splats, shadow: Shadow | None, cast: Sequence[Actor], picture: int) -> Splats:
    """The scene with the shadows that people cast in a picture."""
    if shadow is None:
        return scene
    share = shadow.light_past(scene.means, [actor.casters(picture) for actor in cast])
    return scene._replace(sh=with_gain(scene.sh, share[:, None]))


def everybody(scene: Splats | None, shadow: Shadow | None, cast: Sequence[Actor], picture: int) -> list[Splats]:
    """The people of a picture, in their order, then the scene; all with the scene's antialiasing, or the first person's."""
    sets = [actor.splats(picture) for actor in cast]
    sets += [] if scene is None else [shaded(scene, shadow, cast, picture)]
    return [one._replace(antialias=sets[-1].antialias) for one in sets]


def draw_picture(
    scene: Splats | None, shadow: Shadow | None, cast: Sequence[Actor], picture: int, camera: Camera, background: float
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W], float32, of one moment."""
    with torch.no_grad():
        sets = everybody(scene, shadow, cast, picture)
        like = sets[0].means
        layer = Layer(background=torch.full((3,), background).to(like))
        (drawn,) = draw_together(sets, camera.to(like), [layer])
    return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()
