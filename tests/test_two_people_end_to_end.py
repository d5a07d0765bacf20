"""Two people who cross: from a film, and masks that tell them apart, to an avatar of each and the empty room, once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.avatar.drawing.cast import Moment
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.rasterize import Camera
from stages.filming.clip_cast import load_cast
from stages.formats.body_model import read_body_model
from stages.formats.images import write_mask
from stages.formats.people import folder_of
from stages.formats.video import write_video
from stages.records import BodyPoses, Cameras
from tests.made.command import hugs
from tests.made.mask_files import ids
from tests.made.pair import Pair, make_pair
from tests.made.truth import align, joint_errors, psnr

pytestmark = pytest.mark.slow

FPS = 8.0


@pytest.fixture(scope="module")
def pair() -> Pair:
    return make_pair(seed=7, width=384, height=216, frames=16, fps=FPS)


@pytest.fixture(scope="module")
def run(pair, tmp_path_factory) -> Path:
    """The folder of stage results after `hugs run pair.mp4 export --person all`."""
    folder = tmp_path_factory.mktemp("two")
    write_video(folder / "pair.mp4", pair.views[0].images, FPS, crf=14)
    (folder / "ids").mkdir()
    for i, (one, other) in enumerate(zip(*(view.masks for view in pair.views), strict=True)):
        write_mask(folder / "ids" / f"{i:06d}.png", ids(one > 127, other > 127))
    said = hugs("run", folder / "pair.mp4", "export", "--person", "all", "--masks", folder / "ids", "--pipeline", "ci",
                "--set", "train.steps=40", "--set", "export.triangles=500", "--set", "export.texture=64",
                "--work", folder / "work")  # fmt: skip
    print(said.stderr)
    return folder / "work/pair/ci"


@pytest.fixture(scope="module")
def people(run):
    return load_cast(run / "sfm", run / "smpl", run / "train", "cpu")


def test_each_stands_where_they_stood(people, pair):
    clips, _ = people
    assert len(clips) == 2
    names, free = tuple(f"{i:06d}" for i in range(len(pair.views[0]))), read_body_model()
    for k, (one, view) in enumerate(zip(clips, pair.views, strict=True)):
        height, width = view.masks.shape[1:]
        similarity = align(one.world_cameras, Cameras(names, view.viewmats, view.Ks, width, height))
        known = view.global_orient, view.body_pose, view.transl, np.ones(len(names))
        truth = BodyPoses(names, pair.betas[k], *known)
        world, about = joint_errors(one.body, truth, similarity, one.body_model, free)
        print(f"person {k + 1}: {100 * world:.1f} cm in the world, {100 * about:.1f} cm about the pelvis")
        assert world < (0.15, 0.4)[k], "the second is 60 px tall and half hidden; the other stands 0.8 m away or more"


def test_each_is_drawn_without_the_other_and_the_room_without_both(people, pair):
    found: dict[str, list[float]] = {"1": [], "2": [], "room": []}
    (clip, _), cast = people
    cameras = clip.world_cameras
    for row in np.flatnonzero(clip.heldout):
        i = int(cameras.names[row])
        camera = Camera.of(cameras.viewmats[row], cameras.Ks[row], cameras.width, cameras.height)
        for k, one in enumerate(cast.people):
            drawn = to_uint8(Moment([one.splats(row)]).picture(camera, 1.0)[0])
            rows, columns = (np.flatnonzero(pair.whole[k, i].any(axis)) for axis in (1, 0))
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            found[str(k + 1)].append(psnr(drawn[box], pair.alone[k, i][box]))
        room = to_uint8(Moment((), cast.scene).picture(camera)[0])
        stood = np.maximum(*(view.masks[i] for view in pair.views)) > 0
        found["room"].append(psnr(room[stood], pair.rooms[i][stood]))
    means = {name: float(np.mean(values)) for name, values in found.items()}
    print(means)
    assert means["1"] > 16 and means["2"] > 12.5 and means["room"] > 18


def test_each_has_files_of_their_own(run):
    for k in (1, 2):
        files = {path.name for path in folder_of(run / "export", k).iterdir()}
        assert {"avatar.npz", "avatar.glb", "avatar.ply"} <= files, files
