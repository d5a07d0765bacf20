"""Cameras of other programs in place of sfm: layouts made from true cameras come back, wrong ones are refused by name."""

from __future__ import annotations

import json
import struct
import weakref
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages import sfm
from stages.contract import Job, StageError
from stages.estimators.cameras import colmap, given
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.datasets.undistorted import HELD
from stages.formats.facts import Listing, Sfm, parse, read_facts
from stages.formats.given_cameras.recognize import read_camera_files
from stages.formats.given_cameras.record import PARAMS, Lens
from stages.formats.images import write_image, write_mask
from stages.formats.points import read_points
from stages.records import Cameras
from tests.made import camera_files as files
from tests.made.datasets import points_of
from tests.made.rooms import FOCAL, HEIGHT, WALLS, WIDTH, walk, write_clip
from tests.made.said import any_holds, holds
from tests.made.synthetic.clip import make_clip
from tests.made.truth import align, camera_errors

FRAMES, TOTAL = 10, 30


@pytest.fixture(scope="module")
def clip():
    """The synthetic clip's first pictures, small."""
    return make_clip(read_body_model(), width=96, height=128, frames=FRAMES, novel=1).frames


@pytest.fixture(scope="module")
def truth(clip):
    """Its cameras; frame i is every third of the video."""
    return Cameras(tuple(f"{3 * i:06d}" for i in range(FRAMES)), clip.viewmats, clip.Ks, 96, 128)


@pytest.fixture(scope="module")
def points(clip):
    """Points on the room's walls with their colours."""
    found = []
    for i, x, y in points_of(clip, 300):
        ray = np.linalg.inv(clip.Ks[i]) @ [x + 0.5, y + 0.5, 1.0] * clip.depths[i, y, x]
        found.append((clip.viewmats[i, :3, :3].T @ (ray - clip.viewmats[i, :3, 3]), clip.images[i, y, x]))
    return tuple(np.array(part) for part in zip(*found, strict=True))


@pytest.fixture(scope="module")
def stages(clip, truth, tmp_path_factory):
    """Folders frames/ and masks/ as the stages before leave them."""
    folder = tmp_path_factory.mktemp("stages")
    for kind in ("frames/images", "masks/masks"):
        (folder / kind).mkdir(parents=True)
    for name, image, mask in zip(truth.names, clip.images, clip.masks, strict=True):
        write_image(folder / "frames/images" / f"{name}.png", image)
        write_mask(folder / "masks/masks" / f"{name}.png", mask)
    (folder / "masks/masks.json").write_text(json.dumps({"source": "imported"}))
    (folder / "frames/frames.json").write_text(json.dumps(listing(truth)))
    return folder


def listing(truth: Cameras, **sources: str) -> dict:
    rows = [{"name": name, "index": int(name), "time_s": int(name) / 12} for name in truth.names]
    rows = [{**row, "source": sources[row["name"]]} if sources else row for row in rows]
    return {
        "width": truth.width,
        "height": truth.height,
        "frames": rows,
        "video": {"path": "clip.mp4", "frames": TOTAL},
    }


def read(path: Path, truth: Cameras, **settings):
    """The cameras of a file at the frames, and what was said."""
    said: list[str] = []
    job = Job(path.parent, emit=lambda event: said.append(event.get("text", "")))
    listed = parse(json.dumps(settings.pop("listing", listing(truth))), Listing)
    found = given.import_cameras(job, path, listed, **{"min_share": 0.5, "first": "auto"} | settings)
    return found, Cameras(tuple(found.names), found.viewmats, found.Ks, truth.width, truth.height), said


LAYOUTS = {
    "COLMAP binary": lambda folder, truth: files.colmap(folder / "model", truth),
    "COLMAP text": lambda folder, truth: files.colmap(folder / "model", truth, text=True),
    "COLMAP project": lambda folder, truth: files.colmap(folder / "sparse" / "0", truth).parents[1],
    "COLMAP sparse": lambda folder, truth: files.colmap(folder / "sparse" / "0", truth).parent,
    "COLMAP of larger pictures": lambda folder, truth: files.colmap(folder, truth, scale=2.5, model="SIMPLE_PINHOLE"),
    "instant-ngp": lambda folder, truth: files.instant_ngp(folder / "transforms.json", truth),
    "instant-ngp of larger pictures": lambda folder, truth: files.instant_ngp(folder / "transforms.json", truth, 4.0),
    "nerfstudio": lambda folder, truth: files.nerfstudio(folder / "transforms.json", truth).parent,
    "NeRF synthetic": lambda folder, truth: files.blender(folder / "transforms_train.json", truth),
    "ours": lambda folder, truth: ours(folder, truth),
}


