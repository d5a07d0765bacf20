"""The synthetic clip on disk: clip.mp4, and truth/ with the exact answers.

clip.mp4                 frame i of the video is the view named "%06d" % i
truth/cameras.npz        as formats.cameras, metres, y up
truth/body.npz           as formats.poses, world_from_sfm = 1
truth/masks/%06d.png     255 = person
truth/depth.npz          names [D], depths [D,H,W] float32: z in metres at the pixel centres of every 5th frame
truth/images/%06d.png    the frames before the video's compression
truth/novel/             the same files for views with poses and cameras that the video does not show
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.formats.cameras import write_cameras
from stages.formats.images import write_image, write_mask
from stages.formats.poses import write_poses
from stages.formats.video import write_video
from stages.records import BodyPoses, Cameras
from stages.synthetic.clip import SyntheticClip, TrueViews

CRF = 14
DEPTH_EVERY, DEPTH_FIRST = 5, 2


def write_clip(folder: Path, clip: SyntheticClip) -> Path:
    """Write `clip` into `folder`; returns the path of the video."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_truth(folder / "truth", clip)
    video = folder / "clip.mp4"
    write_video(video, clip.frames.images, clip.fps, crf=CRF)
    return video


def write_truth(folder: Path, clip: SyntheticClip) -> None:
    """Write the truth of a clip's frames into `folder`, that of its novel poses into novel/ there."""
    for place, views in ((folder, clip.frames), (folder / "novel", clip.novel)):
        write_views(place, views, clip.betas)


def write_views(folder: Path, views: TrueViews, betas: np.ndarray) -> None:
    """Write pictures, masks, cameras, poses and depth of `views`, and the body's shape `betas` [10]."""
    names = tuple(f"{i:06d}" for i in range(len(views.images)))
    for kind, write, pictures in (("images", write_image, views.images), ("masks", write_mask, views.masks)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for name, picture in zip(names, pictures):
            write(folder / kind / f"{name}.png", picture)
    height, width = views.masks.shape[1:]
    write_cameras(folder / "cameras.npz", Cameras(names, views.viewmats, views.Ks, width, height))
    poses = BodyPoses(names, betas, views.global_orient, views.body_pose, views.transl, np.ones(len(names)))
    write_poses(folder / "body.npz", poses)
    some = np.s_[DEPTH_FIRST::DEPTH_EVERY]
    np.savez(folder / "depth.npz", names=np.array(names, np.str_)[some], depths=views.depths[some])
