"""Gaussians that learned to move with other bones than the body does stay where frames see them, and follow the body."""

import pytest
import torch

from stages.avatar.body.skinning import skin
from stages.avatar.body.smpl import DA_POSE
from stages.avatar.model.person import bone_transforms, rest
from stages.training.finishing import bake
from stages.training.finishing.reskin import reskin
from stages.training.views import Views
from tests.made.standing import around, stand

STILL, FRAMES = torch.zeros(3), 3
HEAD = 15
SEEN = Views(
    torch.zeros(FRAMES, 8, 8, 3),
    torch.full((FRAMES, 8, 8), 255, dtype=torch.uint8),
    *around(((0, 0, 3),) * FRAMES, 9, 8),
)


def bent(knee: float, elbow: float = 0.0):
    pose = DA_POSE.clone().view(23, 3)
    pose[3, 0], pose[4, 0], pose[17, 1] = knee, knee, elbow
    return pose.flatten()


@pytest.fixture
def walking():
    """The untrained person, the same with every fourth Gaussian of a shin at the head's, who bends the knees in three frames."""
    human, body = stand(FRAMES)
    body = body._replace(body_pose=torch.stack([bent(0.1, 0.2), bent(0.2), bent(0.3, -0.2)]))
    person = human.initial()
    shin = (person.weights[:, 4] > 0.9).nonzero()[::4, 0]
    weights = person.weights.clone()
    weights[shin] = 0.0
    weights[shin, HEAD] = 1.0
    return person, person._replace(weights=weights), body, shin


def placed(person, body, body_pose):
    resting = rest(person, body.canonical_bones())
    return skin(resting.means, person.weights, bone_transforms(body.joints, body.parents, STILL, body_pose))[0]


def test_what_moved_with_the_head_moves_with_the_shin_from_where_frames_saw_it(walking):
    person, learned, body, shin = walking
    usual = learned._replace(weights=person.weights)
    kept, count = reskin(learned, person.weights, body, SEEN, [0, 1, 2])
    assert count == len(shin) and torch.equal(kept.weights, person.weights)

    def apart(a, b, body_pose):
        return (placed(a, body, body_pose) - placed(b, body, body_pose))[shin]

    seen, off = (torch.stack([apart(one, learned, frame) for frame in body.body_pose]) for one in (kept, usual))
    assert seen.norm(dim=2).mean() < 0.55 * off.norm(dim=2).mean(), "closer to where training had them"
    assert seen.mean(0).norm(dim=1).max() < 0.01, "on the mean where it had them"
    gap, flown = (apart(one, usual, bent(1.5)).norm(dim=1) for one in (kept, learned))
    assert gap.max() < 0.25 * flown.max(), "in a new pose they are part of the shin"


def test_all_others_are_not_touched(walking):
    person, learned, body, shin = walking
    softer = learned._replace(weights=torch.lerp(person.weights, learned.weights, 0.2))
    kept, count = reskin(softer, person.weights, body, SEEN, [0, 1, 2])
    assert count == 0 and all(torch.equal(a, b) for a, b in zip(kept, softer, strict=True)), (
        "learned weights may differ"
    )
    kept, _ = reskin(learned, person.weights, body, SEEN, [0, 1, 2])
    others = torch.ones(len(person.means), dtype=torch.bool)
    others[shin] = False
    assert torch.equal(kept.means[others], learned.means[others])


def test_who_is_never_shown_gets_the_weights_alone(walking):
    person, learned, body, shin = walking
    kept, count = reskin(learned, person.weights, body._replace(confidence=torch.zeros(FRAMES)), SEEN, [0, 1, 2])
    assert count == len(shin) and torch.equal(kept.means, learned.means) and torch.equal(kept.weights, person.weights)


@pytest.mark.slow
def test_no_hole_is_torn_where_skinning_was_wrong(walking):
    person, learned, body, shin = walking
    done = bake.finish(learned, person, body, SEEN, [0, 1, 2])
    assert (
        done.counts["reskinned"] == len(shin)
        and done.counts["strays"] == 0
        and len(done.person.means) == len(person.means) + done.counts["lining"]
    )
