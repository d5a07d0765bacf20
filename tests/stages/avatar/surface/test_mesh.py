"""An avatar's surface: as large as it, coloured as it, moved as it, and clear about what makes none."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stages.avatar.body.skinning import all_bones, skin
from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import bones_of, load_avatar
from stages.avatar.surface import mesh as surface
from stages.avatar.surface.mesh import NoSurfaceError, surface_of
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import read_avatar
from stages.gestures import FACE_NAMES
from tests.made.clothes import dress, some_clothes
from tests.made.learned import pose_avatar
from tests.made.meshes import balls, coarse, edges, solid_avatar
from tests.made.said import holds

MODEL = read_body_model()


@pytest.fixture(scope="module", autouse=True)
def quick():
    with coarse():
        yield


@pytest.fixture(scope="module")
def avatar():
    return solid_avatar(MODEL)


@pytest.fixture(scope="module")
def mesh(avatar):
    return surface_of(avatar, 3000, 128)


def apart(means, vertices, faces):
    """How far, at most, 98 % of Gaussians are from a surface, and of places on it from Gaussians, m."""
    places = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), 20_000, seed=0)[0]
    both = cKDTree(places).query(means)[0], cKDTree(means).query(places)[0]
    return max(np.quantile(one, 0.98) for one in both)


def test_the_surface_is_closed_and_of_the_size_that_was_asked(mesh):
    assert 2500 < len(mesh.faces) <= 3000 and mesh.texture.shape == (128, 128, 3)
    _, row = np.unique(mesh.vertices, axis=0, return_inverse=True)
    assert (edges(row[mesh.faces]) % 2 == 0).all(), "no edge has one side alone"
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert (mesh.weights.sum(1) == 65535).all() and mesh.weights.dtype == np.uint16 and mesh.said == ()


def test_it_stands_in_the_t_pose_where_the_gaussians_do(avatar, mesh):
    means = load_avatar(avatar).resting.means.numpy()
    assert apart(means, mesh.vertices, mesh.faces) < 0.03


def test_it_moves_as_the_gaussians_do(avatar, mesh):
    baked, pose = load_avatar(avatar), torch.zeros(69)
    pose[[2, 5, 47, 50, 53]] = torch.tensor([0.3, -0.3, -0.8, 0.8, 0.9])
    weights = torch.as_tensor(all_bones(mesh.bones, mesh.weights, 24)).float()
    vertices = skin(torch.as_tensor(mesh.vertices), weights, bones_of(baked, torch.zeros(3), pose))[0].numpy()
    means = pose_avatar(baked, torch.zeros(3), pose, torch.zeros(3)).means.numpy()
    assert apart(means, vertices, mesh.faces) < 0.03


def test_its_colours_are_those_of_the_gaussians(mesh):
    at = np.clip((mesh.uvs * 128).astype(int), 0, 127)
    found = mesh.texture[at[:, 1], at[:, 0]] / 255
    head = (mesh.bones[:, 0] == 15) & (mesh.weights[:, 0] > 60000)
    front = (mesh.normals[:, 2] > 0.8) & np.isin(mesh.bones[:, 0], [0, 3, 6, 9])
    np.testing.assert_allclose(found[head].mean(0), [0.9, 0.9, 0.1], atol=0.08)
    np.testing.assert_allclose(found[front].mean(0), [0.9, 0.1, 0.1], atol=0.15)


@pytest.mark.slow
def test_an_avatar_of_0_1_0_makes_the_same_mesh(avatar, mesh, tmp_path):
    """Its file had these arrays, float32, and no normals, casters, fingers or face."""
    names = "means quats scales opacities sh0 shN lbs_weights joints parents betas canonical_pose".split()
    whole = {name: np.float32(getattr(avatar, name)) for name in names}
    np.savez(tmp_path / "avatar.npz", **whole | {"parents": np.int32(avatar.parents)})
    old = surface_of(read_avatar(tmp_path / "avatar.npz"), 3000, 128)
    assert old.morphs is None and apart(load_avatar(avatar).resting.means.numpy(), old.vertices, old.faces) < 0.03
    assert abs(len(old.faces) - len(mesh.faces)) < 30 and abs(old.texture.mean() - mesh.texture.mean()) < 2


def test_bones_of_clothes_move_what_they_move_of_the_gaussians(avatar):
    dressed = dress(avatar, some_clothes())
    mesh = surface_of(dressed, 2000, 64)
    own = (np.where(mesh.bones >= 24, mesh.weights, 0) / 65535).sum(1)
    assert own.max() > 0.5 and abs(own.mean() - dressed.lbs_weights[:, 24:].sum(1).mean()) < 0.2


def test_specks_are_left_out_and_counted(avatar, monkeypatch):
    """Two balls of 8 cm hang in the air beside the head, and what is smaller than 500 cm^2 counts as a speck."""
    monkeypatch.setattr(surface, "SPECK", 0.05)
    means, axes, *_ = balls([-0.3, 0.8, 0.0], [0.3, 0.75, 0.1], radius=0.04, count=150)
    rows = np.zeros(len(means), int)
    parts = {name: getattr(avatar, name)[rows] for name in ("opacities", "sh0", "shN", "lbs_weights")}
    turns, scales = axes / axes.norm(dim=1, keepdim=True), axes.norm(dim=1)
    parts |= {"means": means, "scales": scales, "quats": Rotation.from_matrix(turns).as_quat(scalar_first=True)}
    more = {name: np.concatenate([getattr(avatar, name), np.asarray(part)]) for name, part in parts.items()}
    mesh = surface_of(replace(avatar, **more), 2000, 64)
    assert mesh.said[0].startswith("2 specks") and np.abs(mesh.vertices[mesh.vertices[:, 1] > 0.6, 0]).max() < 0.15


def test_what_is_faint_but_dense_is_part_of_the_mesh_though_it_reaches_beyond_all_else(avatar):
    """A veil of opacity 0.25, 30 cm beyond a hand: pictures that hold the opaque Gaussians alone would cut it off."""
    hand, count = int(avatar.means[:, 0].argmax()), 3000
    rows = np.concatenate([np.arange(len(avatar)), np.full(count, hand)])
    names = ("means", "quats", "scales", "opacities", "sh0", "shN", "lbs_weights")
    veiled = replace(avatar, **{name: getattr(avatar, name)[rows] for name in names})
    veiled.means[-count:] += [0.3, 0, 0] + np.random.default_rng(0).normal(0, 0.03, (count, 3))
    veiled.opacities[-count:], veiled.scales[-count:] = 0.25, 0.02
    reach = cKDTree(load_avatar(avatar).resting.means.numpy()).query(surface_of(veiled, 3000, 64).vertices)[0].max()
    assert 0.3 < reach < 0.5


def test_a_gaussian_far_away_makes_no_larger_grid_and_is_counted(avatar):
    """Ten kilometres of cells would fill no memory that there is."""
    means = avatar.means.copy()
    means[:3] = [[1e4, 0, 0], [0, -5e3, 0], [0, 1.4, 0]]
    mesh = surface_of(replace(avatar, means=means), 2000, 64)
    assert len(mesh.said) == 1 and holds(mesh.said[0], "3 Gaussians", "0.5 m", "left out")
    assert np.abs(mesh.vertices).max() < 1.1


def some(avatar, count, **more):
    rows = np.arange(0, len(avatar), len(avatar) // count)
    names = ("means", "quats", "scales", "opacities", "sh0", "shN", "lbs_weights")
    few = replace(avatar, **{name: getattr(avatar, name)[rows] for name in names})
    return replace(few, **{name: np.full_like(getattr(few, name), value) for name, value in more.items()})


@pytest.mark.parametrize(("opacity", "said"), [(0.1, "none of"), (0.35, "form no surface")])
def test_gaussians_that_make_no_surface_are_refused_with_numbers(avatar, opacity, said):
    with pytest.raises(NoSurfaceError, match=said):
        surface_of(some(avatar, 50, opacities=opacity, scales=0.01), 2000, 64)


@pytest.mark.parametrize(("texture", "side"), [(64, 256), (512, 384), (1024, 768), (2048, 1536), (4096, 1536)])
def test_pictures_that_give_colours_are_three_quarters_of_the_texture_within_bounds(texture, side):
    assert surface._close_look(texture) == side


def test_a_hundred_gaussians_make_a_coarse_mesh(avatar):
    assert len(surface_of(some(avatar, 100, scales=0.04), 2000, 64).faces) > 100


@pytest.mark.slow
def test_fingers_and_a_face_move_the_mesh_as_they_move_the_gaussians(avatar):
    """Vertices of a hand hang on finger bones, and a jaw opens the mouth's vertices as far as the Gaussians around."""
    record, jaw = attach(avatar, MODEL, read_hands_face(MODEL)), FACE_NAMES.index("jawOpen")
    mesh = surface_of(record, 3000, 64)
    assert apart(load_avatar(record).resting.means.numpy(), mesh.vertices, mesh.faces) < 0.03
    heavy = mesh.bones[np.arange(len(mesh.bones)), mesh.weights.argmax(1)]
    fingers = np.linalg.norm(mesh.vertices[heavy >= 24][:, None] - record.fingers.joints, axis=2).min(1)
    assert (heavy >= 24).sum() > 20 and fingers.max() < 0.06
    moved = np.linalg.norm(mesh.morphs[jaw], axis=1)
    near = cKDTree(mesh.vertices[moved > 0.005]).query(load_avatar(record).resting.means.numpy()[record.face.rows])[0]
    assert 0.01 < moved.max() < 0.045 and near.min() < 0.03 and mesh.morphs[jaw, :, 1].min() < -0.01
