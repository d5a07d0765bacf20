"""NeuMan and ZJU-MoCap in place of a video: cameras, masks and poses against the truth, and what is refused."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from hugs_cli import pipelines
from stages import calibrated, masks, neuman, smpl, zju
from stages.contract import Job, StageError
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.clip import load_clip
from stages.formats.datasets.neuman import paper_split
from stages.formats.datasets.zju import number
from stages.formats.images import read_image, read_mask, write_mask
from stages.formats.poses import read_poses
from stages.records import BodyPoses, Cameras
from tests.made import datasets
from tests.made.said import any_holds, holds
from tests.made.synthetic.clip import make_clip
from tests.made.truth import Similarity, align, camera_errors, joints_of, psnr


def go(folder: Path, first, out: Path, **params) -> tuple[dict[str, Path], list[str]]:
    """Run the stages up to smpl with their pipeline's settings; their folders, and what they said."""
    done = {name: out / name for name in ("frames", "masks", "sfm", "smpl")}
    for place in done.values():
        place.mkdir(parents=True)
    said: list[str] = []

    def job(name: str) -> Job:
        return Job(done[name], emit=lambda event: said.append(event.get("text", "")))

    stages = pipelines.load(first.__name__.rpartition(".")[2]).stages
    first.run(job("frames"), stages["frames"].params.model_copy(update=params), video=folder)
    masks.run(job("masks"), stages["masks"].params, frames=done["frames"])
    calibrated.run(job("sfm"), stages["sfm"].params, frames=done["frames"], masks=done["masks"])
    smpl.run(job("smpl"), stages["smpl"].params, frames=done["frames"], sfm=done["sfm"])
    return done, said


def iou(found: np.ndarray, truth: np.ndarray) -> float:
    return ((found > 127) & (truth > 127)).sum() / ((found > 127) | (truth > 127)).sum()


def worst_joint(found: BodyPoses, truth: BodyPoses, order: list[int], similarity: Similarity) -> float:
    """Largest distance in m of a joint from its true place."""
    model = read_body_model()
    gap = similarity.to_truth(joints_of(found, model)) - joints_of(truth, model)[order]
    return float(np.linalg.norm(gap, axis=-1).max())


def refused(folder: Path, first, out: Path, **params) -> StageError:
    with pytest.raises(StageError) as caught:
        go(folder, first, out, **params)
    assert caught.value.hint and caught.value.facts and not caught.value.problem.endswith(".")
    return caught.value


@pytest.fixture(scope="module")
def sequences(tmp_path_factory) -> dict[str, datasets.Made]:
    """A data set of each kind, not to be written to."""
    root = tmp_path_factory.mktemp("sequences")
    clip = make_clip(read_body_model(), frames=15, width=96, height=128, novel=1)
    return {
        "neuman": datasets.neuman(root / "neuman", frames=15, clip=clip),
        "zju": datasets.zju(root / "zju", side=48),
    }


def copied(made: datasets.Made, folder: Path) -> Path:
    """A data set's folder to change."""
    return Path(shutil.copytree(made.folder, folder / made.folder.name))


@pytest.fixture(scope="module")
def bike(sequences, tmp_path_factory):
    """The data set's folder, the truth's, the stages' folders, and what they said."""
    made = sequences["neuman"]
    return made, *go(made.folder, neuman, tmp_path_factory.mktemp("neuman") / "out")


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    folder = tmp_path_factory.mktemp("zju")
    made = datasets.zju(folder, side=160)
    return made, *go(made.folder, zju, folder / "out", test_every=2)


def test_neuman_cameras_and_points_are_the_true_ones(bike):
    made, done, _ = bike
    found, truth = read_cameras(done["sfm"] / "cameras.npz"), read_cameras(made.truth / "cameras.npz")
    errors = camera_errors(found, truth, 15)
    assert errors.registered == 1 and errors.worst < 1e-6 and errors.turn_degrees < 1e-5 and errors.focal < 1e-9
    np.testing.assert_allclose(found.Ks, truth.Ks, atol=1e-9)
    facts = json.loads((done["sfm"] / "sfm.json").read_text())
    assert facts["verdict"] == "moving" and facts["points"] == 400 and facts["reprojection_px"] == 0.5
    assert 5 < facts["median_triangulation_deg"] < 60
    clip = load_clip(done["sfm"], done["smpl"])
    points = align(found, truth, clip.body.world_from_sfm).to_truth(clip.points)
    assert points[:, 1].min() > -0.01, "the floor is the lowest thing in the room"


def test_neuman_masks_and_poses_are_the_true_ones(bike):
    made, done, said = bike
    names = read_cameras(done["sfm"] / "cameras.npz").names
    for name in names:
        for kind, read in (("images", read_image), ("masks", read_mask)):
            found, true = (read(place / kind / f"{name}.png") for place in (done["sfm"], made.truth))
            np.testing.assert_array_equal(found, true)
    found, truth = read_poses(done["smpl"] / "body.npz"), read_poses(made.truth / "body.npz")
    cameras = read_cameras(done["sfm"] / "cameras.npz"), read_cameras(made.truth / "cameras.npz")
    similarity = align(*cameras, found.world_from_sfm)
    assert similarity.scale == pytest.approx(1, abs=1e-4), "metres are metres"
    assert worst_joint(found, truth, list(range(15)), similarity) < 1e-3
    assert any("scale varies" in text for text in said)


