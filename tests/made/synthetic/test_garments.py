"""Garments of the synthetic clip: they hang on the body, off its skin, keep their size, swing, and come to rest."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from stages.avatar.body.smpl import Body
from stages.formats.body_model import read_body_model
from stages.synthetic import person
from tests.made.synthetic import cloth, garments, wardrobe
from tests.made.synthetic.clip import make_clip

MODEL = read_body_model()
FACES = np.asarray(MODEL.faces, np.int64)
BETAS = np.random.default_rng(3).uniform(-0.8, 0.8, 10)
BODY = Body(MODEL, dtype=torch.float64)


def made(name: str, seed: int = 0) -> garments.Garment:
    return wardrobe.make_garments([name], MODEL, BETAS, np.random.default_rng(seed))[0]


def turning(frames: int = 5, fps: float = 10.0) -> tuple[cloth.Poses, np.ndarray]:
    orient, pose = person.make_motion(frames, fps, np.random.default_rng(0))
    transl, vertices, _ = person.pose_body(BODY, BETAS, orient, pose)
    return (orient, pose, transl), vertices


@pytest.mark.parametrize("name", wardrobe.MAKERS)
def test_a_garment_is_a_mesh_of_its_particles_and_is_painted_everywhere(name):
    garment = made(name)
    particles, colors = garment.cloth, garment.paint(garment.chart.reshape(-1, 2))
    assert garment.faces.max() < len(particles.places) and garment.chart.shape == (len(garment.faces), 3, 2)
    assert (colors >= 0).all() and (colors <= 2).all() and len(np.unique(colors.round(2), axis=0)) > 1
    np.testing.assert_allclose(particles.weights.sum(1), 1)
    assert particles.pinned.any() and (~particles.pinned).any() == (len(particles.rods) > 0)
    other = made(name, 1)
    assert not np.array_equal(other.cloth.places, particles.places)
    assert np.array_equal(made(name).cloth.places, particles.places)


@pytest.mark.slow
@pytest.mark.parametrize("name", wardrobe.SWINGING)
def test_it_stays_off_the_skin_keeps_its_size_and_swings(name):
    particles, (poses, vertices) = made(name).cloth, turning()
    (found,) = cloth.worn([particles], BODY, FACES, BETAS, poses, 10.0)
    rods = particles.rods
    length = np.linalg.norm(particles.places[rods[:, 0]] - particles.places[rods[:, 1]], axis=1)
    now = np.linalg.norm(found[:, rods[:, 0]] - found[:, rods[:, 1]], axis=2)
    stretched = np.quantile(now[:, length > 0] / length[length > 0], 0.95)
    assert stretched < 1.25, stretched
    free = ~particles.pinned
    for places, skin in zip(found, vertices):
        assert np.quantile(cKDTree(skin).query(places[free])[0], 0.05) > 0.005
    relative = found - found[:, particles.pinned].mean(1, keepdims=True)
    assert np.abs(np.diff(relative[:, free], axis=0)).max() > 0.02, "it moves against what it hangs on"


@pytest.mark.slow
def test_a_held_pose_is_reached_at_rest():
    particles, (poses, _) = made("ponytail").cloth, turning(2)
    one = tuple(part[:1] for part in poses)
    (settled,) = cloth.settled([particles], BODY, FACES, BETAS, one)
    still = tuple(np.repeat(part, 30, axis=0) for part in one)
    (held,) = cloth.worn([particles], BODY, FACES, BETAS, still, 10.0)
    assert settled.shape == (1, *particles.places.shape)
    assert np.linalg.norm(settled[0] - held[-1], axis=1).mean() < 0.03
    assert np.linalg.norm(held[-1] - held[-2], axis=1).max() < 0.005


@pytest.mark.slow
def test_a_clip_shows_what_is_worn_and_without_it_is_as_before(monkeypatch):
    one = tuple(part[:1] for part in person.novel_poses())  # in each of which cloth has to settle
    monkeypatch.setattr(person, "novel_poses", lambda: one)
    size = {"width": 60, "height": 80, "frames": 3, "fps": 10.0}
    plain, again = make_clip(MODEL, **size), make_clip(MODEL, **size, wears=("skirt",))
    assert np.array_equal(plain.frames.body_pose, again.frames.body_pose)
    more = (again.frames.masks > 127).sum() - (plain.frames.masks > 127).sum()
    assert more > 0.1 * (plain.frames.masks > 127).sum()
    shown = (again.frames.masks > 127) & (plain.frames.masks < 127)
    assert (again.frames.images[shown] != plain.frames.images[shown]).any(1).mean() > 0.9
