"""A small valid file of every kind that we read, made by our own writers, and who reads each: what tests/tools/fuzz.py damages."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.formats import images
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.effects import read_effects, write_effects
from stages.formats.exchange.ply import read_ply, write_ply
from stages.formats.exchange.splats_glb import read_avatar_glb, write_splats_glb
from stages.formats.exchange.spz import read_spz, write_spz
from stages.formats.facts import Facts, Listing, Metrics, Survey, read_facts
from stages.formats.failure import read_failure, write_failure
from stages.formats.given_fits.recognize import read_smpl_fit
from stages.formats.motions import bvh
from stages.formats.motions.bvh_names import map_body
from stages.formats.motions.smpl_npz import read_smpl_motion
from stages.formats.points import read_points, write_points
from stages.formats.poses import read_poses, write_poses
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.formats.splits import read_split, write_split
from stages.formats.video import write_video
from stages.records import Avatar, BodyModel, BodyPoses, Cameras, Effects, Rig, Scene
from tests.made.fits import listed
from tests.made.kinds import WHOLE, Kind

NAMES = tuple(f"{i:06d}" for i in range(6))
SIDE = 24  # px of the pictures
FPS = 12.0
VERTICES = 30


def fit(file: str, given: str = "") -> Kind:
    """An SMPL fit, or one file of those in the folder `given`: read, joined to the frames, and brought into the world."""

    def read(root: Path) -> Any:
        from stages.estimators.bodyfit.frames import join_frames
        from stages.estimators.bodyfit.placing import place_in_world

        body, cameras = read_body_model(root / "whole.npz"), still_cameras()
        found = read_smpl_fit(root / (given or file), (SIDE, SIDE))
        found, rows = join_frames(found, listed(NAMES, np.arange(len(NAMES)) / FPS))
        names = tuple(NAMES[i] for i in rows)
        return place_in_world(found, names, cameras.viewmats[rows], cameras.Ks[rows], body, 1.0)

    return Kind(file, read)


def masks(file: str, given: str = "") -> Kind:
    """Masks of another program, one file or one of those in the folder `given`, through the stage that takes them."""

    def read(root: Path) -> Any:
        from stages import masks
        from stages.contract import Job

        masks.run(Job(root / "out"), masks.Params(), frames=root / "film", mask_files=root / (given or file))

    return Kind(file, read)


def given_cameras(file: str) -> Kind:
    """Cameras of another program, joined to the frames; of a COLMAP model its folder is given."""

    def read(root: Path) -> Any:
        from stages.contract import Job
        from stages.estimators.cameras.given import import_cameras

        path, listing = root / file, read_facts(root / "film" / "frames.json", Listing)
        return import_cameras(Job(root / "out"), path.parent if path.suffix == ".bin" else path, listing, 0.5, "auto")

    return Kind(file, read)


def read_bvh(root: Path) -> Any:
    """A BVH motion, and which of its joints are whose."""
    found = bvh.read_bvh(root / "motion.bvh")
    return map_body(found, root / "motion.bvh")


def still_cameras() -> Cameras:
    """A camera for each of NAMES, all in the same place."""
    K = np.array([[30.0, 0, SIDE / 2], [0, 30, SIDE / 2], [0, 0, 1]])
    n = len(NAMES)
    return Cameras(NAMES, np.tile(np.eye(4), (n, 1, 1)), np.tile(K, (n, 1, 1)), SIDE, SIDE)


def stage(file: str, module: str, video: str, **params: Any) -> Kind:
    """A source, through the stage that takes it in place of VIDEO."""

    def read(root: Path) -> Any:
        import importlib

        from stages.contract import Job

        taken = importlib.import_module(f"stages.{module}")
        taken.run(Job(root / "out"), taken.Params(**params), video=root / video)

    return Kind(file, read)


def one(file: str, reader: Callable[..., Any], *more: Any) -> Kind:
    """A file that one function of stages.formats reads."""
    return Kind(file, lambda root: reader(root / file, *more))


def picture(root: Path, file: str) -> Any:
    """A picture, as frames are read."""
    return images.read_image(root / file)


PICTURES = [Kind(f"picture.{end}", lambda root, e=end: picture(root, f"picture.{e}")) for end in
            ("png", "jpg", "tif", "webp", "bmp")]  # fmt: skip


def calibrated(file: str) -> Kind:
    """What a data set's frames stage left, through the two stages that read it."""

    def read(root: Path) -> Any:
        from stages import calibrated, masks
        from stages.contract import Job

        for name in ("masks", "sfm"):
            (root / "out" / name).mkdir()
        masks.run(Job(root / "out" / "masks"), masks.Params(invert="never"), frames=root / "frames")
        made = {"frames": root / "frames", "masks": root / "out" / "masks"}
        calibrated.run(Job(root / "out" / "sfm"), calibrated.Params(), **made)

    return Kind(file, read)


