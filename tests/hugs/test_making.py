"""`hugs.export`, `hugs.animate`, `hugs.compose`: what the commands make, from this process, and the paths of it."""

import sys
from pathlib import Path

import pytest

import hugs
from stages.formats.exchange.ply import read_ply
from stages.formats.video import probe
from tests.made import finished
from tests.made.flow import Flow
from tests.made.said import holds

EXPORT = '''
"""A file of each format."""
from stages.contract import Params as Base

class Params(Base):
    formats: list[str] = ["ply"]
    names: str = "smpl"

def run(job, params, *, four):
    """Write them."""
    for one in params.formats:
        (job.out / f"avatar.{one}").write_text(params.names)
'''


@pytest.mark.slow
def test_an_export_of_a_finished_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    flow, file = Flow(tmp_path), tmp_path / "pipelines.yaml"
    flow.write("export", EXPORT)
    text = file.read_text().replace("other:\n", "    export: {needs: [four], module: flow.export}\nother:\n", 1)
    file.write_text(text)
    flow.hugs("--set", "two.word=w")
    how = {"settings": {"names": "mixamo"}, "progress": lambda now: None, "pipelines_file": file}
    made = hugs.export("work/clip/default", "mine", ["glb", "bvh"], **how)
    assert made == [Path("mine/avatar.bvh"), Path("mine/avatar.glb")] and made[0].read_text() == "mixamo"
    with pytest.raises(hugs.StageError) as refused:
        hugs.export("mine", "other")
    assert holds(str(refused.value), "mine", "sources.json", "hint:")
    for name in [name for name in sys.modules if name.partition(".")[0] == "flow"]:
        del sys.modules[name]


@pytest.mark.slow
def test_films_of_a_run_and_of_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run, heard = finished.make(tmp_path), []
    film = hugs.animate(run, "clip", "moves.mp4", fps=5, progress=heard.append)
    assert film == Path("moves.mp4") and probe(film).width == 96
    assert any(now.stage == "animate" and 0 < now.done <= now.total for now in heard)
    people = [{"avatar": run / "train/avatar.npz", "motion": "wave"}]
    (ply,) = hugs.compose({"people": people, "camera": "before", "out": {"splats": "one.ply"}}, progress=heard.append)
    assert len(read_ply(ply)) > 1000
    with pytest.raises(hugs.StageError, match="no output"):
        hugs.compose({"people": people})
    with pytest.raises(hugs.StageError, match=r"moves\.mov"):
        hugs.animate(run, "wave", "moves.mov")
