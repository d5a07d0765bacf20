"""avatar.npz and scene.npz without pickles, with damage named."""

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.records import Avatar, Scene
from tests.made.clothes import dress, some_clothes
from tests.made.said import holds


def scene(n: int = 5) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (3,), "shN": (0, 3)}
    return {k: rng.random((n, *shape)).astype(np.float32) for k, shape in shapes.items()}


def avatar(n: int = 5) -> dict[str, np.ndarray]:
    weights = np.full((n, 24), 1 / 24, np.float32)
    more = {
        "joints": np.ones((24, 3)),
        "parents": np.arange(24) - 1,
        "betas": np.ones(10),
        "canonical_pose": np.ones(69),
    }
    return scene(n) | {"lbs_weights": weights} | more


def test_l07_round_trip_without_pickles(tmp_path):
    write_splats(tmp_path / "scene.npz", Scene(**scene()))
    write_splats(tmp_path / "avatar.npz", Avatar(**avatar(), normals=np.full((5, 3), 0.5)))
    back = read_avatar(tmp_path / "avatar.npz")
    assert (back.normals == 0.5).all()
    assert len(read_scene(tmp_path / "scene.npz")) == 5
    for name, value in avatar().items():
        assert np.array_equal(getattr(back, name), value), name
    assert back.parents.dtype == np.int32 and back.parents[0] == -1
    with np.load(tmp_path / "avatar.npz", allow_pickle=False) as data:
        assert all(data[k].dtype != object for k in data)


def test_what_is_invented_is_said_where_it_is_known(tmp_path):
    invented = np.array([True, False, False, True, False])
    write_splats(tmp_path / "scene.npz", Scene(**scene(), invented=invented))
    assert np.array_equal(read_scene(tmp_path / "scene.npz").invented, invented)
    write_splats(tmp_path / "older.npz", Scene(**scene()))
    assert read_scene(tmp_path / "older.npz").invented is None
    np.savez(tmp_path / "scene.npz", **scene(), invented=invented[:4])
    with pytest.raises(StageError, match=r"invented .*scene\.npz.* shape"):
        read_scene(tmp_path / "scene.npz")


def test_k02_l01_damage_is_named(tmp_path):
    path = tmp_path / "avatar.npz"
    np.savez(path, **scene())
    with pytest.raises(StageError, match="Gaussians of the avatar") as error:
        read_avatar(path)
    assert "lbs_weights" in error.value.facts[0]
    np.savez(path, **(avatar() | {"sh0": np.zeros((4, 3), np.float32)}))
    with pytest.raises(StageError, match=r"sh0 .*avatar\.npz.* shape") as error:
        read_avatar(path)
    assert holds(error.value.facts[0], "4x3", "5x3")
    broken = avatar()
    broken["means"][2, 1] = np.nan
    np.savez(path, **broken)
    with pytest.raises(StageError, match=r"\bmeans\b.*avatar\.npz") as error:
        read_avatar(path)
    assert "[2, 1]" in error.value.facts[0]
    np.savez(path, **(avatar() | {"lbs_weights": np.full((5, 24), 0.05, np.float32)}))
    with pytest.raises(StageError, match="damaged"):
        read_avatar(path)


