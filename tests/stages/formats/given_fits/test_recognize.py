"""Fits of the body that the user gives: layouts, joins by name, refusals by key."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.estimators.bodyfit import placing
from stages.estimators.bodyfit.frames import join_frames
from stages.formats.body_model import read_body_model
from stages.formats.given_fits import recognize
from stages.formats.poses import write_poses
from tests.made.fits import listed
from tests.made.said import holds

N = 6

SIZE = (480, 640)


def read_smpl_fit(path):
    return recognize.read_smpl_fit(path, SIZE)


def match_frames(fit, names):
    """The rows that belong to `names`, which frames they are, which have none."""
    fit, frames = join_frames(fit, listed(names, np.arange(len(names)) / 30))
    found = tuple(names[i] for i in frames)
    return fit, found, tuple(name for name in names if name not in found)


def place_in_world(fit, viewmats, model, world_from_sfm=None):
    names = fit.names or tuple(str(i) for i in range(len(fit)))
    Ks = np.tile(np.diag([600.0, 600.0, 1.0]), (len(fit), 1, 1))
    return placing.place_in_world(fit, names, viewmats, Ks, model, world_from_sfm)


@pytest.fixture(scope="module")
def model():
    model = read_body_model()
    shifted = model.v_template + np.array([0.01, -0.225, 0.03], np.float32)  # SMPL's pelvis is not at its origin
    return type(model)(**{**vars(model), "v_template": shifted})


def random_fit(rng):
    return {
        "betas": rng.normal(size=10),
        "global_orient": rng.normal(size=(N, 3)),
        "body_pose": 0.3 * rng.normal(size=(N, 69)),
        "transl": rng.normal(size=(N, 3)) * 0.3 + [0, 0, 4],
    }


@pytest.fixture
def arrays():
    return random_fit(np.random.default_rng(0))


def random_viewmats(rng):
    viewmats = np.tile(np.eye(4), (N, 1, 1))
    viewmats[:, :3, :3] = Rotation.random(N, random_state=3).as_matrix()
    viewmats[:, :3, 3] = rng.normal(size=(N, 3)) * 2
    return viewmats


def smpl_vertices(model, betas, orient, transl):
    """SMPL at zero body pose: it turns about the pelvis joint."""
    shaped = model.v_template + model.shapedirs @ betas
    pelvis = model.J_regressor[0].astype(np.float64) @ shaped
    return np.stack(
        [
            (shaped - pelvis) @ Rotation.from_rotvec(o).as_matrix().T + pelvis + t
            for o, t in zip(orient, transl, strict=True)
        ]
    )


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_camera_fit_reprojects_exactly(tmp_path, arrays, model):
    """The world pose, seen by the SfM camera, must be the file's pose: the pelvis offset terms are exact."""
    viewmats = random_viewmats(np.random.default_rng(1))
    fit, names, missing = match_frames(read_smpl_fit(save(tmp_path / "a.npz", **arrays)), [str(i) for i in range(N)])
    assert not missing and len(names) == N
    poses = place_in_world(fit, viewmats, model, world_from_sfm=0.4)
    world = smpl_vertices(model, poses.betas, poses.global_orient, poses.transl)
    camera = world @ viewmats[:, :3, :3].transpose(0, 2, 1) + 0.4 * viewmats[:, None, :3, 3]
    truth = smpl_vertices(model, arrays["betas"], arrays["global_orient"], arrays["transl"])
    assert np.abs(camera - truth).max() < 1e-5
    assert poses.world_from_sfm == 0.4 and np.array_equal(poses.body_pose, arrays["body_pose"])


def test_leaving_the_pelvis_out_would_show(arrays, model):
    """The community tools' error, so that the test above is known to be able to fail."""
    turn = Rotation.from_rotvec([0, 0, np.radians(30)]).as_matrix()
    pelvis = model.J_regressor[0] @ model.v_template
    assert np.linalg.norm(turn @ pelvis - pelvis) > 0.1


