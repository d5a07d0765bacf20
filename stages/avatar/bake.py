"""From what was trained to the person that is kept: what frames have not taught is filled in, and nobody is seen through."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.avatar.body import edge_lengths, vertex_normals
from stages.avatar.human import Canonical, bone_transforms, pose, rest
from stages.avatar.rasterize import rasterize
from stages.avatar.rotations import rotation_z_to
from stages.avatar.views import Person, Views

TAUGHT = 1e-3  # of the mean sum of colour gradients, under which no frame has shown a Gaussian
DOUBT = 0.1  # of that mean: at so much, a colour counts for half, and those of neighbours for the other half
SURE = 0.3  # of that mean: neighbours that are asked have been taught this much
NEIGHBOURS = 32  # that are asked
INSET = 0.02  # metres under the skin: deep enough not to show at an outline, near enough to close a hole
THIN = 0.7  # of the inset: a point nearer than this to the skin of another side goes half as deep
LEAK = 4e-7  # of the person's pixels a frame: more of a lining Gaussian beside the person is too much
LOOKS = 32  # training frames that are asked for that
PEELS = 8  # times at most: what goes may have hidden others


def as_body_where_unseen(decoded: Canonical, untaught: Canonical, taught: Tensor) -> Canonical:
    """The person as `decoded`, but `untaught`, as the body says, in rows where no training frame has shown it.

    taught[N] >= 0 is the sum of the gradients of each colour. There networks speak to features that are still random.
    """
    shown = taught > TAUGHT * taught.mean()
    pairs = zip(decoded, untaught, strict=True)
    return Canonical(*(torch.where(shown.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in pairs))


def lean(person: Canonical, taught: Tensor) -> Canonical:
    """Colours taught little (taught[N]) lean on those of the nearest that were taught well: their median.

    A posterior mean with a prior worth DOUBT; colours that frames have shown often stay as they are.
    """
    mean = taught.mean()
    sure = taught > SURE * mean
    if not sure.any():
        return person
    near = _nearest(person.means[sure], person.means, NEIGHBOURS)
    own = (taught / (taught + DOUBT * mean))[:, None, None]
    return person._replace(sh=own * person.sh + (1 - own) * person.sh[sure][near].median(1).values)


def lined(person: Canonical, body: Person, views: Views, frames: list[int]) -> Canonical:
    """The person and, after its rows, an opaque lining under the skin, which shows in holes that new poses tear open.

    The lining is the body's own vertices moved inwards, in the colours above them. Where it would show beside the
    person's masks in `frames` of `views`, it is left out: there the person is thinner than the body.
    """
    inner = _lining(person, body)
    for _ in range(PEELS):
        leaks = _leaks(person, inner, body, views, frames)
        inner = Canonical(*(part[~leaks] for part in inner))
        if not leaks.any():
            break
    return Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True)))


def _lining(person: Canonical, body: Person) -> Canonical:
    normals = vertex_normals(body.vertices, body.faces)
    depth = torch.full_like(normals[:, :1], INSET)
    skin = cKDTree(body.vertices.cpu().numpy())
    for _ in range(6):
        distance, _ = skin.query((body.vertices - depth * normals).cpu().numpy())
        depth[torch.as_tensor(distance).to(depth) < THIN * depth[:, 0]] *= 0.5
    means = body.vertices - depth * normals
    half = 0.5 * edge_lengths(body.vertices, body.faces)
    opaque = person.opacities > 0.5
    near = _nearest(person.means[opaque], means, 8)
    return Canonical(
        means=means,
        frames=rotation_z_to(normals),
        scales=torch.stack([1.2 * half, 1.2 * half, 0.25 * half], 1),
        opacities=torch.full_like(half, 0.99),
        sh=person.sh[opaque][near].median(1).values,
        weights=body.weights,
    )


def _leaks(person: Canonical, inner: Canonical, body: Person, views: Views, frames: list[int]) -> Tensor:
    """Which rows of `inner` show beside the person: what a picture's colours owe to each is a gradient."""
    bones = bone_transforms(body.joints, body.parents, torch.zeros_like(body.joints[0]), body.canonical_pose)
    both = rest(Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True))), bones)
    shown, pixels = torch.zeros_like(inner.opacities), 0.0
    for i in frames[:: max(1, len(frames) // LOOKS)]:
        mask = views.masks[i].float() / 255
        if not body.present[i] or mask.max() == 0:
            continue
        bones = bone_transforms(body.joints, body.parents, body.global_orient[i], body.body_pose[i])
        means, axes, opacities, *_ = pose(both, bones, body.transl[i])
        colors = torch.zeros_like(means).requires_grad_()
        height, width = mask.shape
        (drawn,) = rasterize(means, axes, opacities, colors, views.viewmats[i], views.Ks[i], width, height)
        (shares,) = torch.autograd.grad((drawn.image[..., 0] * (1 - mask)).sum(), colors)
        shown += shares[-len(shown) :, 0]
        pixels += mask.sum().item()
    return shown > LEAK * pixels


def _nearest(those: Tensor, points: Tensor, k: int) -> Tensor:
    """Rows [N,k] of `those` nearest to each of points[N,3]."""
    k = min(k, len(those))
    _, rows = cKDTree(those.cpu().numpy()).query(points.detach().cpu().numpy(), k=list(range(1, k + 1)), workers=-1)
    return torch.as_tensor(rows, device=points.device)