def ours(folder: Path, truth: Cameras) -> Path:
    write_cameras(folder / "cameras.npz", replace(truth, viewmats=files.moved(truth)))
    return folder / "cameras.npz"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_cameras_in_every_layout_come_back(tmp_path, truth, layout):
    found, cameras, _ = read(LAYOUTS[layout](tmp_path, truth), truth)
    errors = camera_errors(cameras, truth, FRAMES)
    assert errors.registered == 1 and errors.worst < 1e-6 and errors.turn_degrees < 1e-5  # 1 mm, 0.1 degree are the bar
    np.testing.assert_allclose(cameras.Ks, truth.Ks, atol=1e-6)
    assert found.verdict == "moving" and {found.grid_of(name) for name in found.names} == {None}
    if layout not in ("instant-ngp", "instant-ngp of larger pictures"):  # which turns the world further
        np.testing.assert_allclose(found.viewmats, files.moved(truth), atol=1e-6)


def test_a_models_points_are_taken_and_the_rest_of_sfm_is_as_ever(tmp_path, truth, points, stages):
    model = files.colmap(tmp_path / "model", truth, *points)
    (tmp_path / "out").mkdir()
    said: list[str] = []
    job = Job(tmp_path / "out", emit=lambda event: said.append(event.get("text", "")))
    sfm.run(job, sfm.Params(), frames=stages / "frames", masks=stages / "masks", cameras=model)
    found = read_cameras(tmp_path / "out/cameras.npz")
    assert camera_errors(found, truth, FRAMES).worst < 1e-6
    xyz, _ = read_points(tmp_path / "out/points.ply")
    facts = json.loads((tmp_path / "out/sfm.json").read_text())
    assert facts["points"] == len(xyz) > 200 and facts["focal_source"] == "given" and facts["median_track"] == FRAMES
    assert facts["verdict"] == "moving" and 5 < facts["median_triangulation_deg"] < 60 and facts["dropped"] == []
    placed = align(found, truth).to_truth(xyz)
    assert np.abs(placed[:, None] - points[0]).max(-1).min(1).max() < 1e-4, "each is one of the true points"
    assert any("COLMAP model (bin)" in text for text in said) and facts["colour_correlation"] > 0.8
    import pycolmap

    sparse = pycolmap.Reconstruction(tmp_path / "out/sparse")
    assert sparse.num_points3D() == len(xyz) and sparse.num_reg_images() == FRAMES


@pytest.mark.parametrize("seen", [0, 1])
def test_points_of_a_program_that_keeps_no_tracks_are_kept(tmp_path, truth, points, stages, seen):
    """VGGT's and MASt3R's models: no errors, and a point is seen by one picture or none."""
    model = files.colmap(tmp_path / "model", truth, *points, text=True)
    lines = [line.split() for line in (model / "points3D.txt").read_text().splitlines() if not line.startswith("#")]
    lines = [[*line[:7], "-1", *line[8 : 8 + 2 * seen]] for line in lines]
    (model / "points3D.txt").write_text("\n".join(map(" ".join, lines)))
    (tmp_path / "out").mkdir()
    said: list[str] = []
    job = Job(tmp_path / "out", emit=lambda event: said.append(event.get("text", "")))
    sfm.run(job, sfm.Params(), frames=stages / "frames", masks=stages / "masks", cameras=model)
    facts = read_facts(tmp_path / "out/sfm.json", Sfm)
    assert len(read_points(tmp_path / "out/points.ply")[0]) > 200
    assert facts.median_triangulation_deg is None and facts.reprojection_px is None
    assert any_holds(said, 3, "pictures", "kept")
    assert not any("no colours" in text for text in said)


