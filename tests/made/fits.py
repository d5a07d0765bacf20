"""Files in the layouts of the tools that fit bodies, made from the truth of the synthetic clip.

`contents` builds what a tool keeps in memory, `write` saves it as the tool does; tests may spoil it in between.
"""

from __future__ import annotations

import io
import json
import pickle
import sys
import types
import zlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.inputs import Inputs
from stages.formats.body_model import read_body_model
from stages.formats.facts import Frame, Listing, Video
from stages.formats.given_landmarks.skeletons import SKELETONS
from stages.formats.landmarks import NAMES
from stages.records import BodyModel, Cameras
from tests.made.datasets import SHIFT, TURN, UNITS
from tests.made.synthetic import clip as synthetic
from tests.made.worlds import align_viewmats

SMPLX_PELVIS = np.array([0.003123, -0.351407, 0.012037])
STRANGER = np.array([1.1, 0.05, 0.6])  # m, in each camera, from the person to somebody else
WEAK = 1e9
FILES = {
    "PHALP": "demo_clip.pkl",
    "ROMP v1 video": "clip_results.npz",
    "ROMP v1 tracks": "clip_ts_results.npz",
    "ROMP v1 pictures": "romp",
    "simple-romp pictures": "romp",
    "simple-romp video": "video_results.npz",
    "WHAM": "wham_output.pkl",
    "GVHMR": "hmr4d_results.pt",
    "TRAM": "tram",
    "PromptHMR": "results.pkl",
    "EasyMocap": "smpl",
    "AMASS": "poses.npz",
    "AMASS SMPL-X": "stageii.npz",
    "plain": "fit.npz",
}


