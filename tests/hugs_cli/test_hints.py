"""What hints say helps: each is taken from what a command says, done, and the command goes through, or says it no more."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from stages.avatar.motion.formulas import MOTIONS
from stages.formats.images import write_image
from tests.made import finished
from tests.made.command import hugs_here
from tests.made.flow import WHOLE, Flow

FILLED = {
    "VIDEO": "clip.mp4",
    "MOTION": "moves.npz",
    "FILE": "avatar.npz",
    "moves.bvh": "moves.npz",
    "RUN": "work/clip/default",
}
FILLED |= {f"work/{clip}/default": "work/clip/default" for clip in ("kitchen", "dance")}
"""What a person puts for the words of a hint."""
SMALL = ("--fps", "2", "--only", "human")


def hinted(said: str, hint: str) -> list[str]:
    """The words of the command or option that was said in backticks, with what a person fills in."""
    assert f"`{hint}`" in said, said
    return [FILLED.get(word, word) for word in shlex.split(hint)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A clip that looks finished, its avatar, a motion, cameras, and a file that is no work of ours."""
    place = tmp_path_factory.mktemp("hints")
    finished.make(place)
    shutil.copyfile(place / "work/clip/default/train/avatar.npz", place / "avatar.npz")
    shutil.copyfile(place / "work/clip/default/train/scene.npz", place / "room.npz")
    orient, pose, transl = (part.numpy().astype(float) for part in MOTIONS["wave"](1.0, 10))
    np.savez(place / "moves.npz", poses=np.concatenate([orient, pose], 1), trans=transl, mocap_framerate=10.0)
    np.savez(place / "slow.npz", poses=np.concatenate([orient, pose], 1), trans=transl)
    K = [[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]]
    np.savez(place / "views.npz", viewmats=np.eye(4)[None], Ks=np.array(K), width=64, height=48)
    (place / "theirs.mp4").write_text("not ours")
    return place


DRAWN = {
    "a motion": ("hugs animate VIDEO moves.bvh", ["animate", "clip.mp4"]),
    "what to show": ("--only human", ["animate", "clip.mp4", "moves.npz", "--only", "scene"]),
    "an ending": ("--out motion.mp4", ["animate", "clip.mp4", "moves.npz", "--out", "motion.avi", *SMALL]),
    "somebody's file": ("--force", ["animate", "clip.mp4", "moves.npz", "--out", "theirs.mp4", *SMALL]),
    "a rate": ("--motion-fps", ["animate", "clip.mp4", "slow.npz", "--out", "slow.mp4", *SMALL]),
    "cameras": ("--cameras views.npz", ["render", "--avatar", "avatar.npz", "--scene", "room.npz", "--out", "views"]),
    "no clip": ("--avatar avatar.npz", ["render", "--cameras", "views.npz", "--only", "human", "--out", "none"]),
    "no films": ("hugs compose --init work/kitchen/default work/dance/default", ["compose", "--init"]),
    "a film's ending": ("--out film.yaml", ["compose", "--init", "work/clip/default", "--out", "film.txt"]),
    "films": ("hugs compose film.yaml", ["compose"]),
}
"""The hint, and the command that says it."""
MORE = {"--motion-fps": ["--motion-fps", "10"]}
"""The values that a hint leaves open."""


@pytest.mark.slow
@pytest.mark.parametrize("case", DRAWN)
def test_what_a_drawing_command_says_makes_it_go_through(folder, monkeypatch, capsys, case):
    hint, words = DRAWN[case]
    for film in folder.glob("film*"):
        film.unlink()
    if case == "films":
        (folder / "film.yaml").write_text(
            "scene: null\npeople: [{avatar: avatar.npz, motion: wave}]\ncamera: before\nfps: 2\nseconds: 0.5\nsize: [64, 48]\n"
            "out: {film: film.mp4}\n"
        )
    said = "".join(hugs_here(folder, monkeypatch, capsys, *words, code=0 if case == "a rate" else 2))
    done = hinted(said, hint)
    done = done[1:] if done[0] == "hugs" else [*words, *MORE.get(hint, done)]
    if done[0] == "animate" and "--fps" not in done:
        done += ["--fps", "2"]
    _, again = hugs_here(folder, monkeypatch, capsys, *done)
    assert f"`{hint}`" not in again


CHECK = """
        if name == "four" and not texts[0].startswith("two"):
            from stages.contract import StageError
            raise StageError("two is damaged", "make it again: `hugs run VIDEO two --force`")
        path.write_text("""
"""What readers of the stages say of a file that they cannot read: masks, sfm, smpl, train."""


