import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages import sfm
from stages.avatar.cameras import lens
from stages.avatar.cameras import pinhole as cameras
from stages.contract import Job, StageError
from stages.estimators.cameras.sparse_model import write_ignored
from stages.formats.cameras import read_cameras
from stages.formats.images import read_image, read_mask, write_image, write_mask
from stages.formats.points import read_points
from tests.made.worlds import umeyama

WIDTH, HEIGHT, FOCAL, K1 = 320, 240, 300.0, 0.06


READERS = [(read_image, "images"), (read_mask, "masks")]


def texture(seed: int) -> np.ndarray:
    """A picture with detail at every scale, uint8 [1024,1024,3]."""
    rng = np.random.default_rng(seed)
    total = np.zeros((1024, 1024, 3), np.float32)
    for size in (16, 32, 64, 128, 256, 512):
        noise = rng.normal(size=(size, size, 3)).astype(np.float32)
        total += cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    total = (total - total.min()) / np.ptp(total)
    return (255 * total).astype(np.uint8)


WALLS = [  # plane n.x = d with its texture; a corner of a room with a screen in front
    (np.array([0.0, 0, 1]), 7.0, texture(0)),
    (np.array([0.0, 1, 0]), 1.5, texture(1)),
    (np.array([0.9, 0, 0.435]), 5.0, texture(2)),
]


