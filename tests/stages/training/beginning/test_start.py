"""What a training begins with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stages.avatar.body.joints import HANDS
from stages.formats.clip import load_clip
from stages.training.beginning.start import Task, build
from stages.training.settings import Params


def test_the_persons_hands_begin_as_the_clip_shows_them(tiny):
    """A bent left index finger moves the skin there and no Gaussian elsewhere; without hands nothing changes."""
    clip, params = load_clip(tiny["sfm"], tiny["smpl"]), Params(human_points=2000, channels=4, resolution=16)
    bent = np.zeros((2, 15, 3))
    bent[0, :3, 2] = -0.8
    still, moved = (
        build(Task([replace(clip, hand_shape=hands)], params, {"scene": False}), print).people[0]
        for hands in (None, bent)
    )
    far = (still.body.vertices - moved.body.vertices).norm(dim=1)
    hand = still.body.weights[:, HANDS[0]] > 0
    assert far[hand].max() > 0.03 and far[~hand].max() < 1e-6 and torch.equal(still.body.joints, moved.body.joints)
