"""What training minimises (HUGS section 3.3), as means that do not depend on resolution or number of Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.measures.ssim import ssim

SSIM_SHARE = 0.2
ALPHA = 0.2  # weight of |alpha - mask|: an opaque person, and nothing of them outside the mask
WHOLE = 0.98  # a pixel of a blurred image whose mask is over this, or under 1 - WHOLE, shows person or scene alone
SEAM = 0.001  # of the longer side: the width around the person from which the scene learns nothing
# Weight of the mean squared difference: more drowns colours in the triplane that both share. In 900 steps 100 costs
# the person 0.4 dB against 30, 1000 more (G19); 10 wins nothing more.
LBS = 30.0
OCCLUDERS = 1.0  # on the coverage of scene Gaussians where the person is seen, down to the person's depth
OUTSIDE = 10.0  # per metre^2 outside the triplane's box
REGULAR = 0.02  # on corrections of the initial body, see HumanModel.forward: holds what no frame shows
ROUGH = 0.01  # metres; a usual depth of folds
SMOOTH = 0.03  # on the roughness of the person's surface
FRUGAL = 0.01  # on opacities and scales of the scene, see SceneModel.add_sparsity_gradient


def photometric(image: Tensor, target: Tensor) -> Tensor:
    """0.8 L1 + 0.2 (1 - SSIM) of image and target [H,W,3], means over pixels and channels; not clipped."""
    return (1 - SSIM_SHARE) * (image - target).abs().mean() + SSIM_SHARE * (1 - ssim(image, target))


def outside_person(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """The image [H,W,3] with person pixels (mask[H,W] 0..1) replaced by the target, so they carry no gradient.

    Otherwise the scene explains what the body model does not, and keeps a ghost of the person (issue 21 of ml-hugs).
    A seam around the person is replaced, too: no mask ends at the very edge, and colours bleed over it.
    """
    return target + (1 - dilated(mask, SEAM))[..., None] * (image - target)


def dilated(mask: Tensor, width: float) -> Tensor:
    """The mask [H,W], grown by `width` of its longer side, by one pixel at least; -dilated(-mask, width) shrinks it."""
    for _ in range(2):  # a square is a row of rows
        grown = mask.clone()
        for by in range(1, max(1, round(width * max(mask.shape))) + 1):
            torch.maximum(grown[by:], mask[:-by], out=grown[by:])
            torch.maximum(grown[:-by], mask[by:], out=grown[:-by])
        mask = grown.T
    return mask


def over_background(image: Tensor, mask: Tensor, background: Tensor) -> Tensor:
    """The person of image[H,W,3] by mask[H,W] in 0..1 on a solid background[3]: the target of a person-only render."""
    return background + mask[..., None] * (image - background)


def unmixed(rendered: Tensor, image: Tensor, mask: Tensor, background: Tensor) -> Tensor:
    """A person-only render [H,W,3] with pixels that person and scene share replaced by the target; arguments as `person_only`.

    Where motion has blurred an edge, the image has the colour of both: such a pixel teaches coverage only.
    """
    return torch.where((mask - 0.5).abs()[..., None] > WHOLE - 0.5, rendered, over_background(image, mask, background))


def person_only(rendered: Tensor, alpha: Tensor, image: Tensor, mask: Tensor, background: Tensor) -> Tensor:
    """Loss of a person-only render [H,W,3] over `background`[3], with its alpha[H,W], against the masked image.

    rendered, alpha, image, mask are one crop. Finite for every mask from empty to full; render and target share the
    same draw of the background (G06, G16).
    """
    target = over_background(image, mask, background)
    return photometric(rendered, target) + ALPHA * (alpha - mask).abs().mean()


def where_known(
    rendered: Tensor, alpha: Tensor, known: Tensor, target: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """A person-only render [H,W,3] and its alpha[H,W], replaced by the target where known[H,W] is 0; `target` as `person_only`.

    Somebody nearer hides the person there, and the picture does not tell of them.
    """
    there = known > 0.5
    return torch.where(there[..., None], rendered, over_background(*target)), torch.where(there, alpha, target[1])


def compared(
    image: Tensor,
    alpha: Tensor,
    gains: Tensor | None,
    known: Tensor | None,
    blurred: bool,
    target: tuple[Tensor, Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """A person-only render [H,W,3] and its alpha[H,W] as they are compared with the `target` (as `person_only`): with the
    frame's exposure `gains`[3], edges `unmixed` where motion has `blurred` them, and only `where_known`[H,W].
    """
    if gains is not None:
        bare = (1 - alpha)[..., None] * target[2]
        image = bare + gains * (image - bare)
    if blurred:
        image = unmixed(image, *target)
    return (image, alpha) if known is None else where_known(image, alpha, known, target)


def skinning(weights: Tensor, reference: Tensor) -> Tensor:
    """LBS x mean squared difference of skinning weights [N,J] from those of the nearest body vertices, a constant."""
    return LBS * (weights - reference.detach()).square().mean()


def roughness(means: Tensor, near: Tensor, normals: Tensor) -> Tensor:
    """Mean squared distance, in units of ROUGH, of means[N,3] from the mean of neighbours near[N,K], along normals[N,3].

    The neighbours carry no gradient: sums of many rows into one would come in another order each time. A camera in front
    of a surface cannot tell how deep a Gaussian is in it; from the side it is a dot off the outline.
    """
    out = ((means - means.detach()[near].mean(1)) * normals).sum(1)
    return (out / ROUGH).square().mean()


def random_patch(mask: Tensor, size: int, generator: torch.Generator) -> tuple[slice, slice]:
    """Rows and columns of a window of size x size px around a random person pixel of mask[H,W], inside the picture.

    Anywhere when the mask is empty; smaller where the picture is (hard case G08).
    """
    inside = (mask > 0.5).nonzero()
    if len(inside):
        centre = inside[int(torch.randint(len(inside), (1,), generator=generator))].tolist()
    else:
        centre = [int(torch.randint(n, (1,), generator=generator)) for n in mask.shape]
    starts = [max(0, min(c - size // 2, n - size)) for c, n in zip(centre, mask.shape, strict=True)]
    rows, columns = (slice(a, min(a + size, n)) for a, n in zip(starts, mask.shape, strict=True))
    return rows, columns