def facts(file: str, form: type[Facts]) -> Kind:
    """A .json file between stages."""
    return Kind(file, lambda root: read_facts(root / file, form))


def read_unpacked(root: Path) -> Any:
    """An .spz whose damage lies under its packing."""
    packed = root / "out" / "splats.spz"
    packed.write_bytes(gzip.compress((root / "unpacked.spz").read_bytes(), 1, mtime=0))
    return read_spz(packed)


def read_stamp(root: Path) -> Any:
    """A result's stamp, as `status` and `why` show it."""
    from hugs_cli.cache.freshness import Verdict
    from hugs_cli.cache.workspace import Stamp
    from hugs_cli.console import Console
    from stages.contract import StageError

    stamp = Stamp.read(root / "store")
    if stamp is None:
        raise StageError("no whole stamp")
    stamp.damage(root / "store")
    screen, verdict = Console(io.StringIO(), io.StringIO()), Verdict("points", stamp=stamp)
    screen.cached("points", stamp)
    screen.verdicts({"points": verdict})
    screen.why(verdict, {})


def read_memories(root: Path) -> Any:
    """What a workspace remembers of sources and code, and what a run's first line tells of the clip."""
    from hugs_cli.app import clip_facts
    from hugs_cli.cache.fingerprint import Code
    from hugs_cli.cache.workspace import Workspace

    Workspace(root / "work.mp4", root, "pipeline").source("video", root / "points.ply")
    clip_facts(Workspace(root / "work.mp4", root, "pipeline"))
    Code(root / "work" / "code.json").digests("stages.export")


def read_pipeline(root: Path) -> Any:
    """The pipelines."""
    from hugs_cli.pipelines import load, names

    names(root / "pipelines.yaml")
    load("preview", ["train.steps=3"], root / "pipelines.yaml")


def read_curve(root: Path) -> Any:
    """Training's curve, as the report draws it."""
    from stages.commands.report.results import _curve

    _curve(root)


KINDS = [
    one("points.ply", read_points),
    one("cameras.npz", read_cameras),
    one("body.npz", read_poses),
    one("avatar.npz", read_avatar),
    one("scene.npz", read_scene),
    one("splats.ply", read_ply),
    one("splats.spz", read_spz),
    Kind("unpacked.spz", read_unpacked),
    one("avatar_splats.glb", read_avatar_glb),
    one("effects.npz", read_effects),
    one("body_model.npz", read_body_model),
    one("body_model.pkl", read_body_model),
    fit("fit_named.npz"),
    fit("fit_poses.npz"),
    fit("fit_zju.npz"),
    fit("wham_output.pkl"),
    fit("demo_clip.pkl"),
    fit("hmr4d_results.pt"),
    fit("video_results.npz"),
    fit("smpl/000000.json", "smpl"),
    one("motion.npz", read_smpl_motion),
    Kind("motion.bvh", read_bvh),
    one("failure.npz", read_failure),
    given_cameras("colmap/cameras.bin"),
    given_cameras("colmap/images.bin"),
    given_cameras("colmap/points3D.bin"),
    given_cameras("transforms.json"),
    masks("masks/soft/000000.png", "masks/soft"),
    masks("masks/labels/000000.png", "masks/labels"),
    masks("masks/cutout/000000.png", "masks/cutout"),
    masks("masks/array/000000.npy", "masks/array"),
    masks("masks/sam2/clip/00000.png", "masks/sam2"),
    masks("masks/stack.npy"),
    masks("masks/stack.npz"),
    masks("masks/coco.json"),
    *PICTURES,
    stage("clip.mp4", "frames", "clip.mp4", count=8, max_side=64),
    stage("bike/sparse/cameras.txt", "neuman", "bike"),
    stage("bike/sparse/images.txt", "neuman", "bike"),
    stage("bike/sparse/points3D.txt", "neuman", "bike"),
    stage("bike/test_split.txt", "neuman", "bike"),
    stage("bike/4d_humans/smpl_optimized_aligned_scale.npz", "neuman", "bike"),
    stage("CoreView_377/annots.npy", "zju", "CoreView_377"),
    stage("CoreView_377/new_params/0.npy", "zju", "CoreView_377"),
    stage("CoreView_377/mask/Camera_B1/000000.png", "zju", "CoreView_377"),
    calibrated("frames/frames.json"),
    calibrated("frames/given/cameras.npz"),
    calibrated("frames/given/lenses.npz"),
    calibrated("frames/given/points.ply"),
    calibrated("frames/given/sfm.json"),
    one("split.json", read_split, NAMES),
    facts("survey.json", Survey),
    facts("metrics.json", Metrics),
    Kind("curve.csv", read_curve),
    Kind("store/stamp.json", read_stamp),
    Kind("work/sources.json", read_memories),
    Kind("work/code.json", read_memories),
    Kind("work/pipeline/frames/frames.json", read_memories),
    Kind("pipelines.yaml", read_pipeline),
]


