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
from tests.made.said import holds


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
    with pytest.raises(StageError, match=r"person\.fbx.*avatar"):
        read_any_avatar(tmp_path / "person.fbx")
    with pytest.raises(StageError, match=r"room\.splat.*scene"):
        read_any_scene(tmp_path / "room.splat")
    with pytest.raises(StageError) as refused:
        read_any_avatar(tmp_path / "avatar.ply")
    assert holds(*refused.value.facts, "'.ply'"), "a .ply has no skeleton"


def test_what_a_format_cannot_hold_is_said(tiny):
    assert lacks(tiny["train"] / "avatar.npz", Path("scene.spz")) == lacks(None, None) == []
    glb, ply = lacks(Path("x/avatar.GLB"), Path("room.ply"))
    assert holds(glb, "avatar.GLB", "eight bones") and "anti-aliasing" in ply
    assert lacks(None, Path("room.ply"), antialias=True) == []


def test_clothes_of_before_they_had_bones_are_left_out_and_that_is_said(tiny, tmp_path):
    """As 0.3.0 wrote them until bones came: offsets of nodes."""
    with np.load(tiny["train"] / "avatar.npz") as arrays:
        plain = {name: arrays[name] for name in arrays if not name.startswith("clothes_")}
    plain["lbs_weights"] = plain["lbs_weights"][:, :24]
    plain["lbs_weights"] /= plain["lbs_weights"].sum(1, keepdims=True)
    nodes = {"nodes": np.zeros((4, 3)), "mean": np.zeros(69), "axes": np.zeros((69, 2)), "low": -np.ones(2),
             "high": np.ones(2), "offsets": np.ones((4, 3, 2))}  # fmt: skip
    np.savez(
        tmp_path / "old.npz", **plain | {"version": 1} | {f"clothes_{name}": array for name, array in nodes.items()}
    )
    avatar = read_any_avatar(tmp_path / "old.npz")
    assert avatar.clothes is None and avatar.lbs_weights.shape[1] == 24
    (fact,) = lacks(tmp_path / "old.npz", None)
    assert holds(fact, "old.npz", "clothes", "bones")
