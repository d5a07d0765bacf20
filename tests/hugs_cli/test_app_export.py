"""`hugs export`: files of a finished run in the user's folder, with other settings; the run stays as it is."""

import os

import pytest

from tests.made.flow import Flow
from tests.made.said import holds

EXPORT = '''
"""Files of a format each."""
from typing import Literal
from stages.contract import Params as Base

class Params(Base):
    formats: list[Literal["ply", "bvh", "ply_motion"]] = ["ply"]
    names: Literal["smpl", "mixamo"] = "smpl"
    spz_axes: Literal["y_down", "y_up"] = "y_down"
    triangles: int = 200
    texture: int = 64

def run(job, params, *, four):
    """Write them."""
    for format in params.formats:
        place = job.out / f"avatar.{format}"
        if format.endswith("_motion"):
            place.mkdir()
            place = place / "frame0.ply"
        place.write_text(f"{params.names} {params.spz_axes}")
'''


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A finished run with an export of its own; to be copied."""
    flow = Flow(tmp_path_factory.mktemp("exported"))
    flow.write("export", EXPORT)
    file = flow.folder / "pipelines.yaml"
    file.write_text(
        file.read_text().replace("other:\n", "    export: {needs: [four], module: flow.export}\nother:\n", 1)
    )
    flow.hugs()
    return flow


@pytest.fixture
def run(exported, tmp_path):
    return exported.copied(tmp_path)


def links(flow):
    folder = flow.work / "clip" / "default"
    return {link.name: os.readlink(link) for link in folder.iterdir() if link.is_symlink()}


def export(flow, *args, code=0):
    return flow.hugs("--out", "mine", *args, command="export", code=code)


def held(flow):
    folder = flow.folder / "mine"
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_what_is_asked_for_comes_into_the_folder_and_the_run_stays_as_it_is(run):
    before, options = links(run), (run.work / "clip/default/options.json").read_text()
    out, said = export(run, "--formats", "bvh, ply_motion", "--names", "mixamo")
    assert held(run) == {"avatar.bvh": "mixamo y_down", "avatar.ply_motion/frame0.ply": "mixamo y_down"}
    assert out.split() == ["mine/avatar.bvh", "mine/avatar.ply_motion"]
    assert "params.names: smpl -> mixamo" in said
    assert links(run) == before and (run.work / "clip/default/options.json").read_text() == options
    assert run.ran() == {}
    export(run, "--set", "export.spz_axes=y_up")
    assert held(run)["avatar.ply"] == "smpl y_up" and len(held(run)) == 3, "files of another export stay"


def test_an_export_with_the_settings_of_the_run_is_a_copy(run):
    _, said = export(run)
    assert held(run) == {"avatar.ply": "smpl y_down"} and "cached" in said
    assert len(list(run.store.glob("export-*"))) == 1


def test_the_size_of_the_mesh_is_a_setting_of_its_own(run):
    _, said = export(run, "--triangles", "5000", "--texture", "1024")
    assert "params.triangles: 200 -> 5000" in said and "params.texture: 64 -> 1024" in said


def test_what_was_made_last_is_cached_and_kept_by_gc(run):
    export(run, "--names", "mixamo")
    export(run, "--spz-axes", "y_up")
    run.hugs(command="gc")
    assert len(list(run.store.glob("export-*"))) == 2, "the run's own and the last one"
    assert "cached" in export(run, "--spz-axes", "y_up")[1] and "done" in export(run, "--names", "mixamo")[1]


def test_nothing_is_trained_again_where_code_has_changed_since(run):
    before = links(run)
    run.edit("helper", "# with a comment", "count = 0")
    _, said = export(run, "--names", "mixamo")
    assert held(run) == {"avatar.ply": "mixamo y_down"} and links(run) == before
    assert "four" not in said


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--formats", "ply,obj"], ["'obj'", "'ply'"]),
        (["--names", "a/b"], ["'a/b'", "'mixamo'"]),
        (["--formats", ""], ["--formats"]),
        (["--set", "export.nothing=1"], ["'nothing'"]),
        (["--pipeline", "other"], ["no finished one", "pipeline other"]),
    ],
)
def test_what_cannot_be_understood_is_refused_at_once(run, args, words):
    _, said = export(run, *args, code=2)
    assert all(word in said for word in words), said
    assert not (run.folder / "mine").exists()


@pytest.mark.parametrize(
    "out", ["clip.mp4", "clip.mp4/files", "/proc/files", "work/clip/store", "work/clip/default/four"]
)
def test_a_folder_that_cannot_be_written_is_refused_at_once(run, out):
    _, said = run.hugs("--out", out, command="export", code=2)
    assert out in said and "`--out`" in said
    assert "export   " not in said, "before anything is made"


def test_files_of_others_are_not_written_over(run):
    (run.folder / "mine").mkdir()
    (run.folder / "mine" / "avatar.ply").write_text("theirs")
    (run.folder / "mine" / "notes.txt").write_text("theirs")
    _, said = export(run, code=2)
    assert holds(said, "error", "avatar.ply", "--force") and held(run)["avatar.ply"] == "theirs"
    export(run, "--force")
    assert held(run) == {"avatar.ply": "smpl y_down", "notes.txt": "theirs"}
    export(run, "--names", "mixamo")
    assert held(run)["avatar.ply"] == "mixamo y_down", "over its own"


def test_a_run_says_when_a_link_goes_back_to_other_settings(run):
    run.hugs("--set", "export.names=mixamo")
    _, said = run.hugs()
    (line,) = [line for line in said.splitlines() if "linked again" in line]
    assert "params.names: mixamo -> smpl" in line
    assert "linked again" not in run.hugs()[1]