def photograph(view: np.ndarray) -> np.ndarray:
    """The room through a SIMPLE_RADIAL lens, uint8 [H,W,3]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ideal = lens.undistort(np.stack([x - WIDTH / 2, y - HEIGHT / 2], -1) / FOCAL, K1)
    rays = np.concatenate([ideal, np.ones((HEIGHT, WIDTH, 1))], -1) @ view[:3, :3]
    eye = cameras.camera_centers(view)
    image, nearest = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH), np.inf)
    for normal, offset, picture in WALLS:
        distance = (offset - eye @ normal) / np.where(abs(rays @ normal) < 1e-9, 1e-9, rays @ normal)
        hit = eye + rays * distance[..., None]
        axes = np.delete(np.arange(3), abs(normal).argmax())
        grid = (hit[..., axes] * 40 % 1023).astype(np.float32)
        seen = cv2.remap(picture, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
        front = (distance > 0) & (distance < nearest)
        image[front], nearest[front] = seen[front], distance[front]
    return image


def write_clip(folder, views: np.ndarray, person: bool = True) -> None:
    """frames/ and masks/ of a clip of the room; the "person" is a patch that slides the other way."""
    for kind in ("frames/images", "masks/masks"):
        (folder / kind).mkdir(parents=True)
    listing, patch = [], texture(9)
    for i, view in enumerate(views):
        image, mask, left = photograph(view), np.zeros((HEIGHT, WIDTH), np.uint8), 190 - 6 * i
        if person:
            image[60:, left : left + 70] = patch[100 : 100 + HEIGHT - 60, 300:370]
            mask[60:, left : left + 70] = 255
        write_image(folder / "frames/images" / f"{3 * i:06d}.png", image)
        write_mask(folder / "masks/masks" / f"{3 * i:06d}.png", mask)
        listing.append({"name": f"{3 * i:06d}", "index": 3 * i, "time_s": i / 10, "sharpness": 1.0})
    facts = {"width": WIDTH, "height": HEIGHT, "frames": listing, "dropped": {}}
    facts["video"] = {"path": "clip.mp4", "frames": 3 * len(views)}
    (folder / "frames/frames.json").write_text(json.dumps(facts))


def walk(count: int, travel: float, turn: float = 6.0) -> np.ndarray:
    phase = np.linspace(-1, 1, count)
    views = np.tile(np.eye(4), (count, 1, 1))
    angles = np.stack([-turn * phase, 3 * np.sin(4 * phase), 0 * phase], 1)
    views[:, :3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    at = np.stack([travel * phase, 0.2 * travel * np.sin(3 * phase), 0.2 * travel * phase**2], 1)
    views[:, :3, 3] = -(views[:, :3, :3] @ at[..., None])[..., 0]
    return views


def run(folder, **settings) -> tuple[dict, list[dict]]:
    events: list[dict] = []
    out = folder / "out"
    out.mkdir()
    job = Job(out, emit=events.append)
    sfm.run(job, sfm.Params(**settings), frames=folder / "frames", masks=folder / "masks")
    return json.loads((out / "sfm.json").read_text()), events


@pytest.mark.slow
def test_i04_i07_a_walk_past_a_room_is_reconstructed_with_its_lens(tmp_path):
    views = walk(16, 1.2)
    write_clip(tmp_path, views)
    facts, events = run(tmp_path)
    assert facts["verdict"] == "moving" and facts["registered"] >= 15
    assert facts["focal_px"] == pytest.approx(FOCAL, rel=0.03)
    assert facts["distortion"]["params"][0] == pytest.approx(K1, abs=0.02) and facts["reprojection_px"] < 1
    found = read_cameras(tmp_path / "out/cameras.npz")
    truth = cameras.camera_centers(views[[int(name) // 3 for name in found.names]])
    scale, R, t = umeyama(found.centers, truth)
    off = np.linalg.norm(scale * found.centers @ R.T + t - truth, axis=1)
    assert off.max() < 0.02 * 2.4  # of the path's length
    xyz, rgb = read_points(tmp_path / "out/points.ply")
    placed = scale * xyz @ R.T + t
    to_wall = np.min([abs(placed @ normal - offset) for normal, offset, _ in WALLS], 0)
    assert len(xyz) > 300 and np.median(to_wall) < 0.1 and rgb.std() > 5
    # the pinhole camera explains the undistorted pictures: points have the colour of the pixel they fall on
    pixels, z = cameras.project(xyz.astype(float), found.viewmats[4], found.Ks[4])
    shown = (z > 0) & (pixels > 1).all(1) & (pixels < [WIDTH - 1, HEIGHT - 1]).all(1)
    image, mask = (read(tmp_path / f"out/{kind}/{found.names[4]}.png") for read, kind in READERS)
    x, y = pixels[shown].astype(int).T
    background = mask[y, x] == 0
    off = np.abs(image[y, x].astype(int) - rgb[shown])[background]
    assert background.sum() > 50 and np.median(off) < 8
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "cameras.npz",
        "images",
        "masks",
        "points.ply",
        "sfm.json",
        "sparse",
    ]
    import pycolmap

    model = pycolmap.Reconstruction(tmp_path / "out/sparse")
    assert model.num_points3D() == len(xyz) and model.cameras[1].model_name == "PINHOLE"
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1
    progress = [event["done"] for event in events if event["event"] == "progress"]
    assert progress == sorted(progress) and progress[-1] >= 99


@pytest.mark.slow
def test_i01_a_turning_camera_is_named_and_keeps_its_rotations(tmp_path):
    views = walk(12, 0.0, turn=12.0)
    write_clip(tmp_path, views)
    facts, events = run(tmp_path, features=1024)
    assert facts["verdict"] == "rotation only" and facts["points"] == 0 and facts["registered"] == 12
    assert any("only turns" in event.get("text", "") for event in events if event["event"] == "warning")
    found = read_cameras(tmp_path / "out/cameras.npz")
    truth = views[:, :3, :3] @ views[0, :3, :3].T
    off = Rotation.from_matrix(found.viewmats[:, :3, :3] @ truth.mT).magnitude()
    assert np.degrees(off).max() < 0.5 and np.allclose(found.viewmats[:, :3, 3], 0)
    assert facts["focal_px"] == pytest.approx(FOCAL, rel=0.05)


def test_a26_a_standing_camera_is_named_and_its_frames_are_left_alone(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (5, 1, 1)))
    facts, events = run(tmp_path, features=512)
    assert facts["verdict"] == "static camera" and facts["registered"] == 5 and facts["focal_source"] == "guessed"
    texts = " ".join(event["text"] for event in events if event["event"] == "warning")
    assert "stands still" in texts and "sfm.focal" in texts
    found = read_cameras(tmp_path / "out/cameras.npz")
    assert np.array_equal(found.viewmats, np.tile(np.eye(4), (5, 1, 1))) and found.Ks[0, 0, 0] == 1.2 * WIDTH
    source, target = (tmp_path / folder / "images/000006.png" for folder in ("frames", "out"))
    assert source.read_bytes() == target.read_bytes()


def test_a_fixed_camera_needs_no_features(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (2, 1, 1)))
    facts, _ = run(tmp_path, camera="fixed", focal=444.0)
    assert facts["verdict"] == "static camera" and facts["focal_px"] == 444 and facts["focal_source"] == "given"
    assert len(read_points(tmp_path / "out/points.ply")[0]) == 0


@pytest.mark.parametrize(("how", "k", "straightened"), [
    ("auto", K1, True), ("never", K1, False), ("auto", -1e-3, False), ("always", -1e-3, True),
])  # fmt: skip
def test_a_lens_is_taken_out_where_it_shows_unless_settings_say_otherwise(how, k, straightened, tmp_path, monkeypatch):
    write_clip(tmp_path, walk(3, 0.2))
    names, center = [f"{3 * i:06d}" for i in range(3)], (WIDTH / 2, HEIGHT / 2)
    found = sfm.Solution("static camera", names, np.tile(np.eye(4), (3, 1, 1)), FOCAL, center, k)
    monkeypatch.setattr(sfm, "solve", lambda *_: found)
    facts, _ = run(tmp_path, undistort=how)
    before, after = (read_image(tmp_path / where / f"{names[1]}.png") for where in ("frames/images", "out/images"))
    assert facts["distortion"]["params"] == [k] and (facts["distortion"]["max_shift_px"] > 0) == (how != "never")
    assert (before != after).any() == straightened
    assert (facts["pinhole_focal_px"] != FOCAL) == straightened


def test_i02_blank_frames_are_an_error_with_numbers(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (3, 1, 1)))
    for path in (tmp_path / "frames/images").iterdir():
        write_image(path, np.full((HEIGHT, WIDTH, 3), 80, np.uint8))
    with pytest.raises(StageError, match="no two frames") as error:
        run(tmp_path)
    assert "features a frame: 0" in " ".join(error.value.facts) and "human_only" in error.value.hint


def test_i04_i16_k03_masks_must_fit_the_frames(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (3, 1, 1)))
    write_mask(tmp_path / "masks/masks/000003.png", np.zeros((10, 20), np.uint8))
    with pytest.raises(StageError, match="000003"):
        run(tmp_path)
    (tmp_path / "masks/masks/000003.png").unlink()
    with pytest.raises(StageError, match="1 of 3 frames have no mask"):
        sfm.check_masks(["000000", "000003", "000006"], tmp_path / "masks", WIDTH, HEIGHT)


def test_i04_the_person_and_its_rim_are_ignored(tmp_path):
    (tmp_path / "masks").mkdir()
    mask = np.zeros((100, 200), np.uint8)
    mask[40:60, 50:70] = 70  # a soft edge counts too
    write_mask(tmp_path / "masks/a.png", mask)
    write_ignored(["a"], tmp_path, tmp_path / "ignored", 200)
    ignored = read_mask(tmp_path / "ignored/a.png")
    assert (
        ignored[50, 60] == 0 and ignored[50, 48] == 0 and ignored[50, 45] == 255 and set(np.unique(ignored)) == {0, 255}
    )