def test_a19_a_zero_quaternion_is_no_rotation(tmp_path):
    damaged = scene()
    damaged["quats"][3] = 0
    np.savez(tmp_path / "scene.npz", **damaged)
    with pytest.raises(StageError, match="damaged") as error:
        read_scene(tmp_path / "scene.npz")
    assert holds(error.value.facts[0], 1, "quaternion", "zeros", "row 3")


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"scales": np.zeros((5, 3))}, ("5 Gaussians", "scale", "row 0")),
        ({"opacities": np.array([0, 1, 0.5, 1.5, -1])}, ("2 Gaussians", "opacity", "row 3")),
        ({"shN": np.zeros((5, 5, 3))}, ("shN", "5 coefficients")),
        ({"lbs_weights": np.full((5, 24), 0.05)}, ("5 Gaussians", "row 0", "1.2000")),
        ({"lbs_weights": np.eye(24)[:5] * 6 - np.eye(24)[1:6] * 5}, ("row 0", "1.0000", "-5")),
        ({"lbs_weights": np.eye(24)[:5] * 1e30 - np.eye(24)[1:6] * 1e30}, ("below 0",)),
        ({"parents": np.roll(np.arange(24) - 1, 1)}, ("tree",)),
        ({"parents": np.arange(24)}, ("tree",)),
        ({"parents": np.r_[-1, 99, np.arange(1, 23)]}, ("tree",)),
    ],
)
def test_what_no_avatar_can_have_is_refused_by_name(tmp_path, change, facts):
    """An avatar of a stranger (`--avatar FILE`): none of these could be posed or drawn."""
    np.savez(tmp_path / "theirs.npz", **avatar() | change)
    with pytest.raises(StageError, match=r"theirs\.npz") as refused:
        read_avatar(tmp_path / "theirs.npz")
    assert holds(refused.value.facts[0], *facts)


@pytest.mark.parametrize("name", ["means", "scales", "sh0", "lbs_weights", "joints", "betas", "canonical_pose"])
@pytest.mark.parametrize("value", [1e300, -1e39, np.inf])
def test_numbers_that_no_float32_holds_are_refused(tmp_path, name, value):
    arrays = {key: np.array(array, np.float64) for key, array in avatar().items()}
    arrays[name].flat[0] = value
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(StageError, match=r"not finite|damaged"):
        read_avatar(tmp_path / "a.npz")


def test_an_avatar_of_nobody_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", **{key: value[:0] if len(value) == 5 else value for key, value in avatar().items()})
    with pytest.raises(StageError, match="damaged") as refused:
        read_avatar(tmp_path / "a.npz")
    assert "it has no Gaussians" in refused.value.facts


def test_clothes_have_as_many_bones_as_a_byte_numbers(tmp_path):
    for count, well in ((232, True), (233, False)):
        write_splats(tmp_path / "a.npz", dress(Avatar(**avatar()), some_clothes(count)))
        if well:
            assert len(read_avatar(tmp_path / "a.npz").clothes) == count
            continue
        with pytest.raises(StageError, match="has too many") as refused:
            read_avatar(tmp_path / "a.npz")
        assert refused.value.facts == ("233 bones of clothes", "232 are the most")


def test_files_of_earlier_versions_are_read_and_newer_ones_refused(tmp_path):
    for name, value in (("old.npz", {}), ("now.npz", {"version": 1}), ("new.npz", {"version": 3})):
        np.savez(tmp_path / name, **avatar(), **{key: np.int32(number) for key, number in value.items()})
    assert len(read_avatar(tmp_path / "old.npz")) == len(read_avatar(tmp_path / "now.npz")) == 5
    with pytest.raises(StageError, match=r"new\.npz .*newer"):
        read_avatar(tmp_path / "new.npz")
    write_splats(tmp_path / "written.npz", Avatar(**avatar()))
    with np.load(tmp_path / "written.npz") as data:
        assert data["version"] == 1
    write_splats(tmp_path / "dressed.npz", dress(Avatar(**avatar()), some_clothes()))
    with np.load(tmp_path / "dressed.npz") as data:
        assert data["version"] == 2, "older ones know no bones of clothes"
    back, clothes = read_avatar(tmp_path / "dressed.npz"), some_clothes()
    assert back.lbs_weights.shape == (5, 29) and len(back.clothes) == 5
    np.testing.assert_allclose(back.clothes.swings, clothes.swings, rtol=1e-6)


def test_an_avatar_of_0_1_0_and_0_2_0_still_reads(tmp_path):
    """As those versions wrote it: these arrays, float32, parents int32, no other."""
    old = {name: value.astype(np.int32 if name == "parents" else np.float32) for name, value in avatar().items()}
    np.savez(tmp_path / "avatar.npz", **old)
    back = read_avatar(tmp_path / "avatar.npz")
    assert not back.antialias and back.clothes is None and np.array_equal(back.means, old["means"])
