"""What lies on disk is what was made."""

import numpy as np
import pytest

from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.images import read_image, read_mask
from stages.formats.poses import read_poses
from stages.formats.video import decode, probe
from stages.synthetic.clip import make_clip
from stages.synthetic.files import write_clip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    clip = make_clip(read_body_model(), seed=1, width=120, height=160, frames=3, fps=6)
    folder = tmp_path_factory.mktemp("clip") / "synthetic"
    return clip, write_clip(folder, clip), folder


def test_the_video_shows_the_frames(made):
    clip, video, _ = made
    facts = probe(video)
    assert (facts.width, facts.height, facts.frames, round(facts.fps, 3)) == (120, 160, 3, 6)
    for i, _, picture in decode(video):
        error = np.square(picture.astype(float) - clip.frames.images[i]).mean()
        assert 10 * np.log10(255**2 / error) > 28


@pytest.mark.parametrize("part", ["frames", "novel"])
def test_the_truth_is_read_back_as_it_was_made(made, part):
    clip, _, folder = made
    views, folder = getattr(clip, part), folder / "truth" / ("novel" if part == "novel" else "")
    cameras, poses = read_cameras(folder / "cameras.npz"), read_poses(folder / "body.npz")
    assert cameras.names == poses.names == tuple(f"{i:06d}" for i in range(len(views)))
    assert (cameras.viewmats == views.viewmats).all() and (cameras.Ks == views.Ks).all()
    assert (cameras.width, cameras.height, poses.world_from_sfm) == (120, 160, 1.0)
    assert (poses.betas == clip.betas).all() and (poses.transl == views.transl).all()
    assert (poses.body_pose == views.body_pose).all() and (poses.global_orient == views.global_orient).all()
    for i, name in enumerate(cameras.names):
        assert (read_mask(folder / "masks" / f"{name}.png") == views.masks[i]).all()
        assert (read_image(folder / "images" / f"{name}.png") == views.images[i]).all()
    with np.load(folder / "depth.npz") as depth:
        for name, picture in zip(depth["names"], depth["depths"]):
            assert int(name) % 5 == 2
            assert (picture == views.depths[int(name)]).all()


def test_the_same_clip_writes_the_same_bytes(made, tmp_path):
    clip, _, folder = made
    write_clip(tmp_path, clip)
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert len(files) == 1 + 2 * (3 + 6) + 2 * 3
    for path in files:
        assert (tmp_path / path).read_bytes() == (folder / path).read_bytes(), path