def test_points_of_another_clip_are_doubted(tmp_path, truth, points, stages):
    """The cameras of the clip backwards: all numbers are fine, only the pictures tell."""
    wrong = replace(truth, viewmats=truth.viewmats[::-1].copy())
    turned = points[0] @ Rotation.from_euler("y", 40, degrees=True).as_matrix().T
    model = files.colmap(tmp_path / "model", wrong, turned, points[1])
    (tmp_path / "out").mkdir()
    said: list[str] = []
    job = Job(tmp_path / "out", emit=lambda event: said.append(event.get("text", "")))
    sfm.run(job, sfm.Params(), frames=stages / "frames", masks=stages / "masks", cameras=model)
    assert any_holds(said, "another clip")


@pytest.mark.slow
def test_cameras_without_points_get_them_by_triangulation(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.made.rooms.K1", 1e-12)
    views = walk(8, 1.2)
    write_clip(tmp_path, views)
    names = tuple(f"{3 * i:06d}" for i in range(8))
    facts = json.loads((tmp_path / "frames/frames.json").read_text()) | {"video": {"path": "clip.mp4", "frames": 22}}
    (tmp_path / "frames/frames.json").write_text(json.dumps(facts))
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    truth = Cameras(names, views, np.tile(K, (8, 1, 1)), WIDTH, HEIGHT)

    def run(out: str, path: Path) -> dict:
        (tmp_path / out).mkdir()
        job, params = Job(tmp_path / out), sfm.Params(features=512)
        sfm.run(job, params, frames=tmp_path / "frames", masks=tmp_path / "masks", cameras=path)
        return json.loads((tmp_path / out / "sfm.json").read_text())

    facts = run("out", files.nerfstudio(tmp_path / "transforms.json", truth))
    found = read_cameras(tmp_path / "out/cameras.npz")
    assert camera_errors(found, truth, 8).worst < 1e-6 and facts["epipolar_px"] < 0.3 and facts["reprojection_px"] < 0.5

    placed = align(found, truth).to_truth(read_points(tmp_path / "out/points.ply")[0])
    away = np.min([abs(placed @ normal - offset) for normal, offset, _ in WALLS], 0)
    assert len(placed) > 200 and np.median(away) < 0.02
    wrong = replace(truth, viewmats=truth.viewmats[::-1].copy())
    with pytest.raises(StageError, match="frames") as error:
        run("again", files.nerfstudio(tmp_path / "wrong.json", wrong))
    assert holds(error.value.facts[0], "px", "epipolar")


@pytest.mark.parametrize(
    ("model", "scale"), [*((model, 2.0) for model in files.LENSES), ("OPENCV", 1.0), ("FISHEYE", 1.0)]
)
def test_a_dot_seen_through_every_lens_lands_where_the_pinhole_sees_it(truth, model, scale):
    big = replace(truth, width=300, height=240, Ks=np.array([[[260.0, 0, 152], [0, 262, 118], [0, 0, 1]]]))
    if model == "FISHEYE":  # which bends without any distortion
        lens = Lens("OPENCV_FISHEYE", (260.0, 262, 152, 118, 0, 0, 0, 0), 300, 240)
    else:
        lens = Lens(model, tuple(files.intrinsics(big, model, scale)), round(300 * scale), round(240 * scale))
    K, bends, shift = given.straighten(lens, 300, 240)
    grid = given.sample_grid(lens, K, 300, 240)
    assert shift > 0.5 and bends
    y, x = np.mgrid[:240, :300] + 0.5
    for ray in np.array([[0.0, 0.0, 1], [0.25, 0.2, 1], [-0.28, 0.11, 1], [0.1, -0.22, 1]]):
        u, v = colmap.camera_of(lens).img_from_cam(ray[None])[0] / scale
        seen = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8).astype(np.float32)
        flat = cv2.remap(seen, *grid, cv2.INTER_CUBIC)
        found = np.array([(flat * x).sum(), (flat * y).sum()]) / flat.sum()
        assert np.abs(found - (K @ ray)[:2]).max() < 0.1
    assert grid[0].min() >= -0.51 and grid[0].max() <= 299.51 and grid[1].min() >= -0.51 and grid[1].max() <= 239.51


