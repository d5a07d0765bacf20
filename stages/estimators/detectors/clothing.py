"""Clothes and hair that leave the body: do the masks of all sides agree on something that stands off the skin?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from stages.avatar.body.hull import Sight, Skin, carve, space_around
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.model.person import bone_transforms
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

OFF = 0.005  # a ponytail has 0.02 of the body's volume, a bag 0.1, a skirt or a coat 1; jeans and errors of our fit 0
OUTSIDE = 0.01  # of the body's area: a mask that hardly leaves the body in any frame shows nothing off it
LEAST = 8  # frames with a person
UNIT = "of the body's volume, off the body"


def detect(evidence: ClipEvidence) -> Finding:
    """The volume off the body that the masks of all sides have in common, against the body's own; see `body.hull`."""
    clip = evidence.clip
    outside = np.full(len(clip.names), np.nan)
    for i, drawn in zip(evidence.sampled, evidence.outlines):
        mask = clip.mask(i) > 127
        if mask.any() and drawn.any() and clip.body.confidence[i] > 0:
            outside[i] = (mask & ~drawn).sum() / drawn.sum()
    if np.isfinite(outside).sum() < LEAST:
        return unmeasured(UNIT, OFF, "the person is seen in too few frames")
    off = off_the_body(evidence) if np.nanmedian(outside) > OUTSIDE else 0.0
    words = ("stands off the body", "stays with the body")
    return compare(off, UNIT, OFF, words, strongest_frames(clip.names, outside))


def off_the_body(evidence: ClipEvidence) -> float:
    """Volume of the hull of clothes and hair, where it is clear of the skin, as share of the body's."""
    clip, faces = evidence.clip, torch.as_tensor(np.asarray(evidence.clip.body_model.faces, np.int64))
    body = Body(clip.body_model, torch.float64)
    vertices, joints = body.rest(torch.as_tensor(clip.body.betas, dtype=torch.float64))
    normals = vertex_normals(vertices, faces)
    space = space_around(Skin(*(part.numpy() for part in (vertices, normals, body.lbs_weights))))
    return carve(space, _sights(evidence, joints, body.parents)).volume(space)


def _sights(evidence: ClipEvidence, joints: torch.Tensor, parents: list[int]) -> Iterator[Sight]:
    clip = evidence.clip
    for i, drawn in zip(evidence.sampled, evidence.outlines):
        if clip.body.confidence[i] > 0:
            pose = (
                torch.as_tensor(part[i], dtype=torch.float64) for part in (clip.body.global_orient, clip.body.body_pose)
            )
            bones = bone_transforms(joints, parents, *pose).numpy()
            bones[:, :3, 3] += clip.body.transl[i]
            yield Sight(bones, clip.viewmats[i], clip.Ks[i], clip.mask(i) / 255, drawn)
