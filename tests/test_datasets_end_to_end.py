"""Pipelines neuman and zju through the command line, on small folders in the data sets' layouts, with few steps."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest

from stages.formats.images import read_image, write_image
from tests.made import datasets
from tests.made.command import hugs

pytestmark = pytest.mark.slow

QUICK = ["train.steps=8", "train.human_points=7000", "train.resolution=32", "train.scene_fill=500", "train.curve_points=1",
         "evaluate.fit_steps=1"]  # fmt: skip


def run(folder: Path, pipeline: str, work: Path, *more: str) -> dict[str, str]:
    """Run what `evaluate` needs; stage -> cached or done."""
    settings = [word for text in (*QUICK, *more) for word in ("--set", text)]
    said = hugs("run", folder, "evaluate", "--pipeline", pipeline, "--work", work, "--json", *settings)
    print(said.stderr)
    return {row["stage"]: row["state"] for row in json.loads(said.stdout)["stages"]}


def results(folder: Path, pipeline: str, work: Path) -> tuple[dict, str]:
    """metrics.json and the report's text without its pictures."""
    made = work / folder.name / pipeline
    page = (made / "report.html").read_text(encoding="utf-8")
    return json.loads((made / "evaluate" / "metrics.json").read_text()), re.sub(r'"data:[^"]*"', "", page)


def test_a_neuman_sequence_becomes_a_report(tmp_path):
    made, began = datasets.neuman(tmp_path, frames=15), time.monotonic()
    states = run(made.folder, "neuman", tmp_path / "work")
    print(f"neuman took {time.monotonic() - began:.0f} s")
    assert set(states.values()) == {"done"} and next(iter(states)) == "frames"
    metrics, page = results(made.folder, "neuman", tmp_path / "work")
    assert [row["name"] for row in metrics["per_frame"]["heldout"]] == ["000002"]
    full = metrics["heldout"]["full"]
    assert full["psnr"] > 8 and 0 < full["lpips_legacy"] < full["lpips"] and "HUGS" in metrics["protocol"]
    assert "masked_full" not in metrics["heldout"] and metrics["gaussians"]["scene"] > 400
    assert "Beside the paper" in page and "25.46" in page and "lpips_legacy" in page and "<h1>bike</h1>" in page

    path = made.folder / "images" / "00004.png"
    write_image(path, 255 - read_image(path))
    said = hugs("run", made.folder, "--pipeline", "neuman", "--work", tmp_path / "work", "--dry-run", "--json")
    first = json.loads(said.stdout)[0]
    assert (first["stage"], first["state"], first["reasons"]) == ("frames", "stale", ["inputs.video changed"])


def test_a_zju_sequence_becomes_a_report_of_the_person_alone(tmp_path):
    made, began = datasets.zju(tmp_path), time.monotonic()
    run(made.folder, "zju", tmp_path / "work", "frames.test_every=3")
    print(f"zju took {time.monotonic() - began:.0f} s")
    metrics, page = results(made.folder, "zju", tmp_path / "work")
    held = metrics["heldout"]
    assert metrics["frames"] == 4 and metrics["gaussians"]["scene"] == 0 and held["full"]["psnr"] is None
    assert held["masked_full"]["psnr"] > held["masked_crop"]["psnr"] > 8, "the black around counts as right"
    assert "Beside the paper" in page and "30.80" in page and "masked_full" in page
    assert "HumanNeRF" in metrics["protocol"] and "masked_crop" in metrics["protocol"]


def test_the_wrong_pipeline_is_told_apart(tmp_path):
    made = datasets.zju(tmp_path, side=32, moments=4)
    with pytest.raises(AssertionError, match=r"error: .* is not a NeuMan sequence\n(.*\n)+.*hint: "):
        hugs("run", made.folder, "--pipeline", "neuman", "--work", tmp_path / "work")
