"""SOG, where gaussforge is: what it unpacks again."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stages.formats.exchange.ply import read_ply
from stages.formats.exchange.sog import check_sog, write_sog
from stages.records import Scene
from tests.made.judges import modules, node

gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed (the extra `sog`)")


@pytest.fixture
def splats() -> Scene:
    rng, n = np.random.default_rng(0), 3000
    quats = rng.normal(size=(n, 4))
    parts = {
        "means": rng.uniform(-1, 1, (n, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": np.exp(rng.uniform(-7, -3, (n, 3))),
        "opacities": rng.uniform(0.05, 0.95, n),
        "sh0": rng.uniform(-1.7, 1.7, (n, 3)),
        "shN": np.zeros((n, 0, 3)),
    }
    return Scene(**{name: part.astype(np.float32) for name, part in parts.items()})


@pytest.mark.parametrize("antialias", [True, False])
def test_it_says_whether_they_were_learned_with_antialiasing(tmp_path, splats, antialias):
    """To readers of the format's paper, and to PlayCanvas's own program."""
    path = tmp_path / "a.sog"
    write_sog(path, replace(splats, antialias=antialias))
    with zipfile.ZipFile(path) as file:
        meta = json.loads(file.read("meta.json"))
    assert meta["antialias"] is antialias and meta.get("model", "default") == (
        "antialiased" if antialias else "default"
    )
    node(modules() / "@playcanvas/splat-transform/bin/cli.mjs", path, tmp_path / "back.ply")
    assert read_ply(tmp_path / "back.ply").antialias is antialias
    write_sog(tmp_path / "b.sog", replace(splats, antialias=antialias))
    assert path.read_bytes() == (tmp_path / "b.sog").read_bytes()


@pytest.mark.slow
def test_what_comes_back(tmp_path, held, splats):
    n = len(splats)
    check_sog()
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, splats)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    back = gaussforge.GaussForge().convert((tmp_path / "a.sog").read_bytes(), "sog", "ply")
    (tmp_path / "back.ply").write_bytes(back["data"])
    found = read_ply(tmp_path / "back.ply")
    distance, row = cKDTree(splats.means).query(found.means)  # SOG has an order of its own
    assert len(set(row)) == n
    held(1000 * np.percentile(distance, 99), 0.2, "p99 of places, mm")
    held(0.2820948 * np.percentile(np.abs(found.sh0 - splats.sh0[row]), 99), 4 / 255, "p99 of colours")
    held(np.percentile(np.abs(np.log(found.scales / splats.scales[row])), 99), 0.1, "p99 of logarithms of scales")
    held(np.percentile(np.abs(found.opacities - splats.opacities[row]), 99), 1 / 255, "p99 of opacities")
