"""Stage sfm on drawn rooms: walks, turns, standing cameras, lenses, and what cannot be reconstructed."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages import sfm
from stages.avatar.cameras import pinhole as cameras
from stages.contract import StageError
from stages.estimators.cameras import short_walk, solving
from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.sparse_model import write_ignored
from stages.estimators.cameras.stillness import Stillness
from stages.estimators.cameras.task import Solution
from stages.formats.cameras import read_cameras
from stages.formats.images import read_image, read_mask, write_image, write_mask
from stages.formats.points import read_points
from tests.made import fits
from tests.made.rooms import FOCAL, HEIGHT, K1, WALLS, WIDTH, run, walk, write_clip
from tests.made.said import holds
from tests.made.walls import DOOR, DUST, FRAMES, STILL, SWAY, film_wall
from tests.made.worlds import umeyama

READERS = [(read_image, "images"), (read_mask, "masks")]


@pytest.fixture(autouse=True)
def few_tracks(monkeypatch):
    """Turns and walks are told apart by fewer tracks, which is quicker; `test_short_walk.py` is about how well."""
    monkeypatch.setattr(short_walk, "ASKED", 200)
    monkeypatch.setattr(short_walk, "KEPT", 800)


@pytest.mark.slow
def test_i04_i07_a_walk_past_a_room_is_reconstructed_with_its_lens(tmp_path):
    views = walk(9, 1.2)
    write_clip(tmp_path, views)
    facts, events = run(tmp_path, features=1024)
    assert facts["verdict"] == "moving" and facts["registered"] >= 8
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
        "lens.npz",
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
    views = walk(8, 0.0, turn=10.0)
    write_clip(tmp_path, views)
    facts, events = run(tmp_path, features=1024)
    assert facts["verdict"] == "rotation only" and facts["points"] == 0 and facts["registered"] == 8
    assert any("only turns" in event.get("text", "") for event in events if event["event"] == "warning")
    found = read_cameras(tmp_path / "out/cameras.npz")
    truth = views[:, :3, :3] @ views[0, :3, :3].T
    off = Rotation.from_matrix(found.viewmats[:, :3, :3] @ truth.mT).magnitude()
    assert np.degrees(off).max() < 0.5 and np.allclose(found.viewmats[:, :3, 3], 0)
    assert facts["focal_px"] == pytest.approx(FOCAL, rel=0.05)


@pytest.mark.slow
def test_a_walk_of_a_few_centimetres_is_no_turn(tmp_path):
    views = walk(9, 0.05, turn=3.0)
    write_clip(tmp_path, views)
    facts, events = run(tmp_path, features=1024)
    assert facts["verdict"] == "moving" and facts["mapper"] == "short walk" and facts["registered"] == 9
    spread = facts["lens"]["focal_spread_px"]
    assert abs(facts["focal_px"] - FOCAL) < 2 * spread < 0.2 * FOCAL
    assert any(holds(event.get("text", ""), "short walk") for event in events)
    assert any(holds(event.get("text", ""), f"{facts['focal_px']:.0f} px", f"{spread:.0f}") for event in events)
    found = read_cameras(tmp_path / "out/cameras.npz")
    truth = cameras.camera_centers(views)
    scale, R, t = umeyama(found.centers, truth)
    off = np.linalg.norm(scale * found.centers @ R.T + t - truth, axis=1)
    assert off.max() < 0.02
    xyz, rgb = read_points(tmp_path / "out/points.ply")
    to_wall = np.min([abs((scale * xyz @ R.T + t) @ normal - offset) for normal, offset, _ in WALLS], 0)
    assert len(xyz) > 300 and np.median(to_wall) < 0.5 and rgb.std() > 5


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_camera_that_is_said_to_move_is_mapped_although_it_seems_to_stand(tmp_path, monkeypatch):
    write_clip(tmp_path, walk(6, 0.5))
    captions = Stillness(stays=0.2, cells=0.2, one_way=0.2, drift_px=0.0)
    monkeypatch.setattr(solving, "measure_stillness", lambda *args: captions)
    facts, events = run(tmp_path, features=1024)
    warned = " ".join(event["text"] for event in events if event["event"] == "warning")
    assert facts["verdict"] == "static camera" and "sfm.camera=moving" in warned
    shutil.rmtree(tmp_path / "out")
    assert run(tmp_path, camera="moving", features=1024)[0]["verdict"] == "moving"


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
    found = Solution("static camera", names, np.tile(np.eye(4), (3, 1, 1)), np.full(3, FOCAL), center, k)
    monkeypatch.setattr(solving, "solve", lambda task: found)
    facts, _ = run(tmp_path, undistort=how)
    before, after = (read_image(tmp_path / where / f"{names[1]}.png") for where in ("frames/images", "out/images"))
    assert facts["distortion"]["params"] == [k] and (facts["distortion"]["max_shift_px"] > 0) == (how != "never")
    assert (before != after).any() == straightened
    assert (facts["pinhole_focal_px"] != FOCAL) == straightened


def test_i02_blank_frames_leave_the_person_alone_and_are_an_error_with_numbers_if_the_camera_is_said_to_move(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (3, 1, 1)))
    for path in (tmp_path / "frames/images").iterdir():
        write_image(path, np.full((HEIGHT, WIDTH, 3), 80, np.uint8))
    with pytest.raises(StageError, match="no two frames") as error:
        run(tmp_path, camera="moving")
    assert "features a frame: 0" in " ".join(error.value.facts) and "human_only" in error.value.hint
    shutil.rmtree(tmp_path / "out")
    facts, events = run(tmp_path)
    assert facts["verdict"] == "static camera" and facts["registered"] == 3 and facts["motion"]["stays"] is None
    assert any(holds(event["text"], "no two frames", "assumed") for event in events if event["event"] == "warning")


def write_walled(folder, wall: np.ndarray, way: np.ndarray, zoom: np.ndarray) -> None:
    """The clip of somebody before a `wall` of tests.made.walls, with a camera as there."""
    write_clip(folder, np.tile(np.eye(4), (len(way), 1, 1)))
    for i, file in enumerate(film_wall(folder / "wall", wall, way, zoom=zoom)):
        write_image(folder / f"frames/images/{3 * i:06d}.png", read_image(folder / "wall/images" / file))
        write_mask(folder / f"masks/masks/{3 * i:06d}.png", 255 - read_mask(folder / "wall/ignored" / file))


@pytest.mark.slow
def test_a_zoom_before_nothing_but_dots_leaves_the_person_alone_with_its_lens(tmp_path):
    zoom = 1 + 0.02 * np.arange(FRAMES)
    write_walled(tmp_path, DUST, STILL, zoom)
    facts, events = run(tmp_path)
    assert facts["verdict"] == "static camera" and facts["registered"] == FRAMES
    assert any(
        holds(event["text"], "stands still and zooms", "1.22") for event in events if event["event"] == "warning"
    )
    assert read_cameras(tmp_path / "out/cameras.npz").Ks[:, 0, 0] == pytest.approx(1.2 * WIDTH * zoom, rel=5e-3)
    shutil.rmtree(tmp_path / "out")
    with pytest.raises(StageError, match="no two frames"):
        run(tmp_path, camera="moving")


@pytest.mark.slow
def test_frames_that_match_none_of_those_that_stand_are_not_taken_to_stand(tmp_path, monkeypatch):
    stands, match = np.arange(FRAMES) >= 5, solving.match_frames
    write_walled(tmp_path, DOOR, np.where(stands[:, None], 0, 4 * SWAY), np.ones(FRAMES))
    there = np.random.default_rng(0).uniform(0, HEIGHT, (60, 2))
    same = [Pair(i, i + 1, there, there) for i in np.flatnonzero(stands)[:-1]]
    monkeypatch.setattr(solving, "match_frames", lambda *args: (same, match(*args)[1]))
    facts, events = run(tmp_path, features=512)
    assert facts["verdict"] == "static camera" and facts["dropped"] == [f"{3 * i:06d}" for i in range(5)]
    assert any(holds(event["text"], "5 others are left out") for event in events if event["event"] == "warning")


def test_i04_i16_k03_masks_must_fit_the_frames(tmp_path):
    write_clip(tmp_path, np.tile(np.eye(4), (3, 1, 1)))
    write_mask(tmp_path / "masks/masks/000003.png", np.zeros((10, 20), np.uint8))
    with pytest.raises(StageError, match="000003"):
        run(tmp_path)
    (tmp_path / "masks/masks/000003.png").unlink()
    with pytest.raises(StageError, match="1 of 3 frames"):
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


@pytest.fixture(scope="module")
def person():
    """The truth about somebody whom other tools fitted."""
    return fits.make_truth(frames=2, width=WIDTH, height=HEIGHT)


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "source"), [("GVHMR", "file"), ("TRAM", "file"), ("WHAM", "guessed")])
def test_a_still_camera_has_the_focal_length_of_the_tool_that_fitted_the_person(tool, source, person, tmp_path):
    """WHAM takes the picture's diagonal for every clip, which is no more than our guess."""
    write_clip(tmp_path, np.tile(np.eye(4), (2, 1, 1)))
    fit = fits.write(tool, fits.contents(tool, person), tmp_path)
    facts, events = run(tmp_path, smpl_fit=fit, camera="fixed")
    assert facts["focal_source"] == source
    assert facts["focal_px"] == pytest.approx(person.focal if source == "file" else 1.2 * WIDTH, rel=1e-4)
    assert any(tool in event.get("text", "") for event in events) == (source == "file")