def test_the_split_is_the_papers():
    assert {n: paper_split(n)[0] for n in (41, 37, 42)} == {41: [2, 7, 12, 17], 37: [2, 7, 12], 42: [2, 7, 12, 17]}
    assert [(len(a), len(b)) for a, b in map(paper_split, (104, 102, 103))] == [(10, 11), (10, 10), (10, 11)]
    assert all(paper_split(n)[0] == list(range(2, 48, 5)) for n in (104, 102, 103))


def test_only_test_frames_are_measured_and_none_of_the_held_out_are_trained_on(bike):
    _, done, _ = bike
    clip = load_clip(done["sfm"], done["smpl"])
    assert np.flatnonzero(clip.heldout).tolist() == [2]
    assert np.flatnonzero(~clip.training & ~clip.heldout).tolist() == [7, 12]
    assert "HUGS" in clip.split.rule


@pytest.mark.slow
def test_split_files_of_the_data_set_win(sequences, tmp_path):
    folder = copied(sequences["neuman"], tmp_path)
    (folder / "test_split.txt").write_text("00001.png\n00006.png\n")
    (folder / "train_split.txt").write_text("\n".join(f"{i:05d}.png" for i in (0, 2, 3, 4)) + "\n")
    done, _ = go(folder, neuman, tmp_path / "out", max_side=48)
    clip = load_clip(done["sfm"], done["smpl"])
    assert np.flatnonzero(clip.heldout).tolist() == [1, 6] and np.flatnonzero(clip.training).tolist() == [0, 2, 3, 4]
    (folder / "test_split.txt").write_text("00002.png\n")
    error = refused(folder, neuman, tmp_path / "again")
    assert "name the same pictures" in error.problem and "00002.png" in error.facts[0]


@pytest.mark.slow
def test_a25_smaller_pictures_a_lens_and_the_other_masks(sequences, tmp_path):
    made = sequences["neuman"]
    folder = copied(made, tmp_path)
    shutil.rmtree(folder / "4d_humans" / "sam_segmentations")
    cameras = folder / "sparse" / "cameras.txt"
    f, x, y = read_cameras(made.truth / "cameras.npz").Ks[0][[0, 0, 1], [0, 2, 2]]
    cameras.write_text(f"1 SIMPLE_RADIAL 96 128 {f} {x} {y} 0.05\n")
    done, said = go(folder, neuman, tmp_path / "out", max_side=64)
    assert any_holds(said, "distortion", 0.05)
    found, truth = read_cameras(done["sfm"] / "cameras.npz"), read_cameras(made.truth / "cameras.npz")
    assert (found.width, found.height) == (48, 64)
    np.testing.assert_allclose(found.Ks[:, :2], truth.Ks[:, :2] / 2, atol=1e-9)
    small = read_mask(done["sfm"] / "masks" / "000003.png")
    true = read_mask(made.truth / "masks" / "000003.png").reshape(64, 2, 48, 2).mean((1, 3))
    assert iou(small, true) > 0.97


def test_zju_cameras_pictures_and_masks_are_the_true_ones(core):
    made, done, _ = core
    found, truth = read_cameras(done["sfm"] / "cameras.npz"), read_cameras(made.truth / "cameras.npz")
    order = order_of(done)
    errors = camera_errors(renamed(found, order), truth, len(order))
    assert errors.worst < 1e-9 and errors.turn_degrees < 1e-5
    np.testing.assert_allclose(found.Ks, truth.Ks[order], atol=1e-9)
    inside = np.s_[6:-6, 6:-6]
    for name, i in zip(found.names, order, strict=True):
        images = (done["sfm"] / "images" / f"{name}.png", made.truth / "images" / f"{i:06d}.png")
        bent = read_image(done["frames"] / "images" / f"{name}.png")
        straight, true = (read_image(path) for path in images)
        assert psnr(straight[inside], true[inside]) > max(25, 3 + psnr(bent[inside], true[inside]))
        shift, _ = cv2.phaseCorrelate(*(p[inside].mean(2) for p in (straight, true)))
        assert np.abs(shift).max() < 0.1, "no half pixel is lost"
        assert (
            iou(read_mask(done["sfm"] / "masks" / f"{name}.png"), read_mask(made.truth / "masks" / f"{i:06d}.png"))
            > 0.91  # the truth counts half-covered pixels in, each resampling about half of them
        )
    facts = json.loads((done["sfm"] / "sfm.json").read_text())
    assert facts["verdict"] == "static camera" and facts["points"] == 0 and facts["distortion"]["max_shift_px"] > 1


def order_of(done: dict[str, Path]) -> list[int]:
    """The truth's view of each frame: camera * 6 + moment."""
    rows = json.loads((done["frames"] / "frames.json").read_text())["frames"]
    return [int(row["source"].partition("_")[0]) * 6 + row["moment"] for row in rows]