@pytest.mark.slow
def test_a_stage_that_is_run_again_by_force_is_whole_although_its_stamp_said_so_before(flow):
    """What was wrong when the stamp was written is seen by the stage that reads it, and by nobody else."""
    flow.edit(
        "helper",
        "    path.write_text(",
        CHECK.lstrip("\n").replace("        ", "    ", 1).replace("\n        ", "\n    "),
    )
    flow.hugs()
    file = flow.work / "clip/default/two/out.txt"
    before, stat = file.read_bytes(), file.stat()
    file.write_bytes(before[::-1])
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    os.utime(file.with_name("stamp.json"))
    _, said = flow.hugs("four", "--force", code=1)
    _, command, _, *words = hinted(said, "hugs run VIDEO two --force")
    flow.hugs(*words, command=command)
    flow.hugs("four", "--force")
    assert file.read_bytes() == before and flow.text("four") == WHOLE


RUN = {
    "a setting": ("--set stage.param=value", ["--set", "word"], ["--set", "two.word=b"]),
    "a folder": ("--work", ["--work", "clip.mp4/work"], ["--work", "elsewhere"]),
}
"""The hint, the options of `hugs run` that make it say so, and those that it wants."""


@pytest.mark.parametrize("case", RUN)
def test_what_a_run_says_makes_it_go_through(flow, case):
    hint, wrong, right = RUN[case]
    assert hinted(flow.hugs("one", *wrong, code=2)[1], hint)
    flow.hugs("one", *right)


@pytest.mark.slow
def test_a_run_without_a_gpu_says_what_is_here(folder, monkeypatch, capsys):
    monkeypatch.setattr("hugs_cli.device.find_device", lambda: "cpu")
    words = ["animate", "clip.mp4", "moves.npz", "--out", "cpu.mp4", *SMALL]
    _, said = hugs_here(folder, monkeypatch, capsys, *words, "--device", "cuda", code=2)
    assert hinted(said, "--device cuda") and hinted(said, "hugs doctor")
    hugs_here(folder, monkeypatch, capsys, *words)


def test_the_settings_of_a_stage_are_listed_where_one_is_wrong(flow):
    """Stages of one name may differ in other pipelines."""
    flow.arguments = lambda *words: [*words, "--pipelines-file", str(flow.folder / "pipelines.yaml")]
    for pipeline in ("default", "other"):
        _, said = flow.hugs("clip.mp4", "--pipeline", pipeline, "--set", "four.delay=soon", code=2)
        _, command, *words = hinted(said, re.search("`(hugs stages [^`]+)`", said)[1])
        out, _ = flow.hugs(*words, "--json", command=command)
        (stage,) = json.loads(out)["stages"]
        assert stage["params"] == {"word": "z" if pipeline == "other" else "a", "delay": 0.0, "hold": ""}


@pytest.mark.slow
def test_results_that_nothing_uses_make_room(made):
    """`hugs gc`, as a full disk says."""
    made.hugs("--set", "one.word=b")
    before = len(list(made.store.iterdir()))
    made.hugs(command="gc")
    assert len(list(made.store.iterdir())) == before // 2 and list(made.ran("--set", "one.word=b")) == []


@pytest.fixture
def pictures(tmp_path) -> Flow:
    """A pipeline of the real first stage alone, and pictures in a folder within the clip's."""
    flow, rng = Flow(tmp_path), np.random.default_rng(0)
    (tmp_path / "pipelines.yaml").write_text(
        "default:\n  doc: One.\n  stages: {frames: {module: stages.frames, needs: [video]}}\n"
    )
    flow.video.unlink()
    (flow.video / "inner").mkdir(parents=True)
    for i in range(10):
        write_image(flow.video / f"inner/{i:03d}.png", rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    return flow


@pytest.mark.slow
def test_the_folder_that_has_the_pictures_their_rate_and_a_place_for_results(pictures):
    _, said = pictures.hugs(code=1)
    _, command, inner = hinted(said, re.search("`(hugs run [^`]+)`", said)[1])
    assert Path(inner) == pictures.video / "inner"
    pictures.arguments = lambda command, *args: [command, inner, *args, "--pipelines-file", "pipelines.yaml"]
    _, said = pictures.hugs(command=command)
    rate = hinted(said, "--set frames.folder_fps=30")
    _, again = pictures.hugs(*rate, command=command)
    assert "does not say" not in again and (pictures.work / "inner/default/frames/frames.json").is_file()
    pictures.folder = Path(inner)
    pictures.arguments = lambda command, *args: [command, ".", *args, "--pipelines-file", "../../pipelines.yaml"]
    _, said = pictures.hugs(code=2)
    pictures.hugs(*hinted(said, re.search("`(--work [^`]+)`", said)[1]))
    assert (Path(inner).parent / "work/inner/default/frames/frames.json").is_file()
