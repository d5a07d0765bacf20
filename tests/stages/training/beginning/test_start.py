"""What a training begins with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stages.avatar.body.fingers import bent_skin
from stages.avatar.body.joints import HANDS
from stages.avatar.body.smpl import Body
from stages.avatar.model.person import Canonical, rest
from stages.formats.clip import load_clip
from stages.formats.hands_face import read_hands_face
from stages.gestures import FACE_NAMES
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


def test_a_face_is_learned_where_survey_says_so_and_the_body_has_one(tiny):
    clip, params = load_clip(tiny["sfm"], tiny["smpl"]), Params(human_points=2000, channels=4, resolution=16)
    bare = replace(clip.body_model, name="SMPL")
    faceless = replace(
        bare, name="SMPL-X", fingers=replace(read_hands_face(clip.body_model), face_points=np.zeros((0, 3)))
    )
    learned = [
        build(Task([replace(clip, body_model=model)], params, {"scene": False, "face": on}), print).people[0]
        for model, on in ((clip.body_model, True), (clip.body_model, False), (bare, True), (faceless, True))
    ]
    assert [one.body.face is not None for one in learned] == [True, False, False, False]
    assert [one.corrections.face is not None for one in learned] == [True, False, False, False]


def test_a_face_that_is_given_is_drawn_as_it_is_and_none_is_learned(tiny):
    clip, params = load_clip(tiny["sfm"], tiny["smpl"]), Params(human_points=2000, channels=4, resolution=16)
    face = np.random.default_rng(0).uniform(0, 1, (len(clip.names), len(FACE_NAMES))).astype(np.float32)
    clip = replace(clip, body=replace(clip.body, face=face))
    for decided in ({"face": False}, {"face": True, "pose_refinement": True}):
        fit = build(Task([clip], params, {"scene": False} | decided), print)
        (who,) = fit.people
        assert who.corrections.face is None and not fit.options.learn_face
        assert np.array_equal(fit.poses(who).face, face)
        drawn = fit.cast().people[0]
        off = (drawn.splats(0).means - replace(drawn, mien=None).splats(0).means).norm(dim=1)
        assert off.max() > 0.005 and (off > 0).sum() < 0.2 * len(off), "the face moves, and nothing else"


def test_a_hand_stands_in_each_frame_as_that_frame_shows_its_fingers(tiny):
    """A frame with the clip's one shape is drawn as without fingers; where the index bends more, its skin goes along."""
    clip, params = load_clip(tiny["sfm"], tiny["smpl"]), Params(human_points=2000, channels=4, resolution=16)
    turns = np.zeros((len(clip.names), 2, 15, 3))
    turns[1, 0, :3, 2] = -0.8
    body = replace(clip.body, hands=turns)
    rigid, moved = (
        build(Task([replace(clip, hand_shape=turns[0], body=each)], params, {"scene": False}), print).people[0].body
        for each in (clip.body, body)
    )
    rows, flat = len(rigid.vertices), torch.zeros(len(rigid.vertices), 3)
    parts = torch.eye(3).expand(rows, 3, 3), flat, flat[:, 0], flat[:, None], rigid.weights, flat
    resting = rest(Canonical(rigid.vertices, *parts), rigid.canonical_bones())
    off = [moved.posed(resting, i).means - rigid.posed(resting, i).means for i in (0, 1)]
    rig, skin = read_hands_face(clip.body_model), Body(clip.body_model).rest(torch.tensor(clip.body.betas).float())[0]
    wanted = (bent_skin(rig, skin, torch.tensor(turns[1]).float()) - skin).norm(dim=1)
    assert off[0].norm(dim=1).max() < 1e-5 and wanted.max() > 0.03
    assert (off[1].norm(dim=1) - wanted).abs().max() < 0.003