def renamed(cameras: Cameras, order: list[int]) -> Cameras:
    names = tuple(f"{i:06d}" for i in order)
    return Cameras(names, cameras.viewmats, cameras.Ks, cameras.width, cameras.height)


@pytest.mark.slow
@pytest.mark.parametrize("subject", [377, 313])
def test_zju_poses_are_the_true_ones(core, subject, tmp_path):
    made, done = core[:2]
    if subject == 313:
        made = datasets.zju(tmp_path, subject=313, side=48, cameras=2)
        done, _ = go(made.folder, zju, tmp_path / "out", test_every=2)
    order = order_of(done)
    found, truth = read_poses(done["smpl"] / "body.npz"), read_poses(made.truth / "body.npz")
    known = renamed(read_cameras(done["sfm"] / "cameras.npz"), order), read_cameras(made.truth / "cameras.npz")
    similarity = align(*known, found.world_from_sfm)
    assert similarity.scale == pytest.approx(1, abs=1e-9)
    assert worst_joint(found, truth, order, similarity) < 1e-3
    assert (found.confidence > 0.5).all(), "the body lies on the masks"


def test_zju_learns_from_one_camera_and_is_measured_on_the_others(core):
    _, done, _ = core
    clip = load_clip(done["sfm"], done["smpl"])
    rows = json.loads((done["frames"] / "frames.json").read_text())["frames"]
    assert clip.training.sum() == 6 and clip.heldout.sum() == 6 and len(clip.names) == 12
    assert {row["source"][:2] for row, there in zip(rows, clip.training, strict=True) if there} == {"00"}
    assert {row["moment"] for row, there in zip(rows, clip.heldout, strict=True) if there} == {0, 2, 4}
    assert (np.diff(clip.split.moments) >= 0).all()


def test_a_corner_of_every_layout_is_read():
    assert number("Camera_B1/000012.jpg") == 12
    assert number("Camera (1)/CoreView_313_Camera_(1)_0013_2019-08-23_16-08-50.592.jpg") == 13


@pytest.mark.parametrize(
    ("kind", "gone", "facts"),
    [
        ("neuman", "sparse/images.txt", ("lacks", "images.txt")),
        ("neuman", "4d_humans/smpl_optimized_aligned_scale.npz", ("not", "NeuMan")),
        ("neuman", "images/00003.png", ("1 of 15 pictures", "images/")),
        ("neuman", "4d_humans/sam_segmentations/mask_0003.png", ("14 masks",)),
        ("zju", "annots.npy", ("not", "ZJU-MoCap")),
        ("zju", "new_params/2.npy", ("2.npy",)),
        ("zju", "Camera_B1/000001.jpg", ("1 files", "annots.npy")),
    ],
)
def test_what_is_missing_is_named(sequences, tmp_path, kind, gone, facts):
    folder = copied(sequences[kind], tmp_path)
    (folder / gone).unlink()
    assert holds(refused(folder, {"neuman": neuman, "zju": zju}[kind], tmp_path / "out").problem, *facts)


def test_a25_a26_what_does_not_fit_is_named(sequences, tmp_path):
    folder = copied(sequences["neuman"], tmp_path)
    cameras = folder / "sparse" / "cameras.txt"
    text = cameras.read_text()
    cameras.write_text(text.replace("PINHOLE 96", "FISHEYE 96"))
    assert holds(refused(folder, neuman, tmp_path / "a").facts[0], "SIMPLE_PINHOLE")
    cameras.write_text(text.replace("PINHOLE 96", "PINHOLE 98"))
    assert holds(*refused(folder, neuman, tmp_path / "b").facts, "96x128", "98x128")
    cameras.write_text("1 PINHOLE 96 x\n")
    assert holds(refused(folder, neuman, tmp_path / "c").problem, "line 1")


class Runs:
    def __reduce__(self):
        return print, ("code ran",)


def test_no_code_of_a_pickle_is_run(sequences, tmp_path, capsys):
    folder = copied(sequences["zju"], tmp_path)
    np.save(folder / "annots.npy", {"cams": Runs(), "ims": []})
    error = refused(folder, zju, tmp_path / "out")
    assert "refused" in error.facts[0] and "code ran" not in capsys.readouterr().out
    (folder / "annots.npy").write_bytes(pickle.dumps({"cams": 1}))
    assert "annots.npy" in refused(folder, zju, tmp_path / "again").problem


@pytest.mark.slow
def test_a_folder_of_labels_that_are_not_zero_is_the_person(sequences, tmp_path):
    """One of the two mask folders is enough, whatever its labels are."""
    folder = copied(sequences["zju"], tmp_path)
    shutil.rmtree(folder / "mask_cihp")
    for path in (folder / "mask").rglob("*.png"):
        write_mask(path, read_mask(path) * np.uint8(7))
    done, _ = go(folder, zju, tmp_path / "out", test_every=9)
    lower = read_mask(done["masks"] / "masks" / "000000.png")
    assert (lower[:20] == 0).all() and (lower > 127).any()