def test_i05_j02_hugs_fit_keeps_its_image_at_one_scale(tmp_path, arrays, model):
    rng = np.random.default_rng(2)
    viewmats = random_viewmats(rng)
    scale = rng.uniform(2.5, 3.3, N)
    path = save(
        tmp_path / "smpl_optimized_aligned_scale.npz",
        **arrays | {"betas": np.tile(arrays["betas"], (N, 1))},
        scale=scale,
    )
    fit = read_smpl_fit(path)
    assert any("scale varies" in note for note in fit.notes)
    poses = place_in_world(match_frames(fit, [f"{i:05d}" for i in range(N)])[0], viewmats, model)
    assert poses.world_from_sfm == pytest.approx(1 / np.median(scale))
    turn = viewmats[:, :3, :3].transpose(0, 2, 1)
    world = smpl_vertices(model, poses.betas, poses.global_orient, poses.transl)
    mine = world @ turn + poses.world_from_sfm * viewmats[:, None, :3, 3]
    sfm = scale[:, None, None] * smpl_vertices(model, arrays["betas"], arrays["global_orient"], 0 * arrays["transl"])
    theirs = (sfm + arrays["transl"][:, None]) @ turn + viewmats[:, None, :3, 3]
    assert np.allclose(
        mine / mine[..., 2:], theirs / theirs[..., 2:], atol=1e-4 * np.abs(theirs / theirs[..., 2:]).max()
    )


def test_constant_scale_is_just_divided_out(tmp_path, arrays, model):
    fit = read_smpl_fit(save(tmp_path / "a.npz", **arrays, scale=np.full(N, 2.0)))
    assert fit.notes == ()
    poses = place_in_world(match_frames(fit, list("012345"))[0], random_viewmats(np.random.default_rng(0)), model)
    assert np.allclose(poses.transl, arrays["transl"] / 2) and poses.world_from_sfm == 0.5


def test_our_own_file_comes_back(tmp_path, arrays, model):
    viewmats = random_viewmats(np.random.default_rng(1))
    names = tuple(f"{4 * i:06d}" for i in range(N))
    fit = match_frames(read_smpl_fit(save(tmp_path / "a.npz", **arrays, names=np.array(names))), names)[0]
    poses = place_in_world(fit, viewmats, model, 0.4)
    write_poses(tmp_path / "body.npz", poses)
    again = place_in_world(match_frames(read_smpl_fit(tmp_path / "body.npz"), names)[0], viewmats, model)
    for key in ("betas", "global_orient", "body_pose", "transl"):
        assert np.allclose(getattr(again, key), getattr(poses, key), atol=1e-12)
    assert again.world_from_sfm == pytest.approx(0.4)


def layouts(arrays):
    pose = np.concatenate([arrays["global_orient"], arrays["body_pose"]], 1)
    rest = {"betas": arrays["betas"], "transl": arrays["transl"]}
    matrices = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(N, 24, 3, 3)
    yield rest | {"thetas": pose}
    yield {"betas": arrays["betas"][None], "trans": arrays["transl"], "poses": pose}
    yield rest | {"poses": pose.reshape(N, 24, 3)}
    yield rest | {"poses": matrices}
    yield rest | {"global_orient": matrices[:, :1], "body_pose": matrices[:, 1:]}
    yield rest | {"betas": np.append(arrays["betas"], np.zeros(290)), "thetas": pose.astype(">f8")}


@pytest.mark.parametrize("which", range(6))
def test_j10_layouts(tmp_path, arrays, which):
    fit = read_smpl_fit(save(tmp_path / "a.npz", **list(layouts(arrays))[which]))
    assert np.allclose(fit.betas, arrays["betas"]) and np.allclose(fit.transl, arrays["transl"])
    assert np.allclose(fit.global_orient, arrays["global_orient"]) and np.allclose(fit.body_pose, arrays["body_pose"])


def test_k04_rows_are_joined_by_name_then_number_never_by_order(tmp_path, arrays):
    clip = ["000000", "000009", "000010", "000100"]
    mixed = ["frame_10.png", "frame_9.png", "frame_100.png", "frame_7.png", "frame_8.png", "frame_1.png"]
    fit, names, missing = match_frames(read_smpl_fit(save(tmp_path / "a.npz", **arrays, names=np.array(mixed))), clip)
    assert names == ("000009", "000010", "000100") and missing == ("000000",)
    assert np.array_equal(fit.transl, arrays["transl"][[1, 0, 2]])
    ids = np.array([0, 9, 10, 100, 4, 5])
    fit = match_frames(read_smpl_fit(save(tmp_path / "b.npz", **arrays, frame_ids=ids)), clip)[0]
    assert np.array_equal(fit.transl, arrays["transl"][:4])
    fit, names, missing = match_frames(
        read_smpl_fit(save(tmp_path / "c.npz", **arrays)), ["000002", "000003", "000005", "000077"]
    )
    assert np.array_equal(fit.transl, arrays["transl"][[2, 3, 5]]) and missing == ("000077",)


def test_six_rows_for_six_frames_of_a_longer_video_are_not_guessed(tmp_path, arrays):
    fit = read_smpl_fit(save(tmp_path / "a.npz", **arrays))
    with pytest.raises(StageError, match="5 of 6 frames") as caught:
        match_frames(fit, [f"{10 * i:06d}" for i in range(N)])
    assert "add `names`" in caught.value.hint and "rows 0 to 5" in caught.value.facts[0]


