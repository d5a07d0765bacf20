"""The synthetic clip against itself: what it says is true must be what its pictures show."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import camera_centers, project
from stages.formats.body_model import read_body_model
from stages.synthetic.clip import make_clip
from tests.made.worlds import unproject

SIZE = {"width": 120, "height": 160, "frames": 7, "fps": 1.4}


@pytest.fixture(scope="module")
def clip():
    heard = []
    clip = make_clip(read_body_model(), seed=3, done=lambda *n: heard.append(n), **SIZE)
    total = len(clip.frames) + len(clip.novel)
    assert heard == [(i + 1, total) for i in range(total)], "it tells how far it is"
    return clip


@pytest.fixture(scope="module")
def long_clip():
    return make_clip(read_body_model(), seed=3, width=24, height=32, frames=40, fps=8)


def pixel_centres(mask):
    """Pixel centres [N,2] of a boolean picture."""
    rows, columns = np.nonzero(mask)
    return np.stack([columns, rows], 1) + 0.5


@pytest.mark.parametrize("part", ["frames", "novel"])
def test_every_joint_lies_inside_the_person(clip, part):
    views = getattr(clip, part)
    for i in range(len(views)):
        xy, z = project(views.joints[i], views.viewmats[i], views.Ks[i])
        columns, rows = np.floor(xy).astype(int).T
        assert (z > 1).all()
        assert (views.masks[i][rows, columns] > 0).all(), "each lies in a pixel that the person touches"


@pytest.mark.parametrize("part", ["frames", "novel"])
def test_depth_puts_the_person_around_their_bones_and_nothing_else_there(clip, part):
    views = getattr(clip, part)
    for i in range(len(views)):
        for mask, low, high in ((views.masks[i] == 255, 0, 0.27), (views.masks[i] == 0, 0.03, 9)):
            pixels = pixel_centres(mask)
            depth = views.depths[i][mask].astype(float)
            points = unproject(pixels, depth, views.viewmats[i], views.Ks[i])
            gap = np.linalg.norm(points[:, None] - views.joints[i][None], axis=-1).min(1)
            assert np.mean((gap < low) | (gap > high)) < 0.002, "a pixel's centre may lie between two fingers"


def test_depth_and_cameras_carry_the_room_from_one_picture_to_another(clip):
    """A background pixel of frame 1, moved by its depth, lands on the same surface and colour in frame 3."""
    views, a, b = clip.frames, 1, 3
    mask = views.masks[a] == 0
    points = unproject(pixel_centres(mask), views.depths[a][mask].astype(float), views.viewmats[a], views.Ks[a])
    xy, z = project(points, views.viewmats[b], views.Ks[b])
    columns, rows = np.floor(xy).astype(int).T
    inside = (columns >= 0) & (columns < SIZE["width"]) & (rows >= 0) & (rows < SIZE["height"])
    columns, rows, z = columns[inside], rows[inside], z[inside]
    away = np.linalg.norm(xy[inside] - pixel_centres(mask)[inside], axis=1)
    assert np.median(away) > 5, "the views differ"
    gap = np.abs(views.depths[b][rows, columns] - z)
    same = gap < 0.15
    assert same.mean() > 0.75, "the rest is hidden by the person or by furniture"
    assert np.median(gap[same]) < 0.03
    colors = views.images[a][mask][inside][same].astype(float), views.images[b][rows, columns][same].astype(float)
    assert np.abs(colors[0] - colors[1]).mean() < 12
    assert np.corrcoef(colors[0].ravel(), colors[1].ravel())[0, 1] > 0.9


def test_the_person_stands_on_the_floor_and_fills_the_picture_as_in_a_phone_clip(clip):
    assert (clip.frames.joints[..., 1].min(1) > 0).all()
    assert (clip.frames.joints[..., 1].min(1) < 0.12).all()
    for mask in clip.frames.masks > 127:
        rows = np.flatnonzero(mask.any(1))
        assert 0.55 < np.ptp(rows) / SIZE["height"] < 0.85
        assert not mask[[0, -1]].any() and not mask[:, [0, -1]].any()


def test_the_person_is_seen_from_nearly_all_sides_without_a_jump(long_clip):
    views = long_clip.frames
    facing = views.viewmats[:, :3, :3] @ Rotation.from_rotvec(views.global_orient).as_matrix() @ [0, 0, 1]
    angle = np.unwrap(np.arctan2(facing[:, 0], -facing[:, 2]))
    assert np.ptp(angle) > np.radians(180)
    assert np.abs(np.diff(angle)).max() < np.radians(20)
    assert np.linalg.norm(np.diff(views.joints, axis=0), axis=-1).max() < 0.3
    assert camera_parallax(views.viewmats) > 1.5


def camera_parallax(viewmats):
    """Largest distance in m between two cameras."""
    centers = camera_centers(viewmats)
    return np.linalg.norm(centers[:, None] - centers[None], axis=-1).max()


def test_novel_poses_are_far_from_every_pose_of_the_clip(long_clip):
    def about_pelvis(views):
        turn = Rotation.from_rotvec(views.global_orient).as_matrix()
        return (views.joints - views.joints[:, :1]) @ turn

    novel, shown = about_pelvis(long_clip.novel), about_pelvis(long_clip.frames)
    gap = np.linalg.norm(novel[:, None] - shown[None], axis=-1).max(-1)
    assert gap.min() > 0.3


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_clip(monkeypatch):
    monkeypatch.setattr("stages.synthetic.room.TEXELS", 192)  # large textures take long to make
    model = read_body_model()
    clip, again, other = (make_clip(model, seed=seed, width=48, height=64, frames=2, fps=1.4) for seed in (3, 3, 4))
    for part in ("frames", "novel"):
        for name, value in vars(getattr(clip, part)).items():
            assert value.tobytes() == getattr(getattr(again, part), name).tobytes(), name
    assert np.abs(clip.frames.images.astype(float) - other.frames.images).mean() > 5
    assert np.abs(clip.betas - other.betas).max() > 0.1
