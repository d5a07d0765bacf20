"""Which reader takes a file, by its ending; what a file takes the place of."""

from pathlib import Path

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.read import lacks, read_any_avatar, read_any_scene, read_given
from stages.formats.exchange.spz import write_spz
from stages.formats.splats import read_scene
from stages.records import Effects


@pytest.mark.parametrize("write", [write_ply, write_spz])
def test_a_scene_file_takes_the_place_of_the_trained_one(tiny, tmp_path, write):
    path = tmp_path / f"cut.{write.__name__[-3:].upper()}"
    scene = read_scene(tiny["train"] / "scene.npz")
    write(path, scene)
    avatar, found, _ = read_given(tiny["train"], None, path)
    np.testing.assert_allclose(found.means, scene.means, atol=2e-4)
    alone, nothing, effects = read_given(None, tiny["train"] / "avatar.npz", None)
    assert nothing is None and effects == Effects() and np.array_equal(alone.means, avatar.means)


def test_other_endings_are_refused_by_name(tmp_path):
    with pytest.raises(StageError, match=r"person.fbx is no avatar that can be posed"):
        read_any_avatar(tmp_path / "person.fbx")
    with pytest.raises(StageError, match=r"room.splat is no scene"):
        read_any_scene(tmp_path / "room.splat")
    with pytest.raises(StageError) as refused:
        read_any_avatar(tmp_path / "avatar.ply")
    assert list(refused.value.facts) == ["it ends in '.ply'"], "a .ply has no skeleton"


def test_what_a_format_cannot_hold_is_said():
    assert lacks(Path("avatar.npz"), Path("scene.spz")) == lacks(None, None) == []
    glb, ply = lacks(Path("x/avatar.GLB"), Path("room.ply"))
    assert "avatar.GLB holds no clothes" in glb and "anti-aliasing" in ply
