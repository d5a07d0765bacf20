"""Every line of Python in the documents is run, on a small avatar; so is the stage that architecture.md adds."""

import inspect
import shutil
import sys
from types import ModuleType

import numpy as np
import pytest

import hugs
import hugs.learning
from hugs_cli import pipelines
from stages.avatar.drawing.attach import attach
from stages.contract import Job
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.formats.images import read_image
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar, write_splats
from stages.training.results import Result
from tests.docs.documents import documents
from tests.made import tiny

DOCUMENTS = {document.name: document for document in documents()}
LINES = 8  # of the example in README, without its imports


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A folder in which work/dance/default has the stages up to train, and the avatar of export."""
    monkeypatch.chdir(tmp_path)
    folders = tiny.make(tmp_path / "work" / "dance" / "default")
    body = read_body_model()
    moving = attach(read_avatar(folders["train"] / "avatar.npz"), body, read_hands_face(body))
    write_splats(folders["train"] / "avatar.npz", moving)
    export = tmp_path / "work" / "dance" / "default" / "export"
    export.mkdir()
    shutil.copy(folders["train"] / "avatar.npz", export)
    return tmp_path


def test_all_documents_with_python_are_run_here():
    found = {name for name, document in DOCUMENTS.items() if document.blocks("python")}
    assert found == {"README.md", "docs/python.md", "docs/architecture.md", "docs/researchers.md"}


def test_readme(work):
    (block,) = DOCUMENTS["README.md"].blocks("python")
    assert len(block.partition("\n\n")[2].splitlines()) == LINES
    names: dict = {}
    exec(block, names)
    person = names["person"]
    n = len(person.opacities)
    assert [part.shape for part in names["arrays"]] == [(n, 3), (n, 4), (n, 3), (n,), (n, 3)]
    image = read_image(work / "pose.png")
    assert image.shape == (512, 512, 3)
    assert_in_the_middle(names["alpha"])


def assert_in_the_middle(coverage):
    """The whole person is in the picture, and not small."""
    rows, columns = (np.flatnonzero(coverage.max(axis) > 0.5) for axis in (1, 0))
    assert rows[0] > 0 and rows[-1] < 511 and columns[0] > 0 and columns[-1] < 511
    assert len(rows) > 256


@pytest.mark.slow
def test_the_plot_that_researchers_draw(work, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    rows = "step,seconds,psnr\n100,10.5,20.0\n200,21.0,30.0\n"
    (work / "work" / "dance" / "default" / "train" / "curve.csv").write_text(rows)
    names: dict = {}
    (block,) = DOCUMENTS["docs/researchers.md"].blocks("python")
    exec(block, names)
    (line,) = names["plt"].gca().lines
    np.testing.assert_allclose(line.get_xydata(), [[10.5, 1e-2], [21, 1e-3]])
    assert (work / "loss.pdf").stat().st_size > 1000


def checked(function, result=None):
    """In place of a function that takes long: refuses what it would not take."""

    def called(*given, **named):
        inspect.signature(function).bind(*given, **named)
        return result

    return called


def test_python_md(work, monkeypatch):
    """What runs, trains and makes films is run in tests/hugs and tests/examples; here its calls are checked."""
    train, scene = work / "work/dance/default/train", tiny.make_scene()
    person = read_avatar(train / "avatar.npz"), read_poses(train / "body.npz")
    for name in ("run", "export", "animate", "compose"):
        monkeypatch.setattr(hugs, name, checked(getattr(hugs, name)))
    monkeypatch.setattr(hugs, "train", checked(hugs.train, Result([person], scene, None, None, [], {})))
    taken = [*inspect.signature(hugs.learning.train).parameters]
    np.savez(work / "arrays.npz", **dict.fromkeys(taken, np.zeros(1)))
    names: dict = {}
    first, *more = DOCUMENTS["docs/python.md"].blocks("python")
    exec(first, names)
    assert_in_the_middle(names["alpha"])
    for block in more:
        exec(block, names)
    assert names["turns"].grad.abs().max() > 0 and names["viewmat"].grad.abs().max() > 0
    assert len(names["mine"].record) == len(person[0]) and names["room"].count == len(scene)
    drawn = read_image(work / "frame.png").astype(float)
    truth = read_image(work / "work" / "dance" / "default" / "sfm" / "images" / f"{tiny.NAMES[0]}.png")
    assert np.abs(drawn - truth).max() <= 2


def test_the_stage_that_architecture_md_adds(work, monkeypatch):
    """The stage is found, its settings are checked, and it does what it says."""
    (code,) = DOCUMENTS["docs/architecture.md"].blocks("python")
    (entry,) = DOCUMENTS["docs/architecture.md"].blocks("yaml")
    module = ModuleType("stages.sheet")
    monkeypatch.setitem(sys.modules, "stages.sheet", module)
    exec(code, module.__dict__)
    (work / "mine.yaml").write_text(entry)
    stage = pipelines.load("sheet", file=work / "mine.yaml").stages["sheet"]
    assert stage.params.columns == 4
    said = []
    frames = work / "work" / "dance" / "default" / "sfm"  # tiny keeps its pictures there, in images/ as frames does
    module.run(Job(work, emit=said.append), stage.params, frames=frames)
    assert read_image(work / "sheet.png").shape == (2 * tiny.HEIGHT, 4 * tiny.WIDTH, 3)
    assert "2 rows of 4" in said[-1]["text"]
