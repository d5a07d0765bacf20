"""Sets of Gaussians drawn as one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.cameras.pinhole import camera_centers
from stages.avatar.rasterize import Camera, Gaussians, Layer, Rendering, rasterize
from stages.avatar.splats.gaussians import Splats


def painted_pixels(splats: Splats, viewmat: Tensor, K: Tensor, kinds: Tensor) -> Tensor:
    """How many pixels of three kinds each of N Gaussians paints: [N,3]; kinds[H,W,3] are shares 0..1 of each pixel.

    It is the gradient of the picture to the colour: a Gaussian behind others counts for the light it still gets. No
    gradient.
    """
    means, axes, opacities, *_ = splats.detach()
    colors = torch.zeros_like(means).requires_grad_()
    height, width = kinds.shape[:2]
    gaussians = Gaussians(means, axes, opacities, colors, splats.antialias)
    (drawn,) = rasterize(gaussians, Camera(viewmat, K, width, height))
    return torch.autograd.grad((drawn.image * kinds).sum(), colors)[0]


def depths(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Of each pixel the mean depth [H,W] m and its variance [H,W] m^2 over what it shows, and its coverage [H,W]."""
    z = splats.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    shown = torch.stack([z, z * z, torch.zeros_like(z)], 1)
    (drawn,) = rasterize(Gaussians(*splats[:3], shown, splats.antialias), camera)
    mean, square, _ = (drawn.image / drawn.alpha.clamp_min(1e-6)[..., None]).unbind(-1)
    return mean, square - mean * mean, drawn.alpha


def draw_together(sets: Sequence[Splats], camera: Camera, layers: Sequence[Layer] = (Layer(),)) -> list[Rendering]:
    """Draw sets of Gaussians, one or more, sorted by depth as one: a picture for each layer, rows in the order of the sets.

    Colours are evaluated per set, so each has its own spherical-harmonics degree; all layers share colours, projection and
    order. `antialias` is that of the last set, the scene's where there is one. ValueError without a set.
    """
    if not sets:
        raise ValueError("there is neither a person nor a scene to draw")
    centre = camera_centers(camera.viewmat)
    colors = [s.colors(centre) for s in sets]
    if len(sets) == 1:
        (only,) = sets
        means, axes, opacities, color = only.means, only.axes, only.opacities, colors[0]
    else:
        means = torch.cat([s.means for s in sets])
        axes = torch.cat([s.axes for s in sets])
        opacities = torch.cat([s.opacities for s in sets])
        color = torch.cat(colors)
    return rasterize(Gaussians(means, axes, opacities, color, sets[-1].antialias), camera, layers)
