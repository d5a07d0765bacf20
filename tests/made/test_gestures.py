"""The clip with hands and a face moves them as its truth has them."""

import numpy as np
import pytest
import torch

from stages.avatar.body.joints import HANDS, HEAD
from stages.avatar.body.smpl import Body
from stages.avatar.motion.gestures import fist
from stages.formats.body_model import read_body_model
from stages.gestures import FACE_NAMES
from tests.made import gestures
from tests.made.gestures import Gestures, finger_points, gesturing, moving, talking

MODEL, BETAS = read_body_model(), np.linspace(-0.5, 0.5, 10)
AT = np.arange(40) / 12


def test_fingers_move_the_hands_skin_and_the_face_that_of_the_head_and_nothing_else():
    hands, face = np.zeros((3, 2, 15, 3)), np.zeros((3, len(FACE_NAMES)))
    hands[1], face[2, FACE_NAMES.index("jawOpen")] = fist(), 1
    pose = torch.tensor(BETAS), *(torch.zeros(3, n, dtype=torch.float64) for n in (3, 69, 3))
    skin, joints = gesturing(MODEL, BETAS, Gestures(hands, face))(*pose)
    rest, still = Body(MODEL, dtype=torch.float64)(*pose)
    off = (skin - rest).norm(dim=2)
    hand, head = (
        torch.tensor(MODEL.lbs_weights[:, part].reshape(len(rest[0]), -1).sum(1)) > 0 for part in (HANDS, [HEAD])
    )
    assert off[0].max() < 1e-9 and torch.equal(joints, still)
    assert off[1, hand].max() > 0.08 and off[1, ~hand].max() < 1e-9
    assert 0.03 < off[2, head].max() < 0.05 and off[2, ~head].max() < 1e-9


def test_hands_open_close_and_point_and_a_face_talks_by_the_seed():
    """Of both hands some frame has all fingers up, one none, one the index alone; and the mouth opens and shuts."""
    for seed in (0, 1):
        hands, face = moving(AT, np.random.default_rng(seed)), talking(AT, np.random.default_rng(seed))
        joints = finger_points(MODEL, BETAS, hands)[:, :, :12].reshape(
            len(AT), 2, 4, 3, 3
        )  # index, middle, pinky, ring
        up = joints[..., 1, 1] - joints[..., 0, 1] > -0.015  # m: palms look down
        for side in (0, 1):
            shown = {tuple(row) for row in up[:, side].tolist()}
            assert {(True,) * 4, (False,) * 4, (True, False, False, False)} <= shown
        opened = face[:, FACE_NAMES.index("jawOpen")]
        assert opened.max() > 0.4 and opened.min() < 0.05 and face.min() >= 0 and face.max() <= 1
        assert np.array_equal(hands, moving(AT, np.random.default_rng(seed)))
    assert not np.array_equal(hands, moving(AT, np.random.default_rng(0)))


@pytest.mark.slow
def test_the_pictures_show_new_gestures():
    """Two frames and the new gestures of a small clip: the hand moves in the picture, body and truth are one."""
    clip, shown, new = gestures.make("near", 0, 48, 64, 2)
    assert len(clip.frames) == len(shown.hands) == 2 and len(clip.novel) == len(new.face) == len(gestures.NOVEL)
    assert clip.frames.masks.max() == 255 and np.ptp(new.hands, axis=0).max() > 1
    again, _, _ = gestures.make("near", 0, 48, 64, 2)
    assert np.array_equal(clip.novel.images, again.novel.images)
