"""The page of a result, looked at by a real browser."""

import re

import pytest

from stages import evaluate, export, render, report
from stages.contract import Job, StageError, StageRecord
from stages.estimators import assets
from stages.formats.facts import Dataset, Metrics
from tests.made import tiny as tiny_clip
from tests.made.browser import probe
from tests.made.meshes import coarse


def make(clip, folder):
    """Run the stages after train, briefly, then the report; returns the page."""
    try:
        assets.fetch("lpips_alex.npz")
    except StageError as error:
        pytest.skip(f"{error}: {' '.join(error.facts)}")
    done = {name: folder / name for name in ("export", "render", "evaluate", "report")}
    for place in done.values():
        place.mkdir()
    shots = {name: clip[name] for name in ("sfm", "smpl", "train")}
    quick = render.Params(fps=8, turntable_frames=8, motion_seconds=1.0)
    needs = {name: clip[name] for name in ("frames", "sfm", "smpl", "train")}
    with coarse():
        export.run(Job(done["export"]), export.Params(triangles=500, texture=64), **needs)
    render.run(Job(done["render"]), quick, **shots)
    evaluate.run(Job(done["evaluate"], upstream=tiny_clip.UPSTREAM), evaluate.Params(fit_steps=1), **shots)
    upstream = tiny_clip.UPSTREAM | {name: StageRecord(1.0, 200 << 20) for name in ("export", "render", "evaluate")}
    inputs = {name: clip[name] for name in clip if name != "masks"} | done
    del inputs["report"]
    report.run(Job(done["report"], upstream=upstream), report.Params(), **inputs)
    return done["report"] / "report.html"


@pytest.fixture(scope="module")
def page(tiny, tmp_path_factory):
    return make(tiny, tmp_path_factory.mktemp("report"))


def test_everything_is_told(page):
    text = page.read_text(encoding="utf-8")
    assert "<h1>dance &lt;1&gt;.mp4</h1>" in text and "sfm: the camera &lt;b&gt;barely&lt;/b&gt; moved" in text
    assert "1,723 Gaussians in the person, 441 in the scene" in text and "The scene is modelled" in text
    assert "What this clip called for" in text and "<td>shadow</td><td>on</td><td>0.21 of the light</td>" in text
    assert "<td class=n>+0.50 dB / +1.25 dB</td><td class=n>7 s</td>" in text, "what an effect is worth"
    assert "too small" in text, "LPIPS of a crop under 64 px"
    assert [name for name in tiny_clip.STAGES if f"<td>{name}</td>" not in text] == []
    assert text.count(">whole picture</text>") == text.count(">box of the person</text>") == 1, "two lines of the curve"
    assert "Training, step by step" in text and "<td>drawing</td><td class=n>9.0 s</td><td class=n>75 %</td>" in text
    beside = ["../export/viewer.html", "../../costs.html", "../../costs.svg"]
    assert (page.parent / beside[0]).is_file()
    assert re.findall(r'(?:src|href|action)="((?!data:|#)[^"]*)', text) == beside, "that is all it looks for"
    assert not re.search(r"url\((?!#)|@import|https?://", text), "nothing is fetched"


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 500])
def test_the_browser_shows_everything_and_complains_of_nothing(page, tmp_path, width):
    found, logged = probe(page, tmp_path, width)
    assert logged == []
    assert found["images"] == 8 and found["bad"] == [] and found["films"] == 4 and found["still"] == []
    assert not found["wide"], f"the page is wider than {width} px"


@pytest.mark.slow
def test_a_person_without_a_scene(tiny_human, tmp_path):
    (tmp_path / "made").mkdir()
    page = make(tiny_human, tmp_path / "made")
    text = page.read_text(encoding="utf-8")
    assert "PSNR, person over white" in text and "PSNR, whole picture" not in text
    found, logged = probe(page, tmp_path, 900)
    assert logged == [] and found["films"] == 3 and found["bad"] == found["still"] == []


def test_a_clip_with_nothing_held_out(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.formats.splits.HELD_OUT_FIRST", 99)
    text = make(tiny, tmp_path).read_text(encoding="utf-8")
    assert "No held-out frame could be compared." in text


def test_durations_are_read_easily():
    assert [report._duration(s) for s in (0.04, 59.94, 60, 3599)] == ["0.0 s", "59.9 s", "1 min 0 s", "59 min 59 s"]


def test_the_papers_numbers_stand_beside_ours_for_its_own_sequences():
    ours = {"psnr": 25.0, "psnr_per_channel": 25.123, "ssim": 0.8412, "lpips": 0.3, "lpips_legacy": None}
    metrics = Metrics.model_construct(heldout={"full": ours, "person_crop": ours})
    rows = report._beside_paper(Dataset(name="neuman", sequence="bike", rule=""), metrics)
    assert ["whole picture", "PSNR dB", "25.12", "25.46"] in rows and [
        "box of the person",
        "SSIM",
        "0.841",
        "0.67",
    ] in rows
    assert ["whole picture", "LPIPS", "not measured", "0.13"] in rows and len(rows) == 6
    masked = Metrics.model_construct(heldout={"masked_full": ours})
    rows = report._beside_paper(Dataset(name="zju", sequence="CoreView_386", rule=""), masked)
    assert rows == [["person times mask, whole", "PSNR dB", "25.12", "34.11"]]
    assert report._beside_paper(Dataset(name="zju", sequence="CoreView_313", rule=""), metrics) == []
    assert report._beside_paper(None, metrics) == []
