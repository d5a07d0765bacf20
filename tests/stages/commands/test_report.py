"""The page of a pipeline, while it grows and when it is whole, looked at by a real browser."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from stages import evaluate, export, render
from stages.commands import report
from stages.commands.report import clip as clip_parts
from stages.commands.report import results
from stages.contract import Job, StageError, StageRecord
from stages.formats.facts import Dataset, Metrics
from stages.formats.images import write_image
from tests.made import tiny as tiny_clip
from tests.made.browser import FOUND, LOADED, probe
from tests.made.command import ROOT
from tests.made.devtools import Page
from tests.made.meshes import coarse
from tests.made.networks import fetched
from tests.made.said import holds

PLACE = (
    "[...document.querySelectorAll('h2')].find(one => one.textContent === 'The cameras').getBoundingClientRect().top"
)
ALL = (*tiny_clip.STAGES, "export", "render", "evaluate")


def row(name, folder, state="done"):
    """A stage in the state of a run."""
    record = tiny_clip.UPSTREAM.get(name, StageRecord(1.0, 200 << 20))
    known = {"seconds": record.seconds, "peak_memory_bytes": record.peak_memory_bytes}
    said = {"notes": list(record.notes), "warnings": list(record.warnings)} if state == "done" else {}
    return {"name": name, "state": state, "folder": str(folder)} | (known if state == "done" else {}) | said


def show(folder, rows, over=False, known=None, **facts):
    """Write the state of a run, and the page of it; why parts are missing."""
    value = {"clip": "dance <1>.mp4", "pipeline": "default", "stages": rows, "over": over, **facts}
    (folder / report.STATE).write_text(json.dumps(value))
    return report.write(folder, report.State.read(json.dumps(value)), {} if known is None else known)


def make(clip, folder):
    """Run the stages after train, briefly; the rows of all stages. The folders lie as links do in a pipeline's folder."""
    fetched("lpips_alex.npz")
    done = {name: folder / name for name in ("export", "render", "evaluate")}
    for place in done.values():
        place.mkdir()
    shots = {name: clip[name] for name in ("sfm", "smpl", "train")}
    quick = render.Params(fps=8, turntable_frames=8, motion_seconds=1.0)
    needs = {name: clip[name] for name in ("frames", "sfm", "smpl", "train")}
    with coarse():
        export.run(Job(done["export"]), export.Params(triangles=500, texture=64), **needs)
    render.run(Job(done["render"]), quick, **shots)
    evaluate.run(Job(done["evaluate"], upstream=tiny_clip.UPSTREAM), evaluate.Params(fit_steps=1), **shots)
    return [row(name, (clip | done)[name]) for name in ALL]


@pytest.fixture(scope="module")
def finished(tiny, tmp_path_factory):
    """A pipeline's folder with a whole run, and its rows."""
    folder = tmp_path_factory.mktemp("report")
    return folder, make(tiny, folder)


@pytest.fixture(scope="module")
def page(finished):
    folder, rows = finished
    assert show(folder, rows, over=True) == []
    return folder / report.PAGE


def test_a_process_that_makes_the_page_loads_neither_torch_nor_numba(page):
    """They take two thirds of its time; a page of `preview` is to take 2 % of the run."""
    lines = (
        "import sys; from pathlib import Path; from stages.commands import report",
        "folder = Path(sys.argv[1])",
        "print(report.write(folder, report.State.read((folder / report.STATE).read_text()), {}))",
        "print(sorted({'torch', 'numba', 'llvmlite'} & set(sys.modules)))",
    )
    command = [sys.executable, "-c", "; ".join(lines), str(page.parent)]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.split() == ["[]", "[]"]


def beside(text):
    """What a page links to that is not in it."""
    return re.findall(r'(?:src|href|action)="((?!data:|#)[^"]*)', text)