def test_of_frames_that_have_a_lens_each_no_more_than_a_few_grids_are_held(tmp_path, truth, monkeypatch):
    held, every, made = [], [], given.sample_grid

    def sample_grid(*told):
        found = made(*told)
        held.append(weakref.ref(found[0]))
        every.append(sum(ref() is not None for ref in held))
        return found

    lens = Lens("SIMPLE_RADIAL", (150.0, 48, 64, 0.1), 96, 128)
    zooming = [replace(lens, params=(150.0 + i, *lens.params[1:])) for i in range(len(truth))]
    given_cameras = replace(read_camera_files(ours(tmp_path, truth), 96, 128), lenses=tuple(zooming))
    monkeypatch.setattr(given, "read_camera_files", lambda *_: given_cameras)
    monkeypatch.setattr(given, "sample_grid", sample_grid)
    found, _, _ = read(tmp_path / "cameras.npz", truth)
    assert not held, "none before a frame asks for it"
    spots = {float(found.grid_of(name)[0][0, 0]) for name in found.names}
    assert len(spots) == len(truth) > HELD + 1 and max(every) <= HELD + 1


def test_a_lens_that_sees_sideways_is_refused(truth):
    with pytest.raises(StageError, match="pinhole") as error:
        given.straighten(Lens("OPENCV_FISHEYE", (20, 20, 48, 64, 0, 0, 0, 0), 96, 128), 96, 128)
    assert "OPENCV_FISHEYE 20" in error.value.facts[0]


def test_lens_models_have_colmaps_numbers():
    import pycolmap

    for number, (model, params) in enumerate(PARAMS.items()):
        camera = pycolmap.Camera.create_from_model_name(1, model, 50.0, 100, 100)
        assert int(camera.model) == number and len(camera.params) == len(params.split())


def test_frames_are_joined_by_number_or_by_name_and_doubt_is_refused(tmp_path, truth):
    every = tuple(f"frame_{i + 1:05d}" for i in range(TOTAL))
    views = np.repeat(truth.viewmats, 3, 0)
    of_video = Cameras(every, views, np.repeat(truth.Ks, 3, 0), 96, 128)
    found, _, _ = read(files.instant_ngp(tmp_path / "one.json", of_video), truth)
    assert found.names == list(truth.names)
    cut = Cameras(every[:-2], views[:-2], of_video.Ks[:-2], 96, 128)
    path = files.instant_ngp(tmp_path / "cut.json", cut)
    with pytest.raises(StageError, match="names") as error:
        read(path, truth)
    assert holds(error.value.facts[0], "frame_00001.jpg", "frame_00028.jpg", "30 frames")
    _, cameras, _ = read(path, truth, first=1)
    assert camera_errors(cameras, truth, FRAMES).turn_degrees < 1e-5
    named = listing(truth, **{name: f"IMG_{int(name) + 40}" for name in truth.names})
    renamed = replace(truth, names=tuple(f"IMG_{int(name) + 40}" for name in truth.names))
    _, cameras, _ = read(files.instant_ngp(tmp_path / "named.json", renamed), truth, listing=named)
    assert camera_errors(cameras, truth, FRAMES).worst < 1e-6


def test_frames_without_a_camera_are_left_out_and_said(tmp_path, truth):
    some = [0, 1, 2, 4, 5, 6, 9]
    part = replace(truth, names=tuple(truth.names[i] for i in some), viewmats=truth.viewmats[some], Ks=truth.Ks[some])
    found, _, said = read(files.colmap(tmp_path / "model", part), truth)
    assert found.names == list(part.names) and any_holds(said, "3 of 10 frames")
    with pytest.raises(StageError, match="3 of 10 frames") as error:
        read(tmp_path / "model", truth, min_share=0.8)
    assert "000009, 000021, 000024" in error.value.facts[0]


def test_a_camera_that_stands_or_only_turns_is_named(tmp_path, truth):
    still = replace(truth, viewmats=np.tile(truth.viewmats[0], (FRAMES, 1, 1)))
    found, _, said = read(files.instant_ngp(tmp_path / "a.json", still), truth)
    assert found.verdict == "static camera" and any("stand still" in text for text in said)
    turning = still.viewmats.copy()
    turning[:, :3] = Rotation.from_euler("y", np.arange(FRAMES)[:, None], degrees=True).as_matrix() @ turning[:, :3]
    turning = replace(still, viewmats=turning)
    assert read(files.instant_ngp(tmp_path / "b.json", turning), truth)[0].verdict == "rotation only"


