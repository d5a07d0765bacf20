"""`hugs ablate` on a pipeline that trains nothing: what is run, what is shared, what is printed."""

from __future__ import annotations

import json

import pytest

from hugs_cli.studies import ablate
from hugs_cli.studies.comparison import cell
from hugs_cli.studies.variants import ABLATIONS
from stages.evaluate import published
from tests.made.flow import Flow
from tests.made.said import holds
from tests.made.studies import add_tiny

PARTS = ["", *(f".{part}" for part in ABLATIONS)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The flow after `hugs run` and after every part's ablation with two seeds, and what that said; to be copied."""
    flow = add_tiny(Flow(tmp_path_factory.mktemp("ablated")))
    flow.hugs("--pipeline", "tiny")
    return flow, ablate_(flow, "--seeds", "2")


@pytest.fixture
def ablated(finished, tmp_path):
    """A flow whose trainings of every part are there, with two seeds."""
    return finished[0].copied(tmp_path)


def ablate_(clip, *args: str, code: int = 0) -> tuple[str, str]:
    return clip.hugs("--pipeline", "tiny", *args, command="ablate", code=code)


def test_a_dry_run_lists_every_training_and_runs_none(clip):
    out, err = ablate_(clip, "--dry-run", "--seeds", "2")
    first, *rows = out.splitlines()
    assert holds(first, "12 trainings", "0 cached", "12 to do") and not err and not clip.work.exists()
    assert [row.split() for row in rows] == [["tiny" + p, "seed", s, "missing"] for s in "01" for p in PARTS]
    assert len(json.loads(ablate_(clip, "--dry-run", "--json")[0])) == 18


@pytest.mark.parametrize("how", ["pipeline", "module"])
def test_a_part_that_the_pipeline_does_not_have_is_left_out_and_named(clip, how):
    """Switched off in its pipeline or not known to its training: without it, it is itself."""
    file = clip.folder / "pipelines.yaml"
    if how == "pipeline":
        file.write_text(
            file.read_text().replace(
                "train: {needs: [one],", "train: {needs: [one], params: {triplane: false, joint: false},"
            )
        )
    else:
        clip.edit("train", "    triplane: bool = True\n    joint: bool = True\n", "")
    out, err = ablate_(clip, "--dry-run", "--seeds", "1")
    assert [row.split()[0] for row in out.splitlines()[1:]] == [
        "tiny",
        "tiny.no_lbs",
        "tiny.no_densify",
        "tiny.no_human_loss",
    ]
    assert [line.split()[0] for line in err.splitlines()] == ["no_triplane", "no_joint"] and "tiny does not have" in err
    out, err = ablate_(clip, "--dry-run", "--seeds", "1", "--part", "no_joint")
    assert [row.split()[0] for row in out.splitlines()[1:]] == ["tiny"]


@pytest.mark.slow
def test_parts_can_be_chosen_or_none_for_the_spread_of_seeds_alone(ablated):
    out, _ = ablate_(ablated, "--dry-run", "--seeds", "1", "--part", "no_lbs", "--part", "no_joint")
    assert [row.split()[0] for row in out.splitlines()[1:]] == ["tiny", "tiny.no_lbs", "tiny.no_joint"]
    lines = ablate_(ablated, "--part", "none")[0].splitlines()
    assert [line.split()[0] for line in lines if line.startswith("tiny")] == ["tiny"] * sum(
        "PSNR" in line for line in lines
    )
    assert all("±" in line for line in lines if line.startswith("tiny"))
    assert "no part 'no_lbz'" in ablate_(ablated, "--part", "no_lbz", code=2)[1]


@pytest.mark.slow
def test_all_share_what_lies_before_training_and_are_cached(finished, ablated):
    out, err = finished[1]
    assert holds(err, "12 trainings", "1 cached", "11 to do")
    counts = {name: len(list(ablated.store.glob(f"{name}-*"))) for name in ("one", "train", "evaluate")}
    assert counts == {"one": 1, "train": 12, "evaluate": 12}
    assert ablate_(ablated, "--seeds", "2")[0] == out
    assert holds(ablate_(ablated, "--dry-run", "--seeds", "2")[0], "12 trainings", "12 cached", "0 to do")
    assert holds(ablate_(ablated, "--dry-run")[0], "18 trainings", "12 cached", "6 to do")
    assert ablated.hugs(command="gc")[0] == "0 B freed\n"


@pytest.mark.slow
def test_seeds_of_a_sequence_of_the_paper_stand_beside_its_numbers(ablated):
    out, _ = ablate_(ablated, "--part", "none", "--seeds", "2")
    assert "paper" not in out, "not its clip"
    ablated.edit(
        "evaluate",
        "from stages.contract import Params as Base\n",
        "from stages.contract import Params as Base\nfrom stages.evaluate import published\n",
    )
    ablated.edit(
        "evaluate", '"lpips": 0.1}, dict', '"lpips": 0.1, "psnr_per_channel": psnr, "lpips_legacy": 0.2}, dict'
    )
    listing = ablated.work / "clip" / "tiny" / "frames" / "frames.json"
    listing.parent.mkdir()
    listing.write_text(json.dumps({"dataset": {"name": "neuman", "sequence": "bike"}}))
    assert "beside the paper" in ablate_(ablated, "--part", "none", "--seeds", "2")[0]
    numbers = {"psnr_per_channel": 25.0, "ssim": 0.9, "lpips_legacy": 0.1}
    found = {"": [{"full": numbers}, {"full": numbers | {"psnr_per_channel": 26.0}}]}
    table = ablate.compare_with_paper("tiny", found, published("neuman", "bike"))
    assert table["full"]["tiny"]["psnr_per_channel"]["mean"] == 25.5
    blank = {metric: {"mean": None, "spread": None} for metric in ("psnr", "ssim", "lpips")}
    heldout = {"tiny": dict.fromkeys(("full", "person_crop", "person_white"), blank)}
    lines = ablate.table({"pipeline": "tiny", "seeds": [0, 1], "heldout": heldout, "paper": table})
    block = lines[next(i for i, line in enumerate(lines) if holds(line, "paper")) :]
    assert block[2].split()[:2] == ["whole", "picture"] and "PSNR BY CHANNEL" in block[2]
    assert block[3].split() == ["tiny", "25.50", "±0.71", "0.9000", "±0.0000", "0.1000", "±0.0000"]
    assert block[4].split()[3:] == ["25.46", "0.8400", "0.1300"], "of HUGS"
    assert block[7].split() == ["tiny", "-", "-", "-"], "the person's box was not measured"


@pytest.mark.slow
def test_a_variant_is_the_pipeline_with_one_setting_and_has_a_status(ablated):
    for part, setting in ABLATIONS.items():
        assert json.loads(ablated.text("train", f"tiny.{part}")) == [0, [setting]]
        assert ablated.ran("--pipeline", "tiny", "--set", f"train.{setting}=false") == {}
    assert json.loads(ablated.text("train", "tiny.no_joint")) == [0, ["joint"]]
    states = json.loads(ablated.hugs("--pipeline", "tiny.no_joint", "--json", command="status")[0])
    assert [row["state"] for row in states] == ["fresh"] * 3


@pytest.mark.slow
def test_the_table_has_mean_spread_and_difference(clip):
    args = ("--seed", "4", "--seeds", "2", "--set", "one.word=b", "--part", "no_lbs", "--part", "no_joint")
    lines = [line.split() for line in ablate_(clip, *args)[0].splitlines()]
    assert lines[0][:4] == ["frames", "never", "trained", "on,"]
    assert lines[2] == ["whole", "picture", "PSNR", "SSIM", "LPIPS"] and lines[7][0] == "person"
    assert lines[12][:3] == ["person", "over", "white"] and len(lines) == 16
    assert lines[3] == ["tiny", "34.50", "±0.71", "0.9000", "±0.0000", "0.1000", "±0.0000"]
    assert lines[4][:4] == ["tiny.no_lbs", "29.50", "±0.71", "-5.00"]
    result = json.loads(ablate_(clip, *args, "--json")[0])
    assert (result["clip"], result["pipeline"], result["seeds"]) == ("clip.mp4", "tiny", [4, 5])
    got = result["heldout"]["tiny.no_joint"]["person_crop"]["psnr"]
    assert got == {"mean": 29.5, "spread": pytest.approx(0.5**0.5), "difference": -5.0, "values": [29.0, 30.0]}


@pytest.mark.slow
def test_without_a_scene_the_person_over_white_is_compared(ablated):
    out, err = ablate_(ablated, "--seeds", "1", "--set", "evaluate.scene=false")
    for part in ablate.NEEDS_SCENE:
        assert holds(err, f"tiny.{part}", "scene") and part not in out
    assert "person over white" in out and "whole picture" not in out and "tiny.no_triplane" in out


def test_one_seed_has_no_spread_and_what_was_not_measured_no_number():
    assert cell({"mean": 28.914, "spread": None, "difference": -0.3}, 2) == "28.91  -0.30"
    assert cell({"mean": None, "spread": None, "difference": None}, 2) == "-"


@pytest.mark.parametrize(
    ("pipeline", "problem", "hint"),
    [
        ("default", ("default", "stage", "train"), "one, two, three, four"),
        ("tiny.no_lbs", ("tiny.no_lbs", "variant"), "--pipeline tiny"),
        ("tiny.no_lsb", ("tiny", "variant", "no_lsb"), "no_lbs"),
    ],
)
def test_pipelines_that_cannot_be_compared_are_refused(clip, pipeline, problem, hint):
    _, err = clip.hugs("--pipeline", pipeline, command="ablate", code=2)
    assert holds(err, "error", *problem, "hint", hint)


@pytest.mark.slow
def test_trainings_of_every_seed_and_part_can_be_kept_when_only_code_changes(ablated):
    command = ("--seeds", "2", "--part", "no_lbs")
    out, _ = ablate_(ablated, *command)
    ablated.edit("train", "    told = params.model_dump()", "    more = 1\n    told = params.model_dump()")
    for name in ("tiny", "tiny.no_lbs", "tiny.seed1", "tiny.no_lbs.seed1"):
        said, _ = ablated.hugs("--pipeline", name, command="accept")
        assert "train accepted: " in said, name
    again, err = ablate_(ablated, *command)
    assert again == out and holds(err, "4 trainings", "4 cached", "0 to do")
