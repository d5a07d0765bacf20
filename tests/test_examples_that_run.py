"""Examples that run and train, from their own files and on a clip that costs nothing; and the cells of each notebook."""

import json
import runpy
import sys

import numpy as np
import pytest
from PIL import Image

from hugs_cli import pipelines
from stages.formats.clip import load_clip
from stages.training import settings
from tests.made import handed, tiny
from tests.made.examples import EXAMPLES, write_arrays
from tests.tools import notebook as notebooks

SMALL = {"steps": 6, "human_points": 1500, "channels": 8, "resolution": 16, "scene_fill": 0, "curve_points": 1}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The current folder, with kitchen.mp4 and a pipeline `default` that hands on what is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(pipelines, "FILE", handed.pipelines(tmp_path))
    (tmp_path / "kitchen.mp4").write_text("pixels")
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] == "handed"]:
        del sys.modules[name]


def run(monkeypatch, name: str, *arguments: str) -> None:
    """Run an example with these arguments."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


@pytest.mark.slow
def test_own_masks(place, monkeypatch, capsys):
    run(monkeypatch, "own_masks", "made/sfm/images", "masks")
    assert "train done" in capsys.readouterr().out
    assert "masks" in json.loads((place / "work/images/default/options.json").read_text())["masks"]
    mask = np.asarray(Image.open(place / f"masks/{tiny.NAMES[0]}.png"))
    truth = np.asarray(Image.open(place / f"made/sfm/masks/{tiny.NAMES[0]}.png")) > 127
    assert ((mask > 0) & truth).sum() > 0.5 * ((mask > 0) | truth).sum()


@pytest.mark.slow
def test_train_on_arrays(place, monkeypatch, capsys):
    write_arrays(place / "arrays.npz", load_clip(place / "made/sfm", place / "made/smpl"))
    monkeypatch.setattr("hugs.learning.Params", lambda **given: settings.Params(**given | SMALL))
    run(monkeypatch, "train_on_arrays", "arrays.npz", "mine")
    assert "8 frames" in capsys.readouterr().out
    drawn = np.asarray(Image.open(place / "mine/frame.png"))
    assert drawn.shape == (tiny.HEIGHT, tiny.WIDTH, 3) and drawn.std() > 10
    assert {"avatar.npz", "scene.npz", "train.json"} <= {file.name for file in (place / "mine").iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda file: file.stem)
def test_a_notebook_shows_what_its_cells_make(file, place):
    kept = json.loads(file.read_text("utf-8"))
    assert kept["nbformat"] == 4 and file.stat().st_size < 500_000
    again = json.loads(file.read_text("utf-8"))
    notebooks.run(again, place)
    for cell, other in zip(kept["cells"], again["cells"], strict=True):
        shown, made = ([set(one.get("data", one)) for one in each.get("outputs", ())] for each in (cell, other))
        assert shown == made, "".join(cell["source"])
    assert any("image/jpeg" in one.get("data", ()) for cell in kept["cells"] for one in cell.get("outputs", ()))
