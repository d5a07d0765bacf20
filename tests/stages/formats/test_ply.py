"""Gaussians as .ply: the layout that viewers read, and what cannot be written."""

import tracemalloc

import numpy as np
import pytest
import torch

from stages.avatar.splats.gaussians import finite_rows
from stages.contract import StageError
from stages.formats.ply import write_ply
from stages.records import Scene


def scene(n=5, bases=4, **changes):
    rng = np.random.default_rng(0)
    parts = {
        "means": rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.01, 0.1, (n, 3)),
        "opacities": rng.uniform(0.1, 0.9, n),
        "sh0": rng.normal(size=(n, 3)),
        "shN": rng.normal(size=(n, bases - 1, 3)),
    }
    return Scene(**{k: v.astype(np.float32) for k, v in (parts | changes).items()})


def read(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))


def test_l07_l09_every_column_stands_where_viewers_look_for_it(tmp_path):
    splats = scene()
    assert write_ply(tmp_path / "a.ply", splats) == 0
    found = read(tmp_path / "a.ply")
    assert len(found) == 62, "degree 3: many viewers take nothing else"
    np.testing.assert_allclose(np.stack([found[c] for c in "xyz"], 1), splats.means)
    np.testing.assert_allclose(np.stack([found[f"rot_{i}"] for i in range(4)], 1), splats.quats)
    np.testing.assert_allclose(np.exp(np.stack([found[f"scale_{i}"] for i in range(3)], 1)), splats.scales, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found["opacity"])), splats.opacities, rtol=1e-5)
    rest = np.stack([found[f"f_rest_{i}"] for i in range(45)], 1).reshape(-1, 3, 15)
    np.testing.assert_allclose(rest[:, :, :3], splats.shN.transpose(0, 2, 1))
    assert (rest[:, :, 3:] == 0).all()


def test_l02_opacities_without_a_logit_are_bounded_and_counted(tmp_path):
    assert write_ply(tmp_path / "a.ply", scene(opacities=np.array([0, 1, 0.5, 0.5, 0.5]))) == 2
    assert read(tmp_path / "a.ply")["opacity"].tolist() == [-15, 15, 0, 0, 0]


def test_l10_a_scale_that_is_not_positive_is_refused_by_row(tmp_path):
    scales = np.full((5, 3), 0.1)
    scales[3, 1] = 0
    with pytest.raises(StageError) as refused:
        write_ply(tmp_path / "a.ply", scene(scales=scales))
    assert "row 3" in refused.value.facts[0] and not (tmp_path / "a.ply").exists()


def test_l01_an_opacity_out_of_range_is_refused_by_row(tmp_path):
    with pytest.raises(StageError) as refused:
        write_ply(tmp_path / "a.ply", scene(opacities=np.array([0.5, 0.5, 1.5, 0.5, np.nan])))
    assert "row 2" in refused.value.facts[0]


@pytest.mark.parametrize("degree", [0, 3])
def test_l04_rows_that_are_left_out_take_their_coefficients_along(tmp_path, degree):
    splats = scene(bases=(degree + 1) ** 2)
    splats.scales[2, 1] = np.nan
    parts = {name: part for name, part in vars(splats).items() if isinstance(part, np.ndarray)}
    kept = finite_rows(map(torch.as_tensor, parts.values())).numpy()
    assert kept.tolist() == [True, True, False, True, True]
    write_ply(tmp_path / "a.ply", Scene(**{name: part[kept] for name, part in parts.items()}))
    found = read(tmp_path / "a.ply")
    rest = np.stack([found[f"f_rest_{i}"] for i in range(45)], 1).reshape(-1, 3, 15)[:, :, : splats.shN.shape[1]]
    np.testing.assert_array_equal(rest, splats.shN[kept].transpose(0, 2, 1))


def test_l05_no_gaussians_is_a_valid_file(tmp_path):
    assert write_ply(tmp_path / "a.ply", scene(0)) == 0
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes() and len(read(tmp_path / "a.ply")["x"]) == 0


def test_l06_memory_does_not_grow_with_the_file(tmp_path, held):
    peaks = []
    for n in (100_000, 200_000):
        splats = scene(n)
        tracemalloc.start()
        write_ply(tmp_path / "a.ply", splats)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (tmp_path / "a.ply").stat().st_size > 200_000 * 248
    held((peaks[1] - peaks[0]) / 100_000, 40, "bytes a row of 248")
