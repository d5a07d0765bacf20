"""`hugs costs`: the front, the knee, what is not compared, what is drawn; on made-up numbers and a flow that trains nothing."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from hugs_cli.studies import costs
from hugs_cli.studies.comparison import METRICS, REGIONS
from stages.commands import costs_page as drawing
from stages.contract import StageError
from stages.formats.images import read_image
from tests.made.browser import probe
from tests.made.said import any_holds, holds


def run_(name: str, seconds: float, psnr: float, **changed) -> costs.Run:
    """A run of so many seconds, of which frames took 10, and so many dB, 3 fewer on the person."""
    scores = {region: dict.fromkeys(METRICS, psnr - 3 * i) for i, region in enumerate(REGIONS)}
    sizes, times = {"human": 10, "scene": 20}, {"frames": 10.0, "train": seconds - 10}
    return replace(costs.Run(name, 0, times, 1 << 30, sizes, scores, "same", "here", "now"), **changed)


def test_the_front_is_what_nothing_as_quick_beats():
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = [tuple(map(float, p)) for p in rng.integers(1, 8, (int(rng.integers(1, 12)), 2))]
        best = costs.front(points)
        beaten = {p for p in points for q in points if q != p and q[0] <= p[0] and q[1] >= p[1]}
        assert {points[i] for i in best} == set(points) - beaten
        assert [points[i] for i in best] == sorted(set(points) - beaten), "by rising time, equals once"


@pytest.mark.parametrize(
    ("points", "stop"),
    [
        ([(60, 20.0)], 0),
        ([(60, 20.0), (120, 20.11)], 1),
        ([(60, 20.0), (120, 20.09)], 0),
        ([(60, 20.0), (240, 20.19)], 0),  # two doublings
        ([(60, 20.0), (240, 20.21)], 1),
        ([(60, 20.0), (120, 20.05), (240, 20.5)], 2),  # a step that buys nothing, before one that does
        ([(60, 20.0), (120, 21.0), (240, 21.05), (480, 21.08)], 1),
        ([(60, 20.0), (120, 19.0), (60, 20.0)], 0),
    ],
)
def test_the_knee_is_where_a_doubling_of_time_no_longer_buys_a_tenth_of_a_decibel(points, stop):
    assert costs.knee(points) == stop


def test_rows_take_the_least_time_and_mean_accuracy_of_their_seeds_and_gains_are_between_neighbours_on_the_front():
    found = [run_("b", 130, 30.0), run_("a", 70, 26.0), run_("a", 95, 28.0, seed=1, peak_memory_bytes=3 << 30)]
    found += [run_("worse", 100, 26.5), run_("c", 190, 30.01)]
    result = costs.compared(found)
    rows = {row["pipeline"]: row for row in result["rows"]}
    assert list(rows) == ["a", "worse", "b", "c"] and result["knee"] == {"full": "b", "person_crop": "b"}
    assert rows["a"]["seeds"] == [0, 1] and rows["a"]["peak_memory_bytes"] == 3 << 30
    assert rows["a"]["seconds"] == {"frames": 10, "train": 60, "total": 70}
    assert rows["a"]["scores"]["full"]["psnr"] == {
        "mean": 27.0,
        "spread": pytest.approx(2**0.5),
        "values": [26.0, 28.0],
    }
    assert rows["b"]["db_per_minute"] == {"full": pytest.approx(3.0), "person_crop": pytest.approx(3.0)}
    assert rows["a"]["db_per_minute"] == {"full": None, "person_crop": None} and rows["worse"]["front"] == []
    text = "\n".join(costs.table(result))
    assert f"{'b':<26}{'30.00':<26}{'30.0000':<26}{'30.0000':<26}+3.00  knee" in text
    assert holds(text, "doubling", "0.1 dB") and "note" not in text


def test_what_was_measured_on_other_pictures_is_shown_but_on_no_front():
    found = [run_("a", 70, 28.0), run_("b", 130, 30.0), run_("small", 40, 35.0, pictures="small")]
    result = costs.compared(found)
    assert result["rows"][0]["front"] == [] and result["knee"]["full"] == "b"
    (note,) = result["notes"]
    assert holds(note, "frames", "no front", "small")


def test_machines_and_code_that_differ_are_named():
    result = costs.compared([run_("a", 70, 28.0), run_("b", 130, 30.0, machine="there", code="then")])
    assert holds(result["notes"][0], "different machines", "here", "there")
    assert holds(result["notes"][1], "different versions", "code")


def test_without_a_scene_the_person_over_white_is_compared():
    found = [run_("a", 70, 28.0), run_("b", 130, 30.0)]
    for one in found:
        one.scores["full"] = one.scores["person_crop"] = dict.fromkeys(METRICS)
    result = costs.compared(found)
    assert result["knee"] == {"person_white": "b"}
    assert "person over white" in "\n".join(costs.table(result))


def test_where_nothing_was_measured_times_are_compared_and_that_is_said(tmp_path):
    found = [run_("a", 70, 28.0), run_("b", 130, 30.0)]
    for region in REGIONS:  # nobody is in the frames that were held out, and b has no scene
        found[1].scores[region] = dict.fromkeys(METRICS)
    result = costs.compared(found)
    lines = "\n".join(costs.table(result))
    assert "1m 10s" in lines and holds(lines.splitlines()[-1], "note", "accuracy")
    with pytest.raises(StageError, match="nothing to plot"):
        costs.write_page(tmp_path, "costs", "clip", result)


@pytest.mark.slow
def test_the_page_and_its_plot_are_whole_in_a_narrow_browser(tmp_path):
    found = [run_("a<b", 70, 28.0), run_("a<b", 75, 28.4, seed=1), run_("b", 130, 30.0), run_("c", 500, 30.1)]
    found[-1].scores["person_crop"]["lpips"] = None
    result = costs.compared(found)
    panels = drawing.panels(result, {region: REGIONS[region] for region in ("full", "person_crop")})
    assert [panel.y_name for panel in panels] == ["PSNR dB, whole picture", "PSNR dB, person"] * 2
    text = (page := costs.write_page(tmp_path, "costs", "<clip>", result)).read_text()
    assert text.count(">Pareto front</text>") == 1 and "<h1>&lt;clip&gt;</h1>" in text and "a<b" not in text
    seen, logged = probe(page, tmp_path, 500)
    assert logged == [] and not seen["wide"]


@pytest.mark.slow
def test_fewer_than_two_pipelines_are_nothing_to_compare(clip):
    _, err = clip.hugs("--axis", "sh", command="costs", code=2)
    assert holds(err, "error", "axes", "hint", "--sweep")
    _, err = clip.hugs(command="costs", code=2)
    assert holds(err, "two pipelines", "work/clip", "finished: none", "hint")
    clip.hugs("train", "--pipeline", "tiny")
    clip.hugs("--pipeline", "quick")
    _, err = clip.hugs(command="costs", code=2)
    assert "finished: quick" in err and holds(err, "trained again", "tiny")


@pytest.mark.slow
def test_pipelines_that_were_run_are_compared_drawn_and_told_as_json(clip):
    clip.hugs("--pipeline", "tiny")
    clip.hugs("--pipeline", "quick")
    out, err = clip.hugs("--plot", command="costs")
    lines = [line.split() for line in out.splitlines()]
    assert lines[1][0] == "quick" and lines[2][:1] == ["tiny"] and lines[2][-3:] == ["40", "+", "80"]
    assert holds(out, "knee: tiny", "whole picture", "person", "0.1 dB")
    assert err.endswith("work/clip/costs.html\n")
    root = clip.work / "clip"
    assert ET.parse(root / "costs.svg").getroot().tag.endswith("svg")
    assert read_image(root / "costs.png").std() > 5
    assert "<pre>" in (root / "costs.html").read_text() and clip.hugs(command="gc")[0] == "0 B freed\n"
    result = json.loads(clip.hugs("--json", command="costs")[0])
    assert [row["pipeline"] for row in result["rows"]] == ["quick", "tiny"] and result["clip"] == "clip.mp4"
    assert [row["seconds"]["train"] for row in result["rows"]] == [10, 40], "what training says, if that is more"
    assert result["rows"][1]["db_per_minute"]["full"] == pytest.approx(8.0, rel=0.05), "4 dB in half a minute"
    file = clip.folder / "pipelines.yaml"
    file.write_text(f"{file.read_text()}z_again:\n  doc: The same.\n  extends: tiny\n")
    clip.hugs("--pipeline", "z_again")
    again = json.loads(clip.hugs("--json", command="costs")[0])
    assert [row["pipeline"] for row in again["rows"]] == ["quick", "tiny"], "one training is shown once"
    assert any_holds(again["notes"], "z_again", "tiny", "once")
    clip.hugs("train", "--pipeline", "quick", "--set", "train.steps=101")
    _, err = clip.hugs(command="costs", code=2)
    assert holds(err, "trained again", "quick")