def make(folder: Path) -> Path:
    """Write the corpus; returns the folder of whole files."""
    from tests.made import datasets

    root = folder / WHOLE
    root.mkdir(parents=True)
    datasets.neuman(root, frames=len(NAMES), width=SIDE, height=SIDE, points=20)
    (root / "bike" / "test_split.txt").write_text("00002\n00004\n")
    datasets.zju(root, moments=5, cameras=2, side=SIDE)
    shutil.rmtree(root / "truth")
    rng = np.random.default_rng(0)
    write_arrays(root, rng)
    write_fits(root, rng)
    write_tools(root)
    write_pictures(root, rng)
    write_masks(root, rng)
    write_facts(root)
    write_workspace(root)
    return root


def write_arrays(root: Path, rng: np.random.Generator) -> None:
    """Points, cameras, poses, Gaussians, body models."""
    n, rows = len(NAMES), 20
    write_points(root / "points.ply", rng.normal(size=(rows, 3)), rng.integers(0, 255, (rows, 3), np.uint8))
    write_cameras(root / "cameras.npz", still_cameras())
    turned = BodyPoses(
        NAMES, np.zeros(10), rng.normal(size=(n, 3)), rng.normal(size=(n, 69)), np.ones((n, 3)), np.ones(n)
    )
    write_poses(root / "body.npz", turned)
    quats = np.tile([1.0, 0, 0, 0], (rows, 1))
    look = (
        rng.normal(size=(rows, 3)),
        quats,
        np.full((rows, 3), 0.1),
        np.full(rows, 0.5),
        np.zeros((rows, 3)),
        np.zeros((rows, 3, 3)),
    )
    write_splats(root / "scene.npz", Scene(*look))
    write_gaussians(root, Scene(*(part.astype(np.float32) for part in look)), rng)
    write_effects(
        root / "effects.npz",
        Effects([0.6, 0.8, 0.0], 0.5, 0.03, 1.4, 0.6, 0.5, -0.3),
    )
    weights = np.eye(24)[rng.integers(0, 24, rows)]
    rest = (weights, rng.normal(size=(24, 3)), np.arange(-1, 23), np.zeros(10), np.zeros(69))
    write_splats(root / "avatar.npz", Avatar(*look, *rest))
    model = BodyModel(
        v_template=rng.normal(size=(VERTICES, 3)),
        faces=rng.integers(0, VERTICES, (40, 3)),
        shapedirs=rng.normal(size=(VERTICES, 3, 10)),
        posedirs=rng.normal(size=(VERTICES, 3, 207)).astype(np.float16),
        J_regressor=np.full((24, VERTICES), 1 / VERTICES),
        lbs_weights=np.eye(24)[rng.integers(0, 24, VERTICES)],
        parents=np.arange(-1, 23),
    )
    for name in ("body_model.npz", "whole.npz"):
        write_body_model(root / name, model)
    with np.load(root / "body_model.npz") as arrays, open(root / "body_model.pkl", "wb") as file:
        pickle.dump(dict(arrays), file, protocol=2)