def test_everything_is_told(page):
    text = page.read_text(encoding="utf-8")
    assert "<h1>dance &lt;1&gt;.mp4</h1>" in text and "sfm: the camera &lt;b&gt;barely&lt;/b&gt; moved" in text
    assert holds(text, "1,723 Gaussians", "person", "441", "scene")
    assert "What this clip called for" in text and "<td>shadow</td><td>on</td><td>0.21 of the light</td>" in text
    assert "<td class=n>+0.50 dB / +1.25 dB</td><td class=n>7 s</td>" in text, "what an effect is worth"
    assert "too small" in text, "LPIPS of a crop under 64 px"
    assert [name for name in ALL if f"<td>{name}</td>" not in text] == []
    assert text.count(">whole picture</text>") == text.count(">box of the person</text>") == 1, "two lines of the curve"
    assert "Training, step by step" in text and "<td>drawing</td><td class=n>9.0 s</td><td class=n>75 %</td>" in text
    assert {"export/viewer.html", "export/avatar.glb"} <= set(beside(text))
    assert [one for one in beside(text) if not (page.parent / one).is_file()] == [], (
        "it names no file that is not there"
    )
    assert not re.search(r"url\((?!#)|@import|https?://|<script", text), "nothing is fetched, nothing runs"


def test_a_page_that_is_copied_elsewhere_with_its_folders_names_the_files_there(page, tmp_path):
    """In a pipeline's folder these are links; copied, the page names nothing of where it was."""
    pipeline = tmp_path / "pipeline"
    pipeline.mkdir()
    shutil.copy(page, pipeline)
    for name in ("export", "render", "evaluate"):
        (pipeline / name).symlink_to(page.parent / name)
    moved = shutil.copytree(pipeline, tmp_path / "elsewhere")
    text = (moved / report.PAGE).read_text(encoding="utf-8")
    assert str(page.parent) not in text and not (moved / "export").is_symlink()
    assert "export/viewer.html" in beside(text)
    assert [one for one in beside(text) if one.startswith("/") or not (moved / one).is_file()] == []


@pytest.mark.slow
def test_the_browser_shows_everything_and_complains_of_nothing(page, tmp_path):
    found, logged = probe(page, tmp_path, 500)
    assert logged == []
    assert found["images"] == 9 and found["bad"] == [] and found["films"] == 4 and found["still"] == []
    assert not found["wide"], "the page is wider than a phone's screen"


@pytest.mark.slow
def test_a_page_that_was_moved_and_sent_works(page, tmp_path):
    """By itself; and with what lies beside it, zipped and unpacked elsewhere, when nothing is left where it was made."""
    alone, sent = tmp_path / "a mail" / "page.html", tmp_path / "J\xf6rg's #1 (50 %)"
    aside = page.parent.with_name("aside")
    alone.parent.mkdir()
    alone.write_bytes(page.read_bytes())
    shutil.unpack_archive(shutil.make_archive(str(tmp_path / "sent"), "zip", page.parent), sent)
    page.parent.rename(aside)
    try:
        for place, opened in ((alone, False), (sent / page.name, True)):
            with contextlib.closing(Page(tmp_path / f"profile-{opened}", (500, 900))) as tab:
                tab.open(place, LOADED)
                found = tab.run(FOUND)
                assert found["bad"] == found["still"] == [] and found["images"] == 9 and found["films"] == 4
                if opened:
                    tab.run("document.querySelector('a[href$=\"viewer.html\"]').click()")
                    wait(tab, "document.body?.matches('.open, .stuck')")
                    assert tab.run("document.body.matches('.open')"), tab.run("document.body.innerText")
                assert tab.said == []
                asked = {one.partition("#")[0] for one in tab.requests if not one.startswith(("data:", "blob:"))}
                assert asked == {place.as_uri()} | ({(sent / "export/viewer.html").as_uri()} if opened else set())
    finally:
        aside.rename(page.parent)


