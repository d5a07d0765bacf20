"""Joining the folders of sfm and smpl by frame name, in metres."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.clip import load_clip
from stages.formats.hands import write_hands
from stages.formats.images import write_image
from stages.formats.poses import read_poses, write_poses
from stages.gestures import HandPoses
from tests.made import tiny as tiny_clip
from tests.made.said import holds


def test_cameras_points_and_body_share_a_world_of_metres(tiny):
    clip = load_clip(tiny["sfm"], tiny["smpl"])
    np.testing.assert_allclose(clip.viewmats, tiny_clip.make_viewmats(), atol=1e-12)
    np.testing.assert_allclose(clip.points, tiny_clip.make_scene().means[::7], atol=1e-6)
    assert clip.names == tiny_clip.NAMES and clip.colors.dtype == np.uint8
    assert (clip.images(0).shape, clip.mask(0).shape) == ((128, 96, 3), (128, 96))
    assert clip.shows_person(0) and not clip.shows_person(tiny_clip.EMPTY)


def test_every_fifth_frame_is_held_out(tiny):
    assert np.flatnonzero(load_clip(tiny["sfm"], tiny["smpl"]).heldout).tolist() == [2, 7]


def test_bodies_are_put_in_the_order_of_the_cameras(tiny, tmp_path):
    poses = read_poses(tiny["smpl"] / "body.npz")
    rows = ("global_orient", "body_pose", "transl", "confidence")
    turned = {name: getattr(poses, name)[::-1] for name in rows}
    write_poses(tmp_path / "body.npz", replace(poses, names=poses.names[::-1], **turned))
    clip = load_clip(tiny["sfm"], tiny["smpl"], tmp_path)
    np.testing.assert_array_equal(clip.body.transl, poses.transl)
    assert clip.body.names == clip.names


def test_a_camera_without_a_body_is_named(tiny, tmp_path):
    poses = read_poses(tiny["smpl"] / "body.npz")
    rows = ("global_orient", "body_pose", "transl", "confidence")
    write_poses(
        tmp_path / "body.npz", replace(poses, names=poses.names[:6], **{r: getattr(poses, r)[:6] for r in rows})
    )
    with pytest.raises(StageError, match="2 of 8 frames") as refused:
        load_clip(tiny["sfm"], tiny["smpl"], tmp_path)
    assert "000018, 000021" in refused.value.facts[0]


def test_a14_a_world_far_from_its_origin_is_refused(tiny, tmp_path):
    """At 5e5 m, where maps count from, float32 knows a place to 3 cm."""
    sfm = shutil.copytree(tiny["sfm"], tmp_path / "sfm")
    cameras, unit = read_cameras(sfm / "cameras.npz"), read_poses(tiny["smpl"] / "body.npz").world_from_sfm
    for metres in (900.0, 5e5):
        viewmats = cameras.viewmats.copy()
        viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ [metres / unit, 0, 0]
        write_cameras(sfm / "cameras.npz", replace(cameras, viewmats=viewmats))
        if metres < 1000:
            assert load_clip(sfm, tiny["smpl"]).names == tiny_clip.NAMES
    with pytest.raises(StageError, match=r"5e\+05 m\b"):
        load_clip(sfm, tiny["smpl"])


def test_a25_a_picture_of_another_size_is_refused(tiny, tmp_path):
    sfm = shutil.copytree(tiny["sfm"], tmp_path / "sfm")
    write_image(sfm / "images" / "000003.png", np.zeros((64, 48, 3), np.uint8))
    clip = load_clip(sfm, tiny["smpl"])
    with pytest.raises(StageError, match=r"images/000003\.png") as refused:
        clip.images(1)
    assert holds(*refused.value.facts, "48x64", "96x128")


def test_the_face_that_training_learned_is_in_the_order_of_the_cameras(tiny, tmp_path):
    train = shutil.copytree(tiny["train"], tmp_path / "train")
    poses, face = read_poses(train / "body.npz"), np.random.default_rng(0).random((len(tiny_clip.NAMES), 52))
    turned = {name: getattr(poses, name)[::-1] for name in ("names", "global_orient", "body_pose", "transl")}
    write_poses(train / "body.npz", replace(poses, **turned, confidence=poses.confidence[::-1], face=face[::-1]))
    assert load_clip(tiny["sfm"], tiny["smpl"]).body.face is None
    clip = load_clip(tiny["sfm"], tiny["smpl"], train)
    assert np.array_equal(clip.body.face, face) and np.array_equal(clip.body.transl, poses.transl)


def test_hands_that_were_read_are_the_clips_and_their_shape_the_avatars(tiny, tmp_path):
    assert load_clip(tiny["sfm"], tiny["smpl"]).hand_shape is None
    smpl, names = shutil.copytree(tiny["smpl"], tmp_path / "smpl"), tiny_clip.NAMES
    shape, each = np.full((2, 15, 3), 0.1), np.zeros((len(names), 2))
    turns = np.random.default_rng(0).normal(0, 0.3, (len(names), 2, 15, 3))
    hands = HandPoses(names[::-1], turns[::-1], shape, each > 0, each, each)
    write_hands(smpl / "hands.npz", hands)
    assert load_clip(tiny["sfm"], smpl).hand_shape is None and load_clip(tiny["sfm"], smpl).body.hands is None
    write_hands(smpl / "hands.npz", replace(hands, read=each == 0))
    clip = load_clip(tiny["sfm"], smpl)
    assert np.array_equal(clip.hand_shape, shape) and np.array_equal(clip.body.hands, turns)
    parts = (part[2:] for part in (turns, each == 0, each, each))
    few = HandPoses(names[2:], next(parts), shape, *parts)
    write_hands(smpl / "hands.npz", few)
    with pytest.raises(StageError) as refused:
        load_clip(tiny["sfm"], smpl)
    assert holds(*refused.value.facts, names[0], names[1])