@dataclass(frozen=True)
class Truth:
    """N frames: cameras in SfM units, the body in each camera, in metres; frame i is number `numbers[i]` of the video."""

    model: BodyModel
    views: synthetic.TrueViews
    viewmats: np.ndarray
    betas: np.ndarray
    orient: np.ndarray
    pelvis: np.ndarray
    rest: np.ndarray
    numbers: np.ndarray
    fps: float

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.views.masks.shape[1:]
        return width, height

    @property
    def focal(self) -> float:
        return float(self.views.Ks[0, 0, 0])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{n:06d}" for n in self.numbers)

    def world_joints(self) -> np.ndarray:
        """Joints [N,24,3] in metres, SfM axes."""
        return TURN.apply(self.views.joints.reshape(-1, 3)).reshape(-1, 24, 3) + SHIFT / UNITS

    def seen_by(self, focal: float, stranger: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Rotation vectors and pelvis [N,3] with which a camera of `focal` px sees the body as large, on the same pixel
        and from the same side as the true camera does."""
        there = self.pelvis + STRANGER * stranger
        depth = there[:, 2] * focal / self.focal
        tool = np.concatenate([there[:, :2] * (self.focal / focal) * depth[:, None] / there[:, 2:], depth[:, None]], 1)
        rays = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (there, tool)]
        turns = [Rotation.align_vectors(b[None], a[None])[0] for a, b in zip(*rays, strict=True)]
        return (Rotation.concatenate(turns) * Rotation.from_rotvec(self.orient)).as_rotvec(), tool

    def tool_joints(self, focal: float) -> np.ndarray:
        """Pixels [N,24,2] where a tool with a camera of `focal` px sees the joints."""
        orient, pelvis = self.seen_by(focal)
        zero = torch.zeros(len(self), 3, dtype=torch.float64)
        parts = (torch.as_tensor(a) for a in (self.betas, orient, self.views.body_pose))
        joints = Body(self.model, dtype=torch.float64)(*parts, zero)[1].numpy() - self.rest + pelvis[:, None]
        return focal * joints[..., :2] / joints[..., 2:] + np.array(self.size) / 2


def make_truth(frames: int = 12, width: int = 96, height: int = 128) -> Truth:
    """The synthetic clip before a body whose pelvis is as far from its origin as SMPL's; every third frame of the video."""
    model = read_body_model()
    shifted = model.v_template + np.array([0.01, -0.225, 0.03], np.float32)
    model = type(model)(**{**vars(model), "v_template": shifted})
    clip = synthetic.make_clip(model, frames=frames, width=width, height=height, novel=1)
    views = clip.frames
    turns = Rotation.from_matrix(views.viewmats[:, :3, :3])
    rest = model.J_regressor[0].astype(float) @ (model.v_template + model.shapedirs @ clip.betas)
    pelvis = turns.apply(views.joints[:, 0]) + views.viewmats[:, :3, 3]
    orient = (turns * Rotation.from_rotvec(views.global_orient)).as_rotvec()
    viewmats = align_viewmats(views.viewmats, UNITS, TURN.as_matrix(), SHIFT)
    numbers = 3 * np.arange(frames)
    return Truth(model, views, viewmats, clip.betas, orient, pelvis, rest, numbers, 3 * clip.fps)


def listed(names: Sequence[str], times: Sequence[float], sources: Sequence[str] = (), total: int = 0) -> Listing:
    """frames.json of a clip of `total` frames (0: not known), of which `names` are their numbers."""
    rows = zip(names, times, sources or [""] * len(names), strict=True)
    frames = tuple(Frame(name=name, index=int(name), time_s=float(t), source=own) for name, t, own in rows)
    return Listing(width=1, height=1, video=Video(path="clip.mp4", frames=total), frames=frames)


def inputs_of(truth: Truth, model: BodyModel, points: np.ndarray | None = None, moving: bool = True) -> Inputs:
    """The clip of the truth as a fit of a body in it is given it."""
    cameras = Cameras(truth.names, truth.viewmats, truth.views.Ks, *truth.size)
    listing = listed(truth.names, truth.numbers / truth.fps)
    points = np.zeros((0, 3)) if points is None else points
    return Inputs(model, cameras, listing, list(truth.views.masks), points, moving)


def contents(tool: str, truth: Truth) -> Any:
    """What `tool` has found, as it keeps it; somebody else comes before the person where the tool keeps everybody."""
    makers = {
        "PHALP": phalp,
        "ROMP v1 video": romp_frames,
        "ROMP v1 tracks": romp_tracks,
        "ROMP v1 pictures": romp_frames,
        "simple-romp pictures": simple_frames,
        "simple-romp video": simple_video,
        "WHAM": wham,
        "GVHMR": gvhmr,
        "TRAM": tram,
        "PromptHMR": prompthmr,
        "EasyMocap": easymocap,
        "AMASS": lambda t: amass(t, 156),
        "AMASS SMPL-X": lambda t: amass(t, 165),
        "plain": plain,
    }
    return makers[tool](truth)


def write(tool: str, content: Any, folder: Path) -> Path:
    """Save `content` as `tool` does; the path to give to --smpl-fit."""
    path = folder / FILES[tool]
    if path.suffix == "":
        path.mkdir(exist_ok=True)
    if tool == "PHALP":
        joblib_dump(content, path, compress=True)
    elif tool in ("WHAM", "PromptHMR"):
        joblib_dump(content, path)
    elif tool == "GVHMR":
        torch.save(content, path)
    elif tool == "TRAM":
        (path / "hps").mkdir(exist_ok=True)
        np.save(path / "camera.npy", content["camera"], allow_pickle=True)
        for k, track in enumerate(content["tracks"]):
            np.save(path / "hps" / f"hps_track_{k}.npy", track, allow_pickle=True)
    elif tool == "EasyMocap":
        for name, people in content.items():
            (path / f"{name}.json").write_text(people if isinstance(people, str) else json.dumps(people, indent=1))
    elif tool.endswith("pictures"):
        for name, people in content.items():
            np.savez(path / f"{name}.npz", results=people)
    elif tool.endswith("video") and tool.startswith("simple"):
        np.savez(path, **content)
    elif tool.startswith("ROMP"):
        np.savez(path, results=content)
    else:
        np.savez(path, **content)
    return path


def f32(array: Any) -> np.ndarray:
    return np.asarray(array, np.float32)


def phalp(truth: Truth) -> dict[str, Any]:
    """results/demo_clip.pkl; the third frame has a prediction in place of the person as well."""
    focal = 5000 / 256 * max(truth.size)
    both = [truth.seen_by(focal, stranger) for stranger in (True, False)]
    pose = Rotation.from_rotvec(truth.views.body_pose.reshape(-1, 3)).as_matrix().reshape(-1, 23, 3, 3)
    joints = truth.tool_joints(focal)
    width, height = truth.size
    padding = np.array([(max(truth.size) - width) // 2, (max(truth.size) - height) // 2])
    found = {}
    for i, number in enumerate(truth.numbers):
        entry: dict[str, Any] = {"time": int(number), "shot": 0, "frame_path": f"img/{number + 1:06d}.jpg"}
        square = np.zeros((45, 2))
        square[1:15] = (joints[i, [12, 17, 19, 21, 16, 18, 20, 0, 2, 5, 8, 1, 4, 7]] + padding) / max(truth.size)
        who = [(3, 0, both[0]), (7, 0, both[1])] + ([(9, 2, both[1])] if i == 2 else [])
        entry["tid"], entry["tracked_time"] = [t for t, _, _ in who], [age for _, age, _ in who]
        entry["smpl"] = [
            {
                "global_orient": f32(Rotation.from_rotvec(orient[i]).as_matrix())[None],
                "body_pose": f32(pose[i]),
                "betas": f32(truth.betas),
            }
            for _, _, (orient, _) in who
        ]
        entry["camera"] = [f32(pelvis[i] - truth.rest) for _, _, (_, pelvis) in who]
        entry["2d_joints"] = [f32(square).reshape(-1) if tid == 7 else np.zeros(90, np.float32) for tid, _, _ in who]
        entry["size"] = [[2 * height, 2 * width]] * len(who)  # the tool saw the video before it was shrunk
        entry["conf"] = [np.float32(0.99)] * len(who)
        entry["mask"] = [[{"size": [height, width], "counts": "0"}]] * len(who)
        found[entry["frame_path"]] = entry
    return found


def cams(truth: Truth, stranger: bool) -> tuple[np.ndarray, np.ndarray]:
    """ROMP's cam (s, tx, ty) [N,3] and rotation vectors [N,72]."""
    orient, pelvis = truth.seen_by(WEAK, stranger)
    half = max(truth.size) / 2
    scale = WEAK / pelvis[:, 2] / half
    shift = WEAK * pelvis[:, :2] / pelvis[:, 2:] / half - scale[:, None] * truth.rest[:2]
    return np.column_stack([scale, shift]), np.concatenate([orient, truth.views.body_pose], 1)


def romp_person(cam: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> dict[str, np.ndarray]:
    rows = {"cam": cam, "poses": pose, "betas": betas, "pj2d_org": np.zeros((54, 2)), "center_conf": np.ones(1)}
    return {key: np.asarray(a, np.float16) for key, a in rows.items()}


def romp_frames(truth: Truth) -> dict[str, Any]:
    """Picture -> its people, of which ROMP's first version does not say who is who; here the order changes."""
    both = [cams(truth, stranger) for stranger in (True, False)]
    found = {}
    for i, number in enumerate(truth.numbers):
        people = [romp_person(cam[i], pose[i], truth.betas) for cam, pose in both]
        found[f"{number:08d}.jpg"] = people[:: (-1) ** i]
    return found


def romp_tracks(truth: Truth) -> dict[int, Any]:
    both = {4: cams(truth, True), 2: cams(truth, False)}
    names = [f"{number:08d}" for number in truth.numbers]
    return {
        tid: {name: romp_person(cam[i], pose[i], truth.betas) for i, name in enumerate(names)}
        for tid, (cam, pose) in both.items()
    }


def simple_frames(truth: Truth) -> dict[str, Any]:
    both = [cams(truth, stranger) for stranger in (True, False)]
    found = {}
    for i, number in enumerate(truth.numbers):
        cam, pose = (np.stack([kind[k][i] for kind in both]) for k in (0, 1))
        betas = np.tile(truth.betas, (2, 1))
        rows = {"cam": cam, "global_orient": pose[:, :3], "body_pose": pose[:, 3:], "smpl_thetas": pose}
        rows |= {"smpl_betas": betas, "cam_trans": np.zeros((2, 3)), "center_confs": np.ones(2)}
        found[f"{number:08d}"] = {key: f32(a) for key, a in rows.items()}
    return found


def simple_video(truth: Truth) -> dict[str, Any]:
    """video_results.npz with tracks; of the stranger there are only the first frames."""
    frames = simple_frames(truth)
    results = {f"{name}.png": rows for name, rows in frames.items()}
    tracks = {}
    for tid, row, count in ((0, 0, 5), (1, 1, len(truth))):
        rows = list(frames.values())[:count]
        tracks[tid] = {"frame_id": list(range(len(rows)))} | {key: [r[key][row] for r in rows] for key in rows[0]}
    return {"results": results, "sequence_results": tracks}


def wham(truth: Truth) -> dict[int, Any]:
    found: dict[int, Any] = defaultdict(dict)
    focal = np.hypot(*truth.size)
    for tid, stranger in ((0, True), (1, False)):
        orient, pelvis = truth.seen_by(focal, stranger)
        found[tid]["pose"] = f32(np.concatenate([orient, truth.views.body_pose], 1))
        found[tid]["trans"] = f32(pelvis - truth.rest)
        found[tid]["pose_world"], found[tid]["trans_world"] = 0 * found[tid]["pose"], 0 * found[tid]["trans"]
        found[tid]["betas"] = f32(np.tile(truth.betas, (len(truth), 1)))
        found[tid]["verts"] = np.zeros((len(truth), 20, 3), np.float32)
        found[tid]["frame_ids"] = truth.numbers.copy()
    return found


def gvhmr(truth: Truth) -> dict[str, Any]:
    """All frames of the video, of which the clip has every third; those between repeat the one before."""
    orient, pelvis = truth.seen_by(truth.focal)
    video = np.repeat(np.arange(len(truth)), 3)
    tensor = lambda a: torch.tensor(f32(a))  # noqa: E731
    incam = {
        "body_pose": tensor(truth.views.body_pose[video, :63]),
        "betas": tensor(np.tile(truth.betas, (len(video), 1))),
        "global_orient": tensor(orient[video]),
        "transl": tensor((pelvis - SMPLX_PELVIS)[video]),
    }
    K = np.diag([4 * truth.focal, 4 * truth.focal, 1.0])  # of a video four times as large
    K[:2, 2] = 2 * np.array(truth.size)
    lost = {key: torch.zeros_like(value) for key, value in incam.items()}
    return {"smpl_params_global": lost, "smpl_params_incam": incam, "K_fullimg": tensor(K).repeat(len(video), 1, 1)}


def tram(truth: Truth) -> dict[str, Any]:
    camera = {"pred_cam_R": np.tile(np.eye(3), (len(truth), 1, 1)), "pred_cam_T": np.zeros((len(truth), 3))}
    camera |= {"img_focal": 2 * truth.focal, "img_center": np.array(truth.size, float)}
    tracks = []
    for stranger in (True, False):
        orient, pelvis = truth.seen_by(truth.focal, stranger)
        pose = np.concatenate([orient, truth.views.body_pose], 1).reshape(-1, 3)
        rows = {
            "pred_cam": torch.zeros(len(truth), 3),
            "pred_rotmat": torch.tensor(f32(Rotation.from_rotvec(pose).as_matrix().reshape(-1, 24, 3, 3))),
            "pred_shape": torch.tensor(f32(np.tile(truth.betas, (len(truth), 1)))),
            "pred_trans": torch.tensor(f32(pelvis - truth.rest))[:, None],
            "frame": torch.from_numpy(truth.numbers),
        }
        tracks.append(rows)
    return {"camera": camera, "tracks": tracks}


def prompthmr(truth: Truth) -> dict[str, Any]:
    """results.pkl of a pipeline that saves what is essential, its pictures half as large again; a stranger comes first."""
    people: dict[int, Any] = {}
    for tid, stranger in ((1, True), (2, False)):
        orient, pelvis = truth.seen_by(truth.focal, stranger)
        pose = np.concatenate([orient, truth.views.body_pose[:, :63], np.zeros((len(truth), 9))], 1)
        cam = {
            "pose": f32(pose),
            "shape": f32(np.tile(truth.betas, (len(truth), 1))),
            "trans": f32(pelvis - SMPLX_PELVIS),
        }
        people[tid] = {"track_id": tid, "frames": truth.numbers.copy(), "smplx_cam": cam, "smplx_world": {}}
    camera = {"img_focal": np.float32(1.5 * truth.focal), "img_center": f32(0.75 * np.array(truth.size))}
    camera |= {"pred_cam_R": np.tile(np.eye(3), (len(truth), 1, 1)), "pred_cam_T": np.zeros((len(truth), 3))}
    return {"camera": camera, "people": people, "timings": {}, "has_tracks": True, "contact_joint_ids": [7, 10, 8, 11]}


def sam_3d_body(truth: Truth, points: np.ndarray, pictures: float = 2.0) -> list[list[dict[str, Any]]]:
    """What process_one_image returns for each picture, `pictures` times as large as ours, of BlazePose's `points` [N,33,3] m in
    the camera; a stranger comes first."""
    focal, found = pictures * truth.focal, []
    for row in points:
        people = []
        for aside in (STRANGER, np.zeros(3)):
            seen = np.nan_to_num(np.stack([row[NAMES.index(n)] if n else row[0] for n in SKELETONS["MHR-70"]])) + aside
            place = seen.mean(0)
            pixels = focal * seen[:, :2] / seen[:, 2:] + pictures * np.array(truth.size) / 2
            person = {
                "pred_keypoints_3d": f32(seen - place),
                "pred_cam_t": f32(place),
                "focal_length": np.float32(focal),
            }
            people.append({**person, "pred_keypoints_2d": f32(pixels), "bbox": f32(np.zeros(4)), "mask": None})
        found.append(people)
    return found


def easymocap(truth: Truth) -> dict[str, Any]:
    """Rh, Th, poses, shapes with three decimals; the posed body is turned about the origin."""
    turned = Rotation.from_rotvec(truth.orient).apply(truth.rest)
    found = {}
    for i, number in enumerate(truth.numbers):
        people = []
        for who, shift in ((0, STRANGER), (1, 0)):
            row = {"Rh": truth.orient[i], "Th": truth.pelvis[i] + shift - turned[i], "shapes": truth.betas}
            row |= {"poses": np.concatenate([np.zeros(3), truth.views.body_pose[i]])}
            people.append({"id": who, **{key: [np.round(a, 3).tolist()] for key, a in row.items()}})
        found[f"{number:06d}"] = people
    return found


def amass(truth: Truth, width: int) -> dict[str, Any]:
    """At twice the frame rate of the clip's frames, the body turning as long as it takes; hands at their two roots."""
    pose = np.concatenate([truth.orient, truth.views.body_pose], 1).reshape(-1, 24, 3)
    poses = np.zeros((len(truth), width // 3, 3))
    poses[:, :22], poses[:, (22, 37) if width == 156 else (25, 40)] = pose[:, :22], pose[:, 22:]
    trans = truth.pelvis - (truth.rest if width == 156 else SMPLX_PELVIS)
    key = "mocap_framerate" if width == 156 else "mocap_frame_rate"
    rest = {"betas": np.append(truth.betas, np.zeros(6)), "gender": "neutral", "dmpls": np.zeros((len(truth), 8))}
    return {"poses": poses.reshape(len(truth), width), "trans": trans, key: np.float64(truth.fps / 3), **rest}


def plain(truth: Truth) -> dict[str, Any]:
    names = np.array([f"{number:05d}.png" for number in truth.numbers])
    rows = {"global_orient": truth.orient, "body_pose": truth.views.body_pose, "transl": truth.pelvis - truth.rest}
    return {"betas": truth.betas, "names": names, **rows}


def joblib_dump(content: Any, path: Path, compress: bool = False) -> None:
    """What joblib.dump writes: where an array stands, a NumpyArrayWrapper with its numbers behind it, aligned to 16."""
    name = "joblib.numpy_pickle"
    wrapper = type("NumpyArrayWrapper", (), {"__module__": name})
    module = types.ModuleType(name)
    module.NumpyArrayWrapper = wrapper

    class Pickler(pickle._Pickler):
        def save(self, obj: Any, save_persistent_id: bool = True) -> None:
            if type(obj) is not np.ndarray:
                return super().save(obj, save_persistent_id)
            stand_in = wrapper()
            order = "F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"
            state = {"subclass": np.ndarray, "shape": obj.shape, "order": order, "dtype": obj.dtype}
            stand_in.__dict__.update(state, allow_mmap=True, numpy_array_alignment_bytes=16)
            super().save(stand_in)
            self.framer.commit_frame(force=True)
            padding = 16 - (file.tell() + 1) % 16
            file.write(bytes([padding]) + b"\xff" * padding + obj.tobytes(order))
            return None

    file = io.BytesIO()
    sys.modules["joblib"], sys.modules[name] = types.ModuleType("joblib"), module
    try:
        Pickler(file, protocol=4).dump(content)
    finally:
        del sys.modules["joblib"], sys.modules[name]
    path.write_bytes(zlib.compress(file.getvalue(), 3) if compress else file.getvalue())