@pytest.mark.slow
def test_a_page_grows_stage_by_stage(finished, tmp_path):
    """Each finished stage adds its part; a training under way shows its last picture."""
    _, rows = finished
    sections = {}
    known = {}
    for n, name in enumerate(ALL):
        waits = [{"name": later, "state": "waits"} for later in ALL[n:]]
        assert show(tmp_path, [*rows[:n], *waits], known=known, now="13 %") == []
        text = (tmp_path / report.PAGE).read_text(encoding="utf-8")
        sections[name] = re.findall("<h2>(.*)</h2>", text)
    assert sections["frames"] == [] and "The frames" in sections["masks"]
    assert "The cameras" in sections["smpl"] and "The body fit" in sections["survey"]
    assert "What this clip called for" in sections["train"] and "Accuracy over time" not in sections["train"]
    part = tmp_path / "train.part"
    part.mkdir()
    write_image(part / "live.png", np.full((30, 60, 3), 90, np.uint8))
    show(tmp_path, [*rows[:5], row("train", part, "running")])
    text = (tmp_path / report.PAGE).read_text(encoding="utf-8")
    assert "<h2>Training</h2>" in text and 'class="running">train' in text


def test_a_stage_that_failed_leaves_its_pictures_and_the_error(finished, tmp_path):
    _, rows = finished
    error = {"problem": "no <person> was found", "facts": ["8 frames"], "hint": "`--masks`"}
    show(tmp_path, [*rows[:1], row("masks", tmp_path, "failed")], over=True, error=error)
    text = (tmp_path / report.PAGE).read_text(encoding="utf-8")
    assert "no &lt;person&gt; was found" in text and "<b>hint:</b> `--masks`" in text
    assert "<h2>The frames</h2>" in text and "<script" not in text and ">masks failed<" in text


def test_a_folder_whose_name_is_no_text_is_named(finished, tmp_path):
    """As of a work folder of another encoding: pictures there cannot be read, and the page is made."""
    _, rows = finished
    place = tmp_path / os.fsdecode(b"Bj\xf6rn")
    place.symlink_to(rows[0]["folder"])
    (trouble,) = show(tmp_path, [row("frames", place)])
    assert "is not UTF-8" in str(trouble) and "is not UTF-8" in (tmp_path / report.PAGE).read_text(encoding="utf-8")


def test_a_part_that_cannot_be_made_is_named_and_fails_at_the_end(finished, tmp_path, monkeypatch):
    _, rows = finished
    broken = tmp_path / "sfm"
    broken.mkdir()
    rows = [*rows[:2], row("sfm", broken)]
    (trouble,) = show(tmp_path, rows)
    assert "sfm" in str(trouble)
    text = (tmp_path / report.PAGE).read_text(encoding="utf-8")
    assert str(trouble)[:20] in text and "<h2>The outlines</h2>" in text
    show(tmp_path, rows, over=True)
    monkeypatch.setattr(os, "nice", lambda _: None)  # this process does more than the page
    with pytest.raises(StageError, match=re.escape(str(trouble))):
        report.run(Job(tmp_path), report.Params())


@pytest.mark.slow
def test_the_browser_reads_a_growing_page_again_and_keeps_its_place(finished, tmp_path, monkeypatch):
    """It ends as the page of the end, and reads that no more."""
    monkeypatch.setattr(report, "RELOAD", 1)
    _, rows = finished
    show(tmp_path, [*rows[:4], {"name": "train", "state": "waits"}])
    with contextlib.closing(Page(tmp_path / "profile", (600, 400), ["--disable-gpu"])) as tab:
        tab.open(tmp_path / report.PAGE, "document.readyState === 'complete'")
        assert tab.run("document.querySelectorAll('h2')[1].textContent") == "The cameras"
        tab.run("window.mine = 1; document.querySelectorAll('section')[1].scrollIntoView()")
        (before,) = {tab.run(PLACE) for _ in range(3)}
        show(tmp_path, [*rows[:5], row("train", tmp_path, "running")])
        wait(
            tab, "!window.mine && document.readyState === 'complete' && document.body.innerText.includes('called for')"
        )
        assert abs(tab.run(PLACE) - before) < 2
        show(tmp_path, rows[:6], over=True)
        wait(tab, "document.readyState === 'complete' && !document.querySelector('.steps')")
        tab.run("window.mine = 2")
        time.sleep(2)
        assert tab.run("window.mine") == 2, "the last page is not read again"
        assert abs(tab.run(PLACE) - before) < 2 and tab.said == []
        assert {one.partition("#")[0] for one in tab.requests if not one.startswith("data:")} == {
            (tmp_path / report.PAGE).as_uri()
        }