def nan_at(array, *index):
    array = array.copy()
    array[index] = np.nan
    return array


@pytest.mark.parametrize(
    "change,words",
    [
        (lambda a: {"transl": None}, ["no transl", "betas"]),
        (lambda a: {"body_pose": a["body_pose"][:, :63]}, ["body_pose", "6x63", "6x69"]),
        (lambda a: {"body_pose": a["body_pose"].T}, ["body_pose", "69x6"]),
        (lambda a: {"global_orient": a["global_orient"][:5]}, ["global_orient", "5x3", "6x3"]),
        (lambda a: {"poses": np.zeros((N, 159))}, ["poses", "6x159", "6x72"]),
        (lambda a: {"thetas": np.full((N, 72), 60.0)}, ["thetas", "degrees", "row 0, joint 0"]),
        (lambda a: {"poses": np.tile(np.diag([1.0, 1, -1]), (N, 24, 1, 1))}, ["poses", "rotations", "determinant -1"]),
        (lambda a: {"transl": nan_at(a["transl"], 2, 1)}, ["transl", "[2, 1]", "nan"]),
        (lambda a: {"scale": np.array([1, 1, 1, -1, 1, 1.0])}, ["scale", "row 3", "-1"]),
        (lambda a: {"betas": np.zeros(8)}, ["betas", "1x8", "1x10"]),
        (lambda a: {"names": np.array(["a"] * 5)}, ["names", "(5,)", "6"]),
        (lambda a: {"betas": np.array([{}], dtype=object)}, ["betas", "does not hold numbers"]),
    ],
)
def test_j01_j10_k01_k02_k06_refuses_by_key(tmp_path, arrays, change, words):
    changed = {k: v for k, v in (arrays | change(arrays)).items() if v is not None}
    with pytest.raises(StageError) as caught:
        read_smpl_fit(save(tmp_path / "fit.npz", **changed))
    said = "\n".join([caught.value.problem, *caught.value.facts])
    assert all(word in said for word in words) and "fit.npz" in said, said


def test_j01_k09_refuses_people_behind_the_camera_and_twice_named_frames(tmp_path, arrays, model):
    behind = arrays | {"transl": arrays["transl"] * [1, 1, -1]}
    fit = match_frames(read_smpl_fit(save(tmp_path / "a.npz", **behind)), list("012345"))[0]
    with pytest.raises(StageError, match="behind the camera") as caught:
        place_in_world(fit, random_viewmats(np.random.default_rng(0)), model, 1.0)
    assert holds(caught.value.facts[0], "6 of 6 frames", "first 0")
    twice = read_smpl_fit(save(tmp_path / "b.npz", **arrays, names=np.array(["a1", "b1", "3", "4", "5", "6"])))
    with pytest.raises(StageError, match="two rows"):
        match_frames(twice, ["000001"])


def test_j13_varying_and_extreme_shapes_are_said(tmp_path, arrays):
    betas = np.tile(arrays["betas"], (N, 1))
    betas[:, 0] = np.linspace(5, 8, N)
    fit = read_smpl_fit(save(tmp_path / "a.npz", **arrays | {"betas": betas}))
    shape, notes = placing.median_shape(fit)
    assert len(notes) == 2 and shape[0] == 6.5


def test_a_body_turned_about_the_origin_lands_where_it_was(tmp_path, arrays, model):
    """ZJU-MoCap: X = exp(Rh) SMPL(poses) + Th, whether or not the pose turns the pelvis too."""
    rng = np.random.default_rng(5)
    Rh, Th, root = rng.normal(size=(N, 3)), rng.normal(size=(N, 3)), rng.normal(size=(N, 3))
    betas = np.tile(arrays["betas"].reshape(-1)[:10], (N, 1))
    poses = np.concatenate([root, np.zeros((N, 69))], 1)
    path = save(tmp_path / "zju.npz", Rh=Rh, Th=Th, poses=poses, betas=betas, names=np.array(list("012345")[:N]))
    fit = match_frames(read_smpl_fit(path), list("012345")[:N])[0]
    found = place_in_world(fit, random_viewmats(rng), model)
    still = smpl_vertices(model, betas[0], root, np.zeros((N, 3)))
    truth = np.stack([v @ Rotation.from_rotvec(r).as_matrix().T + t for v, r, t in zip(still, Rh, Th, strict=True)])
    placed = smpl_vertices(model, found.betas, found.global_orient, found.transl)
    np.testing.assert_allclose(placed, truth, atol=1e-6)
    assert found.world_from_sfm == 1