def write_gaussians(root: Path, scene: Scene, rng: np.random.Generator) -> None:
    """Gaussians as other programs have them."""
    n, f32 = len(scene), np.float32
    write_ply(root / "splats.ply", scene)
    write_spz(root / "splats.spz", scene)
    (root / "unpacked.spz").write_bytes(gzip.decompress((root / "splats.spz").read_bytes()))
    four = rng.integers(0, 24, (n, 8)).astype(np.uint8)
    bytes_, words = np.tile([255, 0, 0, 0], (n, 1)), np.tile([65535] + 7 * [0], (n, 1))
    weights = (four[:, :4], bytes_.astype(np.uint8), np.ones(n), four, words.astype(np.uint16))
    rig = Rig(**vars(scene), joints=rng.normal(size=(24, 3)).astype(f32), parents=np.arange(-1, 23).astype(np.int32),
              **dict(zip(("bones", "weights", "kept", "bones8", "words8"), weights)),
              facing=scene.means, betas=np.zeros(10, f32))  # fmt: skip
    write_splats_glb(root / "avatar_splats.glb", rig, [])


def write_facts(root: Path) -> None:
    """What stages tell each other."""
    from stages import neuman
    from stages.contract import Job

    (root / "frames").mkdir()
    neuman.run(Job(root / "frames"), neuman.Params(), video=root / "bike")
    (root / "film").mkdir()
    listing = {"width": SIDE, "height": SIDE, "video": {"path": "clip.mp4", "frames": len(NAMES)}}
    listing["frames"] = [{"name": name, "index": i, "time_s": i / FPS} for i, name in enumerate(NAMES)]
    (root / "film" / "frames.json").write_text(json.dumps(listing))
    write_split(root / "split.json", "one apart", {name: ("train", i) for i, name in enumerate(NAMES)})
    scores = {"full": {"psnr": 20.5, "ssim": None}}
    metrics = {"heldout": scores, "heldout_fitted": scores, "gaussians": {"human": 3, "scene": 4}, "protocol": "ours"}
    metrics |= {"seconds": {"total": 3.5}, "peak_memory_bytes": 5}
    measure = {"value": 0.5, "unit": "px", "verdict": "good"}
    effect = measure | {"threshold": 0.1, "confidence": 0.5, "frames": ["000003"], "on": True}
    survey = {
        "measures": {"parallax": measure, "points": measure},
        "effects": {"shadow": effect},
        "decisions": {"scene": True},
        "starts": {"shadow": [0.5]},
    }
    (root / "metrics.json").write_text(json.dumps(metrics))
    (root / "survey.json").write_text(json.dumps(survey, indent=1))
    (root / "curve.csv").write_text("step,seconds,psnr,psnr_person\n1,3.5,20.1,18.2\n2,6.5,21.1,\n4,12.5,22.5,20.0\n")


def write_workspace(root: Path) -> None:
    """A finished result and what a workspace remembers."""
    from hugs_cli.cache.fingerprint import Code
    from hugs_cli.cache.workspace import Stamp, Workspace, seal
    from hugs_cli.pipelines import FILE

    shutil.copyfile(FILE, root / "pipelines.yaml")
    (root / "store" / "sub").mkdir(parents=True)
    shutil.copyfile(root / "points.ply", root / "store" / "sub" / "points.ply")
    content, files = seal(root / "store")
    machine = {"host": "h", "device": "cpu", "system": "s", "processors": 2, "versions": {"python": "3.12"}}
    accepted = [{"when": "2026-01-01T00:00:00+00:00", "instead_of": "ab", "changes": ["code a edited"]}]
    made = {"made": "2026-01-01T00:00:00+00:00", "seconds": 1.5, "peak_memory_bytes": 7, "machine": machine}
    Stamp("points", "ab" * 32, 0, {"m": "d"}, {"word": "a"}, {"video": "c"}, content, files, **made, reasons=["first run"],
          notes=["n"], warnings=["w"], accepted=accepted).write(root / "store")  # fmt: skip
    workspace = Workspace(root / "work.mp4", root, "pipeline")
    workspace.create()
    workspace.source("video", root / "points.ply")
    (workspace.links / "frames").mkdir()
    shutil.copyfile(root / "frames" / "frames.json", workspace.links / "frames" / "frames.json")
    code = Code(workspace.root / "code.json")
    code.digests("stages.export")
    code.save()