def wait(tab, until, seconds=60):
    """Until an expression is true; a page that is just being read again has none."""
    end = time.monotonic() + seconds
    while True:
        with contextlib.suppress(RuntimeError):
            if tab.run(until):
                return
        assert time.monotonic() < end, f"never {until}"
        time.sleep(0.1)


@pytest.mark.slow
def test_a_person_without_a_scene(tiny_human, tmp_path):
    rows = make(tiny_human, tmp_path)
    assert show(tmp_path, rows, over=True) == []
    text = (tmp_path / report.PAGE).read_text(encoding="utf-8")
    assert "PSNR, person over white" in text and "PSNR, whole picture" not in text
    found, logged = probe(tmp_path / report.PAGE, tmp_path, 900)
    assert logged == [] and found["films"] == 3 and found["bad"] == found["still"] == []


@pytest.mark.slow
def test_a_clip_with_nothing_held_out(tiny, tmp_path, monkeypatch):
    """Only `evaluate` is run: it has nothing to compare."""
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_FIRST", 99)
    shots = {name: tiny[name] for name in ("sfm", "smpl", "train")}
    done = tmp_path / "evaluate"
    done.mkdir()
    evaluate.run(Job(done, upstream=tiny_clip.UPSTREAM), evaluate.Params(fit_steps=1), **shots)
    show(tmp_path, [*(row(name, tiny[name]) for name in tiny_clip.STAGES), row("evaluate", done)], over=True)
    assert "No held-out frame" in (tmp_path / report.PAGE).read_text(encoding="utf-8")


def test_durations_are_read_easily():
    assert [results._duration(s) for s in (0.04, 59.94, 60, 3599)] == ["0.0 s", "59.9 s", "1 min 0 s", "59 min 59 s"]


def test_the_map_shows_the_way_ahead_to_the_right():
    """Two cameras that look along z, the second further ahead; a red point 4 ahead, a green one left of it."""
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[1, 2, 3] = -1.0
    points = np.array([[0.0, 0, 4], [-1, 0, 4]] * 50)
    colors = np.array([[255, 0, 0], [0, 255, 0]] * 50, np.uint8)
    picture = clip_parts.seen_from_above(viewmats, points, colors)
    red, green = ((picture == color).all(-1).nonzero() for color in colors[:2])
    blue = (picture == clip_parts.BLUE).all(-1).nonzero()
    assert blue[1].mean() < red[1].mean(), "the cameras are left of what they look at"
    assert green[0].mean() < red[0].mean(), "what is left of the way is up"


def test_the_papers_numbers_stand_beside_ours_for_its_own_sequences():
    ours = {"psnr": 25.0, "psnr_per_channel": 25.123, "ssim": 0.8412, "lpips": 0.3, "lpips_legacy": None}
    metrics = Metrics.model_construct(heldout={"full": ours, "person_crop": ours})
    rows = results._beside_paper(Dataset(name="neuman", sequence="bike", rule=""), metrics)
    assert ["whole picture", "PSNR dB", "25.12", "25.46"] in rows
    assert ["box of the person", "SSIM", "0.841", "0.67"] in rows
    assert ["whole picture", "LPIPS", "not measured", "0.13"] in rows and len(rows) == 6
    masked = Metrics.model_construct(heldout={"masked_full": ours})
    rows = results._beside_paper(Dataset(name="zju", sequence="CoreView_386", rule=""), masked)
    assert rows == [["person times mask, whole", "PSNR dB", "25.12", "34.11"]]
    assert results._beside_paper(Dataset(name="zju", sequence="CoreView_313", rule=""), metrics) == []
    assert results._beside_paper(None, metrics) == []
