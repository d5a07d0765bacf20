"""The whole flow on the synthetic clip, once, through the command line; then every stage's result against the truth.

The bars hold for pipeline `ci`, the least the flow may reach with its few frames and steps. What `default` reaches
stands in the README.
"""

from __future__ import annotations

import json
import re
import resource
import time
from pathlib import Path

import pytest

from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.poses import read_poses
from tests.made.browser import probe
from tests.made.command import hugs
from tests.made.truth import align, camera_errors, joint_errors, mask_ious, novel_psnr, tell_novel_poses

pytestmark = pytest.mark.slow

PIPELINE = "ci"


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def flow(work) -> tuple[Path, Path]:
    """The folder of stage results and the folder of the truth, after `hugs demo --pipeline ci`."""
    began = time.monotonic()
    said = hugs("demo", "--pipeline", PIPELINE, "--work", work)
    print(f"the whole flow took {time.monotonic() - began:.0f} s\n{said.stderr}")
    return work / "clip" / PIPELINE, work / "clip" / "synthetic" / "truth"


@pytest.fixture(scope="module")
def cameras(flow):
    """Found and true cameras."""
    return read_cameras(flow[0] / "sfm" / "cameras.npz"), read_cameras(flow[1] / "cameras.npz")


def test_sfm_finds_the_cameras(flow, cameras):
    frames = len(json.loads((flow[0] / "frames" / "frames.json").read_bytes())["frames"])
    errors = camera_errors(*cameras, frames)
    print(errors)
    assert errors.registered >= 0.95
    assert errors.worst < 0.01 * errors.extent
    assert errors.turn_degrees < 0.1
    assert errors.focal < 0.02


def test_masks_cover_the_person(flow):
    ious = mask_ious(flow[0] / "masks" / "masks", flow[1] / "masks")
    print(f"IoU mean {ious.mean():.3f}, least {ious.min():.3f}")
    assert ious.mean() >= 0.9
    assert ious.min() >= 0.75


def test_the_body_is_where_the_person_is(flow, cameras):
    found, truth = read_poses(flow[0] / "smpl" / "body.npz"), read_poses(flow[1] / "body.npz")
    similarity = align(*cameras, found.world_from_sfm)
    model = read_body_model(flow[0] / "smpl" / "body_model.npz")
    world, about = joint_errors(found, truth, similarity, model, read_body_model())
    print(
        f"joints {100 * world:.1f} cm off in the world, {100 * about:.1f} cm about the pelvis; x{similarity.scale:.3f}"
    )
    assert about <= 0.06
    assert world <= 0.07
    assert 0.93 < similarity.scale < 1.07, "metres are metres, as far as one camera can know"


def test_unseen_frames_are_predicted(flow):
    metrics = json.loads((flow[0] / "evaluate" / "metrics.json").read_bytes())
    print(json.dumps(metrics["heldout"]))
    assert metrics["frames"] >= 3
    assert metrics["heldout"]["full"]["psnr"] >= 24
    assert metrics["heldout"]["person_crop"]["psnr"] >= 20


def test_a_pose_that_no_frame_shows_is_predicted(flow, work, tmp_path):
    """True novel poses and cameras, told in the clip's world, through `hugs render`."""
    results, truth = flow
    names = tell_novel_poses(results, truth, tmp_path)
    hugs("render", truth.parent / "clip.mp4", "--cameras", tmp_path / "cameras.npz", "--poses", tmp_path / "poses.npz",
         "--out", tmp_path / "out", "--pipeline", PIPELINE, "--work", work)  # fmt: skip
    full, crop = novel_psnr(tmp_path / "out", truth, names)
    print(f"novel pose: whole picture {full:.2f} dB, person crop {crop:.2f} dB")
    assert full >= 20
    assert crop >= 17.5


def test_the_report_is_there_and_nothing_needs_to_run_again(flow, work):
    assert (flow[0] / "report.html").stat().st_size > 10_000
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    again = hugs("run", flow[1].parent / "clip.mp4", "--pipeline", PIPELINE, "--work", work)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert spent < 5, f"a run with nothing to do loads nothing, but:\n{again.stderr}"  # 0.4 s measured
    assert again.stderr.count(" cached ") == 9


@pytest.mark.parametrize("width", [1280, 500])
def test_the_report_opens_in_a_browser(flow, tmp_path, width):
    report = flow[0] / "report.html"
    beside = re.findall(r'(?:src|href)="((?!data:|#)[^"]*)', report.read_text(encoding="utf-8"))
    assert "export/viewer.html" in beside and "export/avatar.glb" in beside
    assert [one for one in beside if not (report.parent / one).is_file()] == [], "nothing else is fetched"
    found, logged = probe(report, tmp_path, width)
    assert logged == []
    assert found["images"] >= 8 and found["bad"] == []
    assert found["films"] == 4 and found["still"] == []
    assert not found["wide"], f"the page is wider than {width} px"