def put(*keys):
    """A change of transforms.json: the value at the end of the path of keys before it."""
    *path, value = keys

    def change(path_to_file: Path) -> None:
        content = json.loads(path_to_file.read_text())
        place = content
        for key in path[:-1]:
            place = place[key]
        if value is None:
            del place[path[-1]]
        else:
            place[path[-1]] = value
        path_to_file.write_text(json.dumps(content))

    return change


FRAME = ("frames", 3)
IDENTITY = np.eye(4).tolist()
MALFORMED_JSON = {
    "no JSON": (lambda path: path.write_text('{"frames": ['), "is not JSON", ""),
    "a list": (lambda path: path.write_text("[1]"), "has no frames", "a list"),
    "no frames": (put("frames", None), "has no frames", "camera_angle_x"),
    "empty frames": (put("frames", []), "has no frames", "fl_x"),
    "frame of text": (put(*FRAME, "x"), "frame 3 .*file_path", "a str"),
    "no file_path": (put(*FRAME, "file_path", None), "frame 3 .*file_path", "transform_matrix"),
    "no matrix": (put(*FRAME, "transform_matrix", None), "000009.jpg .*transform_matrix", "4x4"),
    "matrix 3x3": (put(*FRAME, "transform_matrix", np.eye(3).tolist()), "wrong shape", "found 3x3, wanted 4x4"),
    "ragged matrix": (put(*FRAME, "transform_matrix", [[1, 2], [3]]), "does not hold numbers", ""),
    "matrix of text": (put(*FRAME, "transform_matrix", [["a"] * 4] * 4), "does not hold numbers", ""),
    "NaN": (put(*FRAME, "transform_matrix", 1, 2, float("nan")), "000009.jpg.* not finite", "row 1, column 2"),
    "no rotation": (put(*FRAME, "transform_matrix", (np.eye(4) * 1.2).tolist()), "not a rotation", "last row"),
    "sheared": (put(*FRAME, "transform_matrix", np.diag([1.1, 1, 1, 1]).tolist()), "not a rotation", "off by 0.21"),
    "mirrored": (put(*FRAME, "transform_matrix", np.diag([1.0, 1, -1, 1]).tolist()), "mirrored", "is -1"),
    "mirrored world": (put("applied_transform", np.diag([1.0, -1, 1, 1]).tolist()), "mirrored", "is -1"),
    "no focal": (lambda path: [put(key, None)(path) for key in ("fl_x", "camera_angle_x")], "neither fl_x nor", "w, h"),
    "focal of text": (put("fl_x", "wide"), "fl_x .*number", "'wide'"),
    "no size": (put("w", None), "no picture size", "121.6"),
    "size 0": (put("w", 0), "has no picture size", "0x128"),
    "size infinite": (put("h", float("inf")), "h .*number", "inf"),
    "nested without end": (lambda path: path.write_text("[" * 100000), "is not JSON", "recursion"),
    "focal of another size": (put("fl_x", 608.0), "another size", "608 px, .* gives 121.6 px"),
    "centre of another size": (put("cx", 240.0), "another size", r"\(240, 64\) px.*96x128"),
    "focal 0": (lambda path: [put("camera_angle_x", None)(path), put("fl_x", 0)(path)], "no usable focal", "0, 121.6"),
    "focal NaN": (put("fl_y", float("nan")), "fl_y .*number", "nan"),
    "field of view in degrees": (put("camera_angle_x", 43.0), "field of view", "43, wanted 0 to 3.14"),
    "unknown lens": (put("camera_model", "EQUIRECTANGULAR"), "is not supported", "it is EQUIRECTANGULAR"),
    "k4 of a perspective lens": (put("k4", 0.1), "perspective lens", "k4 is 0.1"),
    "another shape": (lambda path: [put("w", 128)(path), put("cx", 64)(path), put("camera_angle_x", None)(path)],
                      "not for these frames", "128x128, frames 96x128"),
    "two sizes": (put(*FRAME, "h", 127), "different sizes", "96x127, 96x128"),
    "one frame twice": (put(*FRAME, "file_path", "elsewhere/000000.png"), "two cameras", "000000"),
    "names of other frames": (lambda path: [put("frames", i, "file_path", f"DSC{i + 500}.jpg")(path) for i in range(10)],
                              "names", "DSC500.jpg"),
    "names without numbers": (lambda path: [put("frames", i, "file_path", "abcdefghij"[i])(path) for i in range(10)],
                              "10 of 10 frames", "missing: 000000"),
}  # fmt: skip


