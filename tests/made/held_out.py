"""Pictures that a clip with truth keeps back (views, poses, the empty scene), and how near a finished run comes to them.

The clips courtyard and spin describe theirs in held_out/held_out.json; the synthetic clip has new poses in truth/novel.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import over_white, person_crop, scores
from stages.formats.arrays import read_npz
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.facts import Listing, Sfm, read_facts
from stages.formats.images import read_image, read_mask, read_pixels
from stages.formats.poses import read_poses, write_poses
from stages.records import BodyModel, BodyPoses, Cameras
from tests.made.command import hugs
from tests.made.truth import align, joints_of
from tests.made.worlds import align_viewmats

METRICS = ("psnr", "ssim", "lpips")
VIEWS, POSES, EMPTY = "views", "poses", "empty"
KINDS = {"novel_view": VIEWS, "novel_pose": POSES, "empty_scene": EMPTY}
ROWS = {VIEWS: "body_of_video_frame", POSES: "body_in_poses_npz"}


class Stance(NamedTuple):
    """How somebody stands: `global_orient` [3] and `body_pose` [69] in rad, `pelvis` [3] m."""

    global_orient: np.ndarray
    body_pose: np.ndarray
    pelvis: np.ndarray


@dataclass(frozen=True)
class Shot:
    """A true picture: its camera (`view` [4,4], `K` [3,3]), who stands before it (None: nobody), picture and mask.

    `frame` is the video's frame whose body it shows, None where the pose is new.
    """

    view: np.ndarray
    K: np.ndarray
    stance: Stance | None
    image: Path
    mask: Path
    frame: int | None = None


@dataclass(frozen=True)
class Truth:
    """What is known of a clip: the shots of each kind, and for each frame of the video its camera and its stance."""

    shots: dict[str, list[Shot]]
    views: dict[int, np.ndarray]
    stances: dict[int, Stance]


def stances(body: dict[str, np.ndarray]) -> list[Stance]:
    """Of each row of a body.npz with `joints` [F,24,3]."""
    return [Stance(*row) for row in zip(body["global_orient"], body["body_pose"], body["joints"][:, 0])]


def clip_truth(clip: Path) -> Truth:
    """Of a clip with held_out/ and cameras.json."""
    held = json.loads((clip / "held_out" / "held_out.json").read_bytes())
    frames = json.loads((clip / "cameras.json").read_bytes())["frames"]
    known = {VIEWS: stances(read_npz(clip / "body.npz")), POSES: stances(read_npz(clip / "held_out" / "poses.npz"))}
    shots: dict[str, list[Shot]] = {}
    for told in held["images"]:
        kind, image = KINDS[told["kind"]], clip / "held_out" / told["image"]
        row = told.get(ROWS.get(kind, ""))
        stance, frame = None if row is None else known[kind][row], row if kind == VIEWS else None
        mask = image.with_name(f"{image.stem}_mask.png")
        shot = Shot(np.array(told["camera_from_world"]), np.array(held["K"]), stance, image, mask, frame)
        shots.setdefault(kind, []).append(shot)
    views = {frame["index"]: np.array(frame["camera_from_world"]) for frame in frames}
    return Truth(shots, views, dict(enumerate(known[VIEWS])))


def synthetic_truth(folder: Path) -> Truth:
    """Of the synthetic clip's truth/."""
    model = read_body_model()

    def read(place: Path) -> tuple[Cameras, list[Stance]]:
        poses = read_poses(place / "body.npz")
        body = {"global_orient": poses.global_orient, "body_pose": poses.body_pose, "joints": joints_of(poses, model)}
        return read_cameras(place / "cameras.npz"), stances(body)

    cameras, bodies = read(folder)
    new, novel = read(folder / "novel")
    shots = [
        Shot(view, K, stance, *(folder / "novel" / kind / f"{name}.png" for kind in ("images", "masks")))
        for name, view, K, stance in zip(new.names, new.viewmats, new.Ks, novel)
    ]
    return Truth({POSES: shots}, dict(enumerate(cameras.viewmats)), dict(enumerate(bodies)))


class Finished:
    """A finished run: the folder of its links, the video, what frames it took, its cameras, trained poses and body."""

    def __init__(self, results: Path, video: Path) -> None:
        self.results, self.video = results, video
        self.cameras = read_cameras(results / "sfm" / "cameras.npz")
        self.poses = read_poses(results / "train" / "body.npz")
        self.model: BodyModel = read_body_model(results / "smpl" / "body_model.npz")
        listed = read_facts(results / "frames" / "frames.json", Listing).frames
        self.index = {frame.name: int(frame.index) for frame in listed}
        self.moves = read_facts(results / "sfm" / "sfm.json", Sfm).verdict == "moving"

    @property
    def stances(self) -> dict[int, Stance]:
        """How the run has the person, by frame of the video."""
        arrays = self.poses.global_orient, self.poses.body_pose, joints_of(self.poses, self.model)[:, 0]
        return {self.index[name]: Stance(*row) for name, row in zip(self.poses.names, zip(*arrays))}


Placed = tuple[np.ndarray, np.ndarray, Stance | None]
"""Camera [4,4] and K [3,3], and who stands before it, in a run's world."""


