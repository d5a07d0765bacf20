"""Finishes a trained person: fills in what no frame has shown, and makes them opaque."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.body.skinning import of_few_bones
from stages.avatar.model.person import Canonical
from stages.avatar.splats.gaussians import finite_rows
from stages.avatar.splats.neighbours import median_near, nearest
from stages.training.finishing.depths import FLAT, snap_to_surface
from stages.training.finishing.lining import add_lining
from stages.training.finishing.painted import count_pixels
from stages.training.finishing.reskin import reskin
from stages.training.finishing.unseen import FAR, on_body, unseen_colors
from stages.training.seen import far_from_surface
from stages.training.views import FittedBody, Views

EDGE_DOUBT = 0.02  # weight of neighbours per pixel at an outline; with 0.05, and DOUBT 0.02, it looks the same
DOUBT = 0.01  # of the mean of pixels painted inside: at so many, half of a colour is its neighbours'
SURE = 0.1  # of that mean: neighbours that are asked paint this many
FAIR = (0.95, 0.9)  # of the best (this quantile) of their part of the body: references where sure ones are far
STRAIGHT = 0.01  # of the mean of pixels painted and seen straight: at so many, half of a colour is told
COVERED = 0.15, 0.4  # of what it would paint with nothing before it: skin under cloth that paints less shines through
UNDER = 0.15  # metres from cloth: skin beyond is not under it
NEIGHBOURS = 24  # that are asked
NEAR = 0.02  # metres: where no sure one is nearer, a Gaussian is hidden
COMPANY = 8  # neighbours of a Gaussian of a surface
APART = 1.2  # times as far from them as a body vertex from its own: such a Gaussian floats, if also SMALL
SMALL = 5.0  # times its own size away from them
SHORT = 2.0  # times its first length, an axis, which settling may double: longer is haze or a spike where no frame looks from
THICK = 0.02  # metres across the skin: a haze when seen from the side. The body's own are 0.018 at most, most 0.005


class Known(NamedTuple):
    """How well frames show each of N Gaussians, all from 0 to 1.

    `own` [N]: weight of its own colour against its neighbours'. `told` [N,3]: how well frames constrain size and place along each
    axis. `aslant` [N]: share seen at grazing angles only.
    """

    own: Tensor
    told: Tensor
    aslant: Tensor


COUNTED = {
    "reskinned": "that moved with other bones than the body there move with it now",
    "broken": "",
    "strays": "left out that strayed from the body or float beside it",
    "recolored": "that no frame shows well take the colours seen around them",
    "snapped": "put back that stood out of the surface",
    "flattened": f"thinned to {1000 * FLAT:g} mm across the skin where frames look from one side only",
    "shortened": f"cut to {SHORT:g} times the length that they began with",
    "lining": "added under the surface, where new poses would tear holes",
    "unseen": "of the person that no frame shows have the place and shape of the body",
}
"""What is counted on the way, in the order in which it is said; without words: said elsewhere."""


class Finished(NamedTuple):
    """The `person` to keep, what frames have shown of it, and how many Gaussians were COUNTED."""

    person: Canonical
    known: Known
    counts: Counter[str]


def finish(person: Canonical, begun: Canonical, body: FittedBody, views: Views, frames: list[int]) -> Finished:
    """Remove invalid, stray and floating Gaussians; then snap, shorten, recolour and add the lining.

    Skinning that left the body's comes back first, that of the person as `begun`. `frames` of `views` are those that they were
    trained on.
    """
    person, reskinned = reskin(person, begun.weights, body, views, frames)
    whole, length = finite_rows(person), begun.scales.amax(1)
    kept, length = Canonical(*(part[whole] for part in person)), length[whole]
    stray = far_from_surface(kept.means, body.surface()[0])
    if not stray.all():
        stray[~stray] = floating(Canonical(*(part[~stray] for part in kept)), body)
    if stray.all():
        raise ValueError(f"none of {len(person.means):,} Gaussians is finite and on the body")
    kept, evened = snap_to_surface(Canonical(*(part[~stray] for part in kept)), body, views, frames)
    kept, shortened = shorten(kept, SHORT * length[~stray])
    kept, known = recolor(kept, body, views, frames)
    done = add_lining(kept, body, views, frames)
    if body.clothing is not None:  # cloth shares far more bones than glTF carries
        done = done._replace(weights=of_few_bones(done.weights))
    lining = len(done.means) - len(kept.means)
    counts = {"reskinned": reskinned, "broken": int((~whole).sum()), "strays": int(stray.sum())} | evened
    counts |= {"shortened": shortened, "recolored": int((known.own < 0.5).sum()), "lining": lining}
    known = Known(*(torch.cat([part, part.new_zeros(lining, *part.shape[1:])]) for part in known))
    return Finished(done, known, Counter(counts))


def as_trained(person: Canonical, begun: Canonical) -> Finished:
    """The person unfinished, but for rows that are not finite; where none is, as they have `begun`."""
    whole = finite_rows(person)
    kept = Canonical(*(part[whole] for part in person)) if whole.any() else begun
    none = torch.zeros_like(kept.scales)
    return Finished(kept, Known(none[:, 0], none, none[:, 0]), Counter(broken=int((~whole).sum())))


def floating(person: Canonical, body: FittedBody) -> Tensor:
    """Which rows [N] are no part of a surface: far from their neighbours by the body's spacing there (APART) and by
    their own size (SMALL), or THICK across the skin.
    """
    surface, outwards, _ = body.surface()
    under = nearest(surface, person.means, 1)[1][:, 0]
    usual = nearest(surface, surface, COMPANY + 1)[0][under, -1]
    away = nearest(person.means, person.means, COMPANY + 1)[0][:, -1]
    normals = outwards[under]
    thick = ((normals[:, None] @ person.rotations)[:, 0] * person.scales).norm(dim=1)
    return ((away > APART * usual) & (away > SMALL * person.scales.amax(1))) | (thick > THICK)


def shorten(person: Canonical, most: Tensor) -> tuple[Canonical, int]:
    """Cut axes whose sigma is longer than `most`[N] m; also how many Gaussians have such."""
    most = most[:, None]
    return person._replace(scales=torch.minimum(person.scales, most)), int((person.scales > most).any(1).sum())


def recolor(person: Canonical, body: FittedBody, views: Views, frames: list[int]) -> tuple[Canonical, Known]:
    """Blend colours that frames do not show well with the median of the nearest that they do, or with `unseen_colors`.

    At an outline a pixel mixes the person with the background, and masks end late. A Gaussian that `frames` of `views`
    show there and hardly elsewhere has such colours: light specks on flanks, seen from the side. The others stay. Small
    hands and feet are nearly all outline: where sure ones are FAR, the best of the same part of the body are asked. Nor
    does skin that shines through cloth keep its colours. How large a Gaussian is and where it is along the view, no frame tells.
    """
    inside, edge, _, along, clear, straight, _ = count_pixels(person, body, views, frames)
    mean, bare = inside.mean(), _bare(person, body, clear)
    aslant = 1 - straight / (straight + STRAIGHT * straight.mean()).clamp_min(1e-9)
    sure = (inside > SURE * mean) & (inside > 2 * edge) & (bare > 0.5)
    if not sure.any():
        return person, Known(torch.ones_like(inside), 1 - along, aslant)
    means, own = person.means, bare * inside / (inside + EDGE_DOUBT * edge + DOUBT * mean)
    fair = sure | (own > FAIR[0] * _best_in_part(own, person.weights))
    away, near = nearest(means[sure], means, NEIGHBOURS)
    around, place = person.sh[sure][near].median(1).values, on_body(person, body)
    others = (place.part[sure][near] != place.part[:, None]).float().mean(1) > 0.5
    hidden = (own < 0.5) & ((away[:, 0] > NEAR) | others)
    few = away[:, away.shape[1] // 2] > FAR
    around[few], _ = median_near(person.sh[fair], means[fair], means[few], NEIGHBOURS)
    if hidden.any():
        around[hidden] = unseen_colors(person, place, around, fair, hidden)
    leant = person._replace(sh=torch.lerp(around, person.sh, own[:, None, None]))
    return leant, Known(own, own[:, None] * (1 - along), aslant)


def _bare(person: Canonical, body: FittedBody, clear: Tensor) -> Tensor:
    """How far frames show each Gaussian itself [N], 0 to 1, by how `clear` [N] they show it.

    Skin under cloth shines through it and learns to make up for what the cloth gets wrong: bright specks where a knee
    lifts a skirt.
    """
    if body.cloth is None:
        return torch.ones_like(clear)
    skin = person.weights[:, len(body.joints) :].sum(1) < 0.5
    under = skin & (nearest(body.cloth.means, person.means, 1)[0][:, 0] < UNDER)
    return torch.where(under, ((clear - COVERED[0]) / (COVERED[1] - COVERED[0])).clamp(0, 1), 1.0)


def _best_in_part(own: Tensor, weights: Tensor) -> Tensor:
    """How sure the best in each one's part of the body are [N], by shares own[N]; the largest of weights[N,J] is the part."""
    best, part = torch.zeros_like(own), weights.argmax(1)
    for bone in part.unique():
        best[part == bone] = own[part == bone].quantile(FAIR[1])
    return best