@pytest.mark.parametrize("kind", MALFORMED_JSON)
def test_a_malformed_transforms_json_is_refused_by_name(tmp_path, truth, kind):
    change, problem, fact = MALFORMED_JSON[kind]
    path = files.instant_ngp(tmp_path / "transforms.json", truth)
    change(path)
    refused(path, truth, problem, fact)


def refused(path: Path, truth: Cameras, problem: str, fact: str) -> None:
    """It is refused by the error contract: what is wrong, facts with numbers or names, a hint."""
    with pytest.raises(StageError, match=problem) as error:
        read(path, truth)
    import re

    assert error.value.hint and error.value.facts and not error.value.problem.endswith(".")
    assert re.search(fact, "\n".join(error.value.facts)), error.value.facts


def cut(name: str, size: int):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def patch(name: str, at: int, layout: str, value):
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        struct.pack_into("<" + layout, data, at, value)
        (folder / name).write_bytes(bytes(data))

    return change


def swap(name: str, old: str, new: str):
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def line_of(name: str, row: int, column: int, value: str | None):
    """Change (or leave out the rest from) one word of a row that is no comment."""

    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        at = [i for i, line in enumerate(lines) if not line.startswith("#")][row]
        words = lines[at].split()
        words = words[:column] if value is None else [*words[:column], value, *words[column + 1 :]]
        lines[at] = " ".join(words)
        (folder / name).write_text("\n".join(lines) + "\n")

    return change


MALFORMED_BINARY = {
    "no cameras.bin": (lambda folder: (folder / "cameras.bin").unlink(), "lacks cameras.bin", "images.bin"),
    "no points3D.bin": (lambda folder: (folder / "points3D.bin").unlink(), "lacks points3D.bin", "images.bin"),
    "no images at all": (lambda folder: (folder / "images.bin").unlink(), "no cameras in", "points3D.bin"),
    "empty images.bin": (cut("images.bin", 0), "images.bin", "8 bytes .*byte 0"),
    "images.bin cut short": (cut("images.bin", 300), "images.bin", "the file has 300"),
    "name cut short": (cut("images.bin", 75), "images.bin", "the file has 75"),
    "points3D.bin cut short": (cut("points3D.bin", 99), "points3D.bin", "the file has 99"),
    "too many announced": (patch("images.bin", 0, "Q", 1 << 60), "images.bin", "are wanted from byte"),
    "too few announced": (patch("images.bin", 0, "Q", 4), "images.bin", "follow the 4 rows"),
    "no pictures": (lambda folder: (folder / "images.bin").write_bytes(bytes(8)), "no picture has a camera", "0"),
    "unknown lens": (patch("cameras.bin", 12, "i", 17), "camera 7 .*not supported", "number 17, known are 0 SI"),
    "no size": (patch("cameras.bin", 16, "Q", 0), "camera 7 .*no picture size", "0x128"),
    "focal NaN": (patch("cameras.bin", 32, "d", float("nan")), "not finite", "fx = nan"),
    "focal of another size": (patch("cameras.bin", 32, "d", 6e5), "no usable focal length", "600000.* 96x128"),
    "quaternion 0": (lambda folder: [patch("images.bin", 12 + 8 * i, "d", 0.0)(folder) for i in range(4)],
                     "000027.png in .* not finite|00000..png in .* not finite", "row 0"),
    "translation inf": (patch("images.bin", 44, "d", float("inf")), "not finite", "column 3: inf"),
    "camera unknown": (patch("images.bin", 68, "I", 99), "lacks cameras", "1 of 10 pictures; first .* with camera 99"),
    "point NaN": (patch("points3D.bin", 16, "d", float("nan")), "points .*not finite", "1 of 300"),
    "track cut": (patch("points3D.bin", 51, "Q", 1 << 40), "points3D.bin", "bytes are wanted"),
}  # fmt: skip


