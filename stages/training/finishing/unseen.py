"""Colours of what no frame shows, such as a back: what is seen at the same height of the same limb, in the light beside it.

Hems, belts, stripes and sleeves go around a body; a face, a logo and buttons do not. So what most of a limb has at a height is
the pattern there, and how much lighter it is where sight ends goes on evenly (as in seamless cloning: Perez et al. 2003,
https://doi.org/10.1145/882262.882269). The back of a head has the colours of its scalp.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from torch import Tensor

from stages.avatar.body.joints import COLLARS, HEAD, NECK, SPINE
from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import farthest_points, median_near, nearest
from stages.training.views import FittedBody

TRUNK = (0, *SPINE, *COLLARS)
SCALP = 0.3, 0.5  # of a head's box: its scalp is above 0.3 of the height at the back, and 0.5 more at the front
RING = 64  # seen Gaussians of a limb: the mean of the middle half of their colours is its pattern at a height
ASIDE = 1e-3  # of a metre along a limb: what one across it counts; a scalp has no other way
APART = 10.0  # m between one limb and the next, so that none asks another
LEVEL = 0.03  # m: a height of which nothing nearer is seen is not told
FAR = 0.05  # m: where what is seen is farther, no median near is told
SPOTS = 200  # spread over what is seen, each the median of its neighbours; what neither height nor neighbours tell asks these
ASKED = 8  # spots: over a patch about as wide as a back is away from a chest
PATCH = 64  # Gaussians where sight ends, whose median is the light there
LINKS = 8  # neighbours over which light goes on
SEALED = 0.02  # of a link: what one between scalp, face and the rest counts
FAINT = 1e-4  # of a link: with it light is that of the pattern where nothing beside tells


class OnBody(NamedTuple):
    """Of each Gaussian its `limb` int64[N] and how far `along` it [N] it is, in metres.

    A limb is called as the bone that it hangs from, and goes on to the next joint; one that ends, a hand, goes on as it came.
    Upright are the trunk (0), neck and face (NECK), and clothes (J, as many as there are joints); the scalp (HEAD) has one height.
    """

    limb: Tensor
    along: Tensor

    @property
    def part(self) -> Tensor:
        """Which are scalp (2), face and neck (1), and the rest (0) [N]: one tells no colours of another."""
        return 2 * (self.limb == HEAD) + (self.limb == NECK).long()


def unseen_colors(person: Canonical, place: OnBody, around: Tensor, fair: Tensor, hidden: Tensor) -> Tensor:
    """Colours [H,K,3] of the H Gaussians that are `hidden` [N]; `place` is theirs and all others'.

    Those that are seen well enough are `fair` [N]; colours `around` [N,K,3] are those to keep, or medians near each.
    """
    means, beside = person.means, torch.zeros_like(hidden)
    near = nearest(means, means[hidden], LINKS + 1)[1][:, 1:]
    beside[near.flatten()] = True
    asked = (hidden | beside).nonzero()[:, 0]
    at = torch.cat([place.along[:, None], ASIDE * means, APART * place.limb[:, None]], 1)
    away, rows = nearest(at[fair], at[asked], RING)
    quarter, pattern, told = rows.shape[1] // 4, around.clone(), torch.zeros_like(hidden)
    middle = slice(quarter, rows.shape[1] - quarter)
    told[asked] = away[:, middle][:, -1] < LEVEL
    pattern[told] = person.sh[fair][rows[told[asked]]].sort(1).values[:, middle].mean(1)
    lost = (hidden & ~told).nonzero()[:, 0]
    lost = lost[nearest(means[fair], means[lost], 1)[0][:, 0] > FAR]
    spots = fair.nonzero()[:, 0][farthest_points(means[fair], SPOTS)]
    pattern[lost], _ = median_near(around[spots], means[spots], means[lost], ASKED)
    light = _light((around - pattern).mean(2, keepdim=True), means, near, hidden, beside & ~hidden, told, place.part)
    return pattern[hidden] + told[hidden, None, None] * light


def _light(
    off: Tensor, means: Tensor, near: Tensor, hidden: Tensor, ends: Tensor, told: Tensor, part: Tensor
) -> Tensor:
    """How much lighter [H,K,1] than their pattern the `hidden` [N] are, by how far `off` [N,K,1] those are where sight ends.

    Of these `ends` [N] only those tell whose pattern is `told` [N], each for its own `part` [N], a patch at a time.
    """
    light, known = torch.zeros_like(off), ends & told
    if not known.any():
        return light[hidden]
    at = torch.cat([means, APART * part[:, None]], 1)
    light[ends], _ = median_near(off[known], at[known], at[ends], PATCH)
    return continued(light, near, hidden, part)


def on_body(person: Canonical, body: FittedBody) -> OnBody:
    """Where on the `body` a person's Gaussians are."""
    own, (height, depth) = len(body.joints), person.means[:, 1:].unbind(1)
    cloth = person.weights[:, own:].sum(1) > 0.5
    bone = torch.where(cloth, own, person.weights[:, :own].argmax(1))
    bones = body.canonical_bones()[: len(body.joints)]
    joints = (bones[:, :3, :3] @ body.joints[..., None])[..., 0] + bones[:, :3, 3]
    first_child = {parent: child for child, parent in reversed(list(enumerate(body.parents)))}
    limb, along = bone, height
    for joint in range(len(joints)):
        first, last = (joint, first_child[joint]) if joint in first_child else (body.parents[joint], joint)
        way = torch.nn.functional.normalize(joints[last] - joints[first], dim=0)
        along = torch.where(bone == joint, (person.means - joints[first]) @ way, along)
    for whole, joint in ((TRUNK, 0), ((NECK, HEAD), NECK)):
        there = torch.isin(bone, torch.tensor(whole).to(bone))
        limb, along = torch.where(there, joint, limb), torch.where(there, height, along)
    head = body.vertices[body.weights[:, :own].argmax(1) == HEAD]
    if len(head):
        (_, low, back), (_, high, front) = head.amin(0), head.amax(0)
        line = SCALP[0] + SCALP[1] * (depth - back) / (front - back)
        scalp = (bone == HEAD) & ((height - low) / (high - low) > line)
        limb, along = torch.where(scalp, HEAD, limb), torch.where(scalp, 0.0, along)
    return OnBody(limb, along)


def continued(values: Tensor, near: Tensor, hidden: Tensor, part: Tensor) -> Tensor:
    """What values[N,K,...] become in the rows that are `hidden` [N]: each the mean of those `near` [H,M] (Laplace's equation).

    Links to another `part` [N] count SEALED.
    """
    rows = hidden.nonzero()[:, 0]
    own, other = rows[:, None].expand_as(near).flatten(), near.flatten()
    weights = torch.where(part[own] == part[other], 1.0, SEALED).double()
    entries = weights.cpu().numpy(), (own.cpu().numpy(), other.cpu().numpy())
    links = coo_matrix(entries, (len(hidden), len(hidden))).tocsr()
    links, free = links.maximum(links.T), hidden.cpu().numpy()
    across = links[free]
    laplacian = diags(across.sum(1).A1 + FAINT) - across[:, free]
    known = across[:, ~free] @ values[~hidden].flatten(1).double().cpu().numpy()
    found = splu(laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(known)
    return torch.as_tensor(found).to(values).view(-1, *values.shape[1:])