def in_one_world(run: Finished, truth: Truth) -> Callable[[Shot], Placed]:
    """Of a camera that walks: the similarity that takes the true cameras to the run's takes all else with them."""
    names = run.cameras.names
    known = Cameras(names, np.stack([truth.views[run.index[name]] for name in names]), run.cameras.Ks, 0, 0)
    similarity = align(run.cameras, known, run.poses.world_from_sfm)
    scale, turn, shift = 1 / similarity.scale, similarity.R.T, -similarity.R.T @ similarity.t / similarity.scale
    own = run.stances

    def place(shot: Shot) -> Placed:
        view, stance = align_viewmats(shot.view[None], scale, turn, shift)[0], shot.stance
        if shot.frame is not None:
            stance = own[shot.frame]
        elif stance is not None:
            turned = Rotation.from_matrix(turn) * Rotation.from_rotvec(stance.global_orient)
            stance = Stance(turned.as_rotvec(), stance.body_pose, similarity.to_result(stance.pelvis))
        return view, shot.K, stance

    return place


def before_standing_camera(run: Finished, truth: Truth, K: np.ndarray, width: int) -> Callable[[Shot], Placed]:
    """Of a camera that stands: focal length and depth are one unknown, so people are moved along their line of sight.

    All is drawn from the run's own camera. `K` [3,3] px is the true one for pictures of `width` px. The depth is that which
    puts the true pelvises where the run's are.
    """
    own_view, own_K = run.cameras.viewmats[0].copy(), run.cameras.Ks[0]
    own_view[:3, 3] *= run.poses.world_from_sfm
    turn, shift = own_view[:3, :3], own_view[:3, 3]
    depth = [
        (turn @ stance.pelvis + shift)[2] / (truth.views[i][:3] @ [*truth.stances[i].pelvis, 1])[2]
        for i, stance in run.stances.items()
    ]
    deeper, closer = float(np.median(depth)), own_K[0, 0] / (K[0, 0] * run.cameras.width / width)

    def place(shot: Shot) -> Placed:
        assert shot.stance is not None
        x, y, z = (shot.view[:3] @ [*shot.stance.pelvis, 1]) * deeper
        turned = Rotation.from_matrix(turn.T @ shot.view[:3, :3]) * Rotation.from_rotvec(shot.stance.global_orient)
        pelvis = turn.T @ (np.array([x / closer, y / closer, z]) - shift)
        return own_view, own_K, Stance(turned.as_rotvec(), shot.stance.body_pose, pelvis)

    return place


def draw(
    run: Finished, placed: list[Placed], size: tuple[int, int], only: str, out: Path, work: Path
) -> list[np.ndarray]:
    """What `hugs render` draws: RGBA pictures [H,W,4] in [0, 1], colours not multiplied by alpha."""
    out.mkdir(parents=True, exist_ok=True)
    names = tuple(f"{i:03d}" for i in range(len(placed)))
    views, Ks = (np.stack([one[part] for one in placed]) for part in (0, 1))
    write_cameras(out / "cameras.npz", Cameras(names, views, Ks.astype(float), *size))
    arguments = [run.video, "--cameras", out / "cameras.npz", "--only", only]
    bodies = [stance for _, _, stance in placed if stance is not None]
    if bodies:
        orient, pose, pelvis = (np.stack(part) for part in zip(*bodies))
        scale, betas = run.poses.world_from_sfm, run.poses.betas
        poses = BodyPoses(names, betas, orient, pose, np.zeros((len(names), 3)), np.ones(len(names)), scale)
        poses = BodyPoses(
            names, betas, orient, pose, pelvis - joints_of(poses, run.model)[:, 0], poses.confidence, scale
        )
        write_poses(out / "poses.npz", poses)
        arguments += ["--poses", out / "poses.npz"]
    hugs("render", *arguments, "--out", out / "pictures", "--pipeline", run.results.name, "--work", work, "--force")
    return [read_pixels(out / "pictures" / f"{name}.png").astype(np.float32) / 255 for name in names]


def rate(run: Finished, truth: Truth, lpips: Lpips, out: Path, work: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Kind -> region -> metric: means over the pictures that the clip keeps back, PSNR in dB.

    A walking camera's are compared whole and in the person's box, a standing one's over white in the person's box, in which
    views have the true pose. Else views have the run's own pose of the frame, and frames that it did not take are left out.
    Drawn pictures are left in `out`.
    """
    found = {}
    for kind, shots in truth.shots.items():
        if run.moves:
            own, place = run.stances, in_one_world(run, truth)
            shots = [shot for shot in shots if shot.frame is None or shot.frame in own]
            size, only = read_image(shots[0].image).shape[1::-1], "scene" if kind == EMPTY else "both"
        else:
            place = before_standing_camera(run, truth, shots[0].K, read_image(shots[0].image).shape[1])
            size, only = (run.cameras.width, run.cameras.height), "human"
        drawn = draw(run, [place(shot) for shot in shots], size, only, out / kind, work)
        rows = [compared(picture, shot, only, lpips) for picture, shot in zip(drawn, shots)]
        found[kind] = {
            region: {metric: float(np.mean([row[region][metric] for row in rows])) for metric in METRICS}
            for region in rows[0]
        }
    return found


def compared(drawn: np.ndarray, shot: Shot, only: str, lpips: Lpips) -> dict[str, dict[str, float | None]]:
    """The scores of one picture [H,W,4]: region -> metric."""
    height, width = drawn.shape[:2]
    true = torch.from_numpy(_sized(read_image(shot.image), width, height))
    colour, alpha = torch.from_numpy(drawn[..., :3]), torch.from_numpy(drawn[..., 3])
    whole = {"full": scores(colour * alpha[..., None], true, lpips)}
    if only == "scene":
        return whole
    mask = torch.from_numpy(_sized(read_mask(shot.mask), width, height))
    box = person_crop(mask)
    assert box is not None
    if only == "human":
        return {"person_white": scores(over_white(colour, alpha)[box], over_white(true, mask)[box], lpips)}
    return whole | {"person_crop": scores((colour * alpha[..., None])[box], true[box], lpips)}


def _sized(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