def write_fits(root: Path, rng: np.random.Generator) -> None:
    """The families of SMPL fits."""
    n = len(NAMES)
    orient, pose, away = 0.3 * rng.normal(size=(n, 3)), 0.3 * rng.normal(size=(n, 69)), np.tile([0.0, 0, 4], (n, 1))
    shape = np.zeros(10)
    named = {
        "names": np.array(NAMES),
        "global_orient": orient,
        "body_pose": pose,
        "transl": away,
        "world_from_sfm": 2.0,
    }
    np.savez(root / "fit_named.npz", betas=shape, **named)
    np.savez(root / "fit_poses.npz", betas=shape, poses=np.concatenate([orient, pose], 1), trans=away)
    still = np.concatenate([np.zeros((n, 3)), pose], 1)
    np.savez(
        root / "fit_zju.npz", betas=np.tile(shape, (n, 1)), Rh=orient, Th=away, poses=still, frame_ids=np.arange(n)
    )


def write_pictures(root: Path, rng: np.random.Generator) -> None:
    """Pictures and a video."""
    smooth = np.kron(rng.integers(0, 255, (SIDE // 8, SIDE // 8, 3), np.uint8), np.ones((8, 8, 1), np.uint8))
    for kind in PICTURES:
        images.write_image(root / kind.file, smooth)
    frames = (rng.integers(0, 255, (SIDE, SIDE, 3), np.uint8).repeat(2, 0).repeat(2, 1) for _ in range(10))
    write_video(root / "clip.mp4", frames, 10.0)


def write_masks(root: Path, rng: np.random.Generator) -> None:
    """Masks of two people in several encodings, one a frame."""
    from tests.made import mask_files

    folder = root / "masks"
    both = np.zeros((2, len(NAMES), SIDE, SIDE), bool)
    both[0, :, 4:20, 3:10], both[1, :, 8:20, 14:19] = True, True
    soft = np.where(both[0], rng.integers(150, 255, both[0].shape), rng.integers(0, 50, both[0].shape)).astype(np.uint8)
    for kind in ("soft", "labels", "cutout", "array"):
        (folder / kind).mkdir(parents=True)
    for name, grey, ids in zip(NAMES, soft, mask_files.ids(*both), strict=True):
        images.write_mask(folder / "soft" / f"{name}.png", grey)
        images.write_mask(folder / "labels" / f"{name}.png", ids)
        images.write_image(folder / "cutout" / f"{name}.png", grey[..., None].repeat(4, 2))
        np.save(folder / "array" / f"{name}.npy", grey.astype(np.float32) / 255)
    mask_files.sam2_palette(folder / "sam2", *both)
    np.save(folder / "stack.npy", both[0])
    np.savez_compressed(folder / "stack.npz", masks=both[0], names=np.array(NAMES))
    mask_files.coco(folder / "coco.json", *both)


def write_tools(root: Path) -> None:
    """What tools that fit bodies, move them and find cameras leave, and a training that broke down."""
    from tests.made import bvh as bvh_made
    from tests.made import camera_files, fits

    truth = fits.make_truth(len(NAMES), SIDE, SIDE)
    truth = replace(truth, numbers=np.arange(len(NAMES)))
    for tool in ("WHAM", "PHALP", "GVHMR", "simple-romp video", "EasyMocap"):
        fits.write(tool, fits.contents(tool, truth), root)
    amass = fits.contents("AMASS", truth)
    np.savez(root / "motion.npz", **{key: amass[key] for key in ("poses", "trans", "mocap_framerate")})  # what is read
    local, rest = bvh_made.matrices(truth.orient, truth.views.body_pose), np.tile(np.eye(3), (24, 1, 1))
    bvh_made.write_bvh(root / "motion.bvh", truth.views.joints[0], local, truth.pelvis, rest)
    cameras = replace(still_cameras(), viewmats=truth.viewmats, Ks=truth.views.Ks)
    camera_files.colmap(root / "colmap", cameras, truth.world_joints()[0], model="OPENCV")
    camera_files.nerfstudio(root / "transforms.json", cameras)
    facts = {"step": 3, "frame": "000001", "error": "e", "threads": 1, "device": "cpu", "seed": 0, "params": {}}
    write_failure(root / "failure.npz", b"state", facts | {"sfm": "a", "smpl": "b", "survey": "c", "decisions": {}})