@pytest.mark.parametrize("kind", MALFORMED_BINARY)
def test_a_malformed_binary_model_is_refused_by_name(tmp_path, truth, points, kind):
    change, problem, fact = MALFORMED_BINARY[kind]
    model = files.colmap(tmp_path / "model", truth, *points)
    change(model)
    refused(model, truth, problem, fact)


MALFORMED_TEXT = {
    "unknown lens": (
        swap("cameras.txt", "PINHOLE", "EUCM"),
        "line .* is not supported",
        "it is EUCM, known are SIMPLE",
    ),
    "camera of words": (line_of("cameras.txt", 0, 2, "wide"), "line .* camera", "wide"),
    "too few numbers": (
        line_of("cameras.txt", 0, 7, None),
        "camera model",
        "found 3 numbers, PINHOLE",
    ),
    "no cameras": (lambda folder: (folder / "cameras.txt").write_text("# none\n"), "lacks cameras", "10 of 10"),
    "picture cut short": (line_of("images.txt", 0, 6, None), "line .* picture", "it is: "),
    "picture of words": (line_of("images.txt", 2, 3, "north"), "line .* picture", "north"),
    "picture NaN": (line_of("images.txt", 0, 5, "nan"), "not finite", "row 0, column 3"),
    "no text": (lambda folder: (folder / "images.txt").write_bytes(b"\xff\xfe\x00"), "cannot read", "utf-8"),
    "point cut short": (line_of("points3D.txt", 5, 4, None), "line .* point", "it is: "),
    "point inf": (line_of("points3D.txt", 5, 2, "inf"), "points .*not finite", "1 of 300"),
}


@pytest.mark.parametrize("kind", MALFORMED_TEXT)
def test_a_malformed_text_model_is_refused_by_name(tmp_path, truth, points, kind):
    change, problem, fact = MALFORMED_TEXT[kind]
    model = files.colmap(tmp_path / "model", truth, *points, text=True)
    change(model)
    refused(model, truth, problem, fact)


def test_what_is_no_camera_file_is_refused(tmp_path, truth):
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", truth, "no cameras", "nothing")
    (tmp_path / "database.db").write_bytes(b"SQLite format 3\0")
    refused(tmp_path / "database.db", truth, "no cameras", ".db")
    files.colmap(tmp_path / "two" / "sparse" / "0", truth)
    files.colmap(tmp_path / "two" / "sparse" / "1", truth)
    refused(tmp_path / "two", truth, "2 sets of cameras", "sparse/0, sparse/1")
    np.savez(tmp_path / "masks.npz", masks=np.zeros((3, 4, 4)))
    refused(tmp_path / "masks.npz", truth, "Ks, height, viewmats, width", "masks")


def test_any_cut_of_a_binary_model_is_refused_or_whole(tmp_path, truth):
    """No length of images.bin gives fewer cameras in silence."""
    model = files.colmap(tmp_path / "model", truth)
    data = (model / "images.bin").read_bytes()
    for size in range(0, len(data), 7):
        (model / "images.bin").write_bytes(data[:size])
        with pytest.raises(StageError):
            read_camera_files(model, 96, 128)


@pytest.mark.parametrize(
    ("theirs", "ours", "same"),
    [
        ((1920, 1080), (960, 540), True),
        ((1921, 1080), (960, 540), True),  # rounded
        ((480, 270), (960, 540), True),
        ((1080, 1920), (540, 960), True),
        ((1924, 1075), (960, 540), False),  # COLMAP's undistorted pictures
        ((1920, 1088), (1920, 1080), False),  # as they are coded
        ((1912, 1080), (1920, 1080), False),  # cropped
        ((1440, 1080), (1920, 1080), False),
    ],
)
def test_pictures_of_another_shape_are_told_from_resized_ones(theirs, ours, same):
    assert (given.shape_off(theirs, ours) == 0) == same
