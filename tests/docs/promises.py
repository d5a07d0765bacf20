"""What the documents promise of each command that trains, or looks at trainings: in their order, with what is looked for."""

import csv
import json
import re
from pathlib import Path

import pytest

from stages.formats.body_model import read_body_model
from stages.formats.facts import Metrics, read_facts
from stages.formats.images import read_image, write_image
from stages.formats.poses import read_poses
from tests.docs.documents import documents
from tests.made.documented import Place, Said, Try
from tests.made.said import holds

LEARNED = ["cameras.npz", "effects.npz"]
"""Of `train`, if they were."""
PAGE = ("--set", "export.formats=[viewer]")
"""Of what is exported, where a command is about something else."""
ABLATED = "no_lbs", "no_densify", "no_human_loss", "no_triplane", "no_joint"
FEW = ("--seeds", "1")
"""Of three."""
STALE = ("--set", "evaluate.fit_steps=2")
"""What leaves a fleet something to do for a clip that is done."""


def whole_run(place: Place, said: Said) -> None:
    """The files of the table in docs/README.md are there, and the report is named first and last."""
    assert said[0] == "work/dance/default/report.html\n" == said[1].splitlines(True)[0].removeprefix("report: ")
    assert holds(said[1], "run takes about", "between")
    (text,) = (one.text for one in documents() if one.name == "docs/README.md")
    table = re.findall(r"^\| `(\w+)`.* \| (.*) \|$", text.partition("| stage | files |")[2], re.MULTILINE)
    assert len(table) > 5
    for stage, files in table:
        there = [path.name for path in place.at(f"default/{stage}").iterdir()] + LEARNED
        assert not [name for name in re.findall(r"`([\w.]+)`", files) if not any(one.endswith(name) for one in there)]


def planned(place: Place, said: Said) -> None:
    assert all(stage in said[0] for stage in ("frames", "train", "evaluate")) and "a run takes about" in said[0]


def in_time(place: Place, said: Said) -> None:
    """Steps and sizes are printed, with what they cost, and how long it took; at least 200 steps are taken."""
    assert holds(said[1], "200 steps", "ms", "Gaussians", "dB", "10,000 steps") and holds(
        said[1], "promised", "10.0 s", "took"
    )
    assert place.facts("default.10s/train/train.json")["steps"] >= 200


def kept_in_time(place: Place, said: Said) -> None:
    assert not re.search(r"train +done", said[1]) and holds(said[1], "promised", "10.0 s", "took")


def person_alone(place: Place, said: Said) -> None:
    assert not place.at("human_only/train/scene.npz").exists() and place.at("human_only/train/avatar.npz").exists()


def without_cameras(place: Place, said: Said) -> None:
    person_alone(place, said)
    assert place.facts("human_only/sfm/sfm.json")["verdict"] == "static camera"


def more_steps(place: Place, said: Said) -> None:
    assert place.facts("default/train/train.json")["steps"] == 12


def variant_steps(place: Place, said: Said) -> None:
    assert said[0] == "work/dance/default.steps_12/report.html\n"
    assert place.facts("default.steps_12/train/train.json")["steps"] == 12


def made_again(place: Place, said: Said) -> None:
    assert re.search(r"train +done .* forced", said[1])


def fresh(place: Place, said: Said) -> None:
    assert re.search(r"train +fresh", said[0])


def shadow(place: Place, said: Said) -> None:
    """It is modelled, and what it wins is measured."""
    assert place.facts("default/survey/survey.json")["decisions"]["shadow"]
    assert place.facts("default/train/train.json")["effects"]["shadow"].keys() >= {"psnr", "psnr_person", "seconds"}
    assert place.at("default/train/effects.npz").exists()
    page = place.at("default/report.html").read_text("utf-8")
    assert re.search(r"<tr><t[dh]>shadow", page)


def neither(place: Place, said: Said) -> None:
    assert place.facts("default/survey/stamp.json")["params"]["exposure"] == "never"
    assert place.facts("default/sfm/stamp.json")["params"]["undistort"] == "never"


def named(place: Place, said: Said) -> None:
    """The effect that has changed since."""
    place.hugs("hugs run dance.mp4 survey --set survey.exposure=always")
    still_named(place, place.hugs("hugs why dance.mp4 train"))


def still_named(place: Place, said: Said) -> None:
    assert holds(said[0], "survey", "changed since", "exposure")


def five_formats(place: Place, said: Said) -> None:
    names = {path.name for path in place.at("default/export").iterdir()}
    assert {"avatar.ply", "avatar.spz", "avatar.glb", "viewer.html", "avatar.usdc"} <= names


def all_given(place: Place, said: Said) -> None:
    """Each of the four files is taken."""
    assert place.facts("default/masks/masks.json")["source"] == "imported"
    assert read_body_model(place.at("default/smpl/body_model.npz")).name == "SMPL_NEUTRAL"
    assert place.facts("default/smpl/smpl.json")["source"] == "wham_output.pkl"
    assert metres(place) == pytest.approx(1, abs=0.05), "the cameras' unit"


def metres(place: Place) -> float:
    return read_poses(place.at("default/smpl/body.npz")).world_from_sfm


def tall(place: Place, said: Said) -> None:
    assert holds(said[1], "body 1.85 m tall")


def both_tall(place: Place, said: Said) -> None:
    assert holds(said[1], "heights", "1.85 m", "person 1", "1.70 m", "person 2")


def longer(place: Place, said: Said) -> None:
    place.hugs("hugs run dance.mp4 smpl")
    free = metres(place)
    place.hugs("hugs run dance.mp4 smpl --scale 2.31=2.00")
    assert metres(place) / free == pytest.approx(2.00 / 2.31)


def their_metres(place: Place, said: Said) -> None:
    assert metres(place) == pytest.approx(1.0)


def keypoints(place: Place, said: Said) -> None:
    assert place.facts("default/smpl/smpl.json")["landmarks"]["skeleton"] == "OpenPose BODY_25"


def scores(folder: Path) -> dict[str, float | None]:
    return read_facts(folder / "evaluate" / "metrics.json", Metrics).heldout["full"]


def each_part(place: Place, said: Said) -> None:
    """A row of each variant in each of three tables, and none of them is the full method."""
    names = [line.split()[0] for line in said[0].splitlines() if line.startswith("default")]
    assert names == 3 * ["default", *(f"default.{part}" for part in ABLATED)]
    assert all(word in said[0] for word in ("PSNR", "SSIM", "LPIPS", "whole picture", "person", "over white"))
    whole = scores(place.at("default"))
    assert [part for part in ABLATED if scores(place.at(f"default.{part}")) == whole] == [], "it measures nothing"


def one_part(place: Place, said: Said) -> None:
    rows = [line.split() for line in said[0].splitlines() if line.startswith("default")]
    assert [row[0] for row in rows] == 3 * ["default", "default.no_lbs"] and all(row[2][0] == "±" for row in rows)
    assert rows[1][3][0] in "+-", "the difference"
    assert place.at("default.no_lbs.seed1/train/avatar.npz").exists()


def eighteen(place: Place, said: Said) -> None:
    assert holds(said[0], "18 trainings") and all(f"default.{part}" in said[0] for part in ABLATED)


def all_costs(place: Place, said: Said) -> None:
    """Each pipeline that was run on the clip is compared; two of one training once."""
    assert all(f"{name} " in said[0] for name in ("default", "default.no_triplane", "default.steps_16"))
    assert holds(said[0], "note", "preview", "training", "default.no_lbs") and "knee" in said[0]
    assert all(place.at(f"costs.{kind}").stat().st_size > 1000 for kind in ("svg", "png", "html"))


def left_over(place: Place, said: Said) -> None:
    """How long it takes is printed, and what the budget leaves."""
    assert holds(said[1], "trainings", "about") and holds(said[0], "note", "left", "budget")


def two_axes(place: Place, said: Said) -> None:
    assert all(f"default.{level}" in said[0] for level in ("steps_16", "caps_5000_6000"))


def plotted(place: Place, said: Said) -> None:
    """Each level has a row, and is not the pipeline itself."""
    two_axes(place, said)
    assert all(place.at(f"sweep-default.{kind}").stat().st_size > 1000 for kind in ("svg", "png", "html"))
    assert scores(place.at("default")) not in [
        scores(place.at(f"default.{one}")) for one in ("steps_16", "caps_5000_6000")
    ]


def quick_look(place: Place, said: Said) -> None:
    """The report shows masks, cameras and body."""
    page = without_pictures(place.at("preview/report.html"))
    assert all(word in page for word in ("masks", "cameras", "body"))
    assert place.facts("preview/sfm/stamp.json")["params"]["features"] == 1024


def results_of(results: Path) -> tuple[dict, str]:
    """metrics.json and the report's text."""
    return json.loads((results / "evaluate/metrics.json").read_bytes()), without_pictures(results / "report.html")


def without_pictures(page: Path) -> str:
    return re.sub(r'"data:[^"]*"', "", page.read_text("utf-8"))


def of_smpl(place: Place, said: Said) -> None:
    assert read_body_model(place.folder / "work/bike/neuman/smpl/body_model.npz").name == "SMPL_NEUTRAL"


def of_neuman(place: Place, said: Said) -> None:
    """The free body stands in with a warning; the paper's numbers stand beside ours, measured as its code does."""
    assert re.search(r"warning: .*free body", said[1])
    metrics, page = results_of(place.folder / "work/bike/neuman")
    assert all(word in page for word in ("Beside the paper", "25.46", "lpips_legacy", "<h1>bike</h1>"))
    full = metrics["heldout"]["full"]
    assert full["psnr"] > 8 and 0 < full["lpips_legacy"] < full["lpips"] and "psnr_per_channel" in full
    assert [row["name"] for row in metrics["per_frame"]["heldout"]] == ["000002"] and "HUGS" in metrics["protocol"]
    assert "masked_full" not in metrics["heldout"] and metrics["gaussians"]["scene"] > 400


def of_zju(place: Place, said: Said) -> None:
    """The person alone is trained and measured; a folder of another data set is refused."""
    results = place.folder / "work/CoreView_377/zju"
    metrics, page = results_of(results)
    held = metrics["heldout"]
    assert metrics["gaussians"]["scene"] == 0 and held["full"]["psnr"] is None
    assert held["masked_full"]["psnr"] > held["masked_crop"]["psnr"] > 8, "the black around counts as right"
    assert all(word in page for word in ("Beside the paper", "30.80", "masked_full"))
    assert "HumanNeRF" in metrics["protocol"] and "masked_crop" in metrics["protocol"]
    assert read_body_model(results / "smpl/body_model.npz").name == "SMPL_NEUTRAL"
    refused = place.hugs("hugs run zju/CoreView_377 --pipeline neuman", code=1)[1]
    assert holds(refused, "NeuMan") and "hint: " in refused


def spread(place: Place, said: Said) -> None:
    """Three seeds, with mean and spread beside the paper's numbers; a picture that is changed makes all of it stale."""
    assert holds(said[0], "over 3 seeds") and "±" in said[0] and "HUGS, CVPR 2024" in said[0]
    path = place.folder / "neuman/bike/images/00004.png"
    write_image(path, 255 - read_image(path))
    first = json.loads(place.hugs("hugs run neuman/bike --pipeline neuman --dry-run --json")[0])[0]
    assert (first["stage"], first["state"], first["reasons"]) == ("frames", "stale", ["inputs.video changed"])


def rows(place: Place, name: str = "fleet") -> dict[str, dict[str, str]]:
    with (place.folder / "work" / f"{name}.csv").open(newline="") as file:
        return {row["clip"]: row for row in csv.DictReader(file)}


def one_page(place: Place, said: Said) -> None:
    assert said[0] == "work/fleet.html\n" and rows(place)["dance"]["state"] == "done"
    assert place.at("default/export/avatar.glb").exists()


def own_page(place: Place, said: Said) -> None:
    assert said[0] == "work/monday.html\n" and rows(place, "monday")["dance"]["state"] == "fresh"


def row_a_clip(place: Place, said: Said) -> None:
    """How many stages, and about how long."""
    assert holds(said[0], "work/dance", "fresh") and holds(said[0], "work/noise", "9 stages to do", "about")


def which_work(place: Place, said: Said) -> None:
    """A clip that fails stops no other, and the page shows why it failed and what helps."""
    found, page = rows(place), (place.folder / "work/fleet.html").read_text("utf-8")
    assert found["dance"]["state"] in ("done", "fresh") and found["noise"]["state"] == "failed"
    assert found["noise"]["problem"] in page and found["noise"]["hint"] in page


def only_kept(place: Place, said: Said) -> None:
    """Two jobs a clip; of the one that is done the results of other stages are gone, and how much that freed is printed."""
    which_work(place, said)
    assert [*(place.folder / "work/.fleet").rglob("dance*.train.log")]
    assert holds(said[1], "freed", "export, evaluate")
    assert place.at("default/export/avatar.glb").exists() and not place.at("default/train/avatar.npz").exists()
    assert scores(place.at("default"))


def only_failed(place: Place, said: Said) -> None:
    assert holds(said[1], "1 clip", "1 to do") and rows(place)["noise"]["state"] == "failed"


TRAINED = {
    "hugs run dance.mp4 --dry-run": Try(planned),
    "hugs ablate dance.mp4 --dry-run": Try(eighteen),
    "hugs run dance.mp4": Try(whole_run),
    "hugs run dance.mp4 --within 15m": Try(in_time, PAGE),
    "hugs run dance.mp4 --within 40m": Try(kept_in_time, PAGE),
    "hugs status dance.mp4 --pipeline default.15m": Try(fresh),
    "hugs run dance.mp4 --pipeline human_only": Try(person_alone, PAGE),
    "hugs run dance.mp4 --pipeline human_only --set sfm.camera=fixed": Try(without_cameras, ("train",)),
    "hugs run dance.mp4 train --set train.steps=8000": Try(more_steps),
    "hugs run dance.mp4 --pipeline default.steps_8000": Try(variant_steps, PAGE),
    "hugs run dance.mp4 --set survey.shadow=always": Try(shadow, ("train", "--set", "train.effect_gains=true")),
    "hugs run dance.mp4 --set survey.exposure=never --set sfm.undistort=never": Try(neither, ("survey",)),
    "hugs why dance.mp4 train": Try(named),
    "hugs why dance.mp4": Try(still_named),
    "hugs run dance.mp4 export --set 'export.formats=[ply, spz, glb, viewer, usd]'": Try(five_formats),
    "hugs run dance.mp4 --masks masks/ --smpl-fit wham_output.pkl --cameras sparse/0 --body-model SMPL_NEUTRAL.pkl": Try(
        all_given, ("smpl",)
    ),
    "hugs run dance.mp4 --height 1.85": Try(tall, ("smpl",)),
    "hugs run dance.mp4 --person all --height 1.85 --height 1.70": Try(both_tall, ("smpl", "--masks", "ids"), "pair"),
    "hugs run dance.mp4 --scale 2.31=2.00": Try(longer, ("smpl",)),
    "hugs run dance.mp4 --cameras sparse/0 --scale cameras": Try(their_metres, ("smpl",)),
    "hugs run dance.mp4 --landmarks keypoints/": Try(keypoints, ("smpl",)),
    "hugs run dance.mp4 train --force": Try(made_again),
    "hugs ablate dance.mp4": Try(each_part, FEW),
    "hugs ablate dance.mp4 --seeds 3": Try(each_part),
    "hugs ablate dance.mp4 --part no_lbs --seeds 2": Try(one_part),
    "hugs status dance.mp4 --pipeline default.no_lbs": Try(fresh),
    "hugs costs dance.mp4 --sweep --dry-run --axis steps --axis caps": Try(two_axes),
    "hugs costs dance.mp4 --sweep --axis steps --axis caps --budget 60 --plot": Try(plotted, FEW),
    "hugs costs dance.mp4 --sweep --budget 120": Try(left_over, FEW),
    "hugs run dance.mp4 --pipeline preview": Try(quick_look),
    "hugs costs dance.mp4 --plot": Try(all_costs),
    "hugs run neuman/bike --pipeline neuman --body-model SMPL_NEUTRAL.pkl": Try(of_smpl, ("smpl",)),
    "hugs run neuman/bike --pipeline neuman": Try(of_neuman, ("evaluate",)),
    "hugs ablate neuman/bike --pipeline neuman --part none": Try(spread),
    "hugs run zju/CoreView_377 --pipeline zju --body-model SMPL_NEUTRAL.pkl": Try(of_zju, ("evaluate",)),
    "hugs fleet clips.csv --jobs 2": Try(one_page),
    "hugs fleet clips.csv --name monday": Try(own_page),
    "hugs fleet 'clips/*.mp4' --dry-run": Try(row_a_clip),
    "hugs fleet 'clips/*.mp4' --pipeline preview": Try(which_work, code=1),
    "hugs fleet 'clips/*.mp4' --profile slurm --split train --keep export,evaluate": Try(only_kept, STALE, code=1),
    "hugs fleet 'clips/*.mp4' --profile slurm --split train --keep export,evaluate --only-failed": Try(
        only_failed, code=1
    ),
}
"""Runs of one clip, then what trains many times: ablations, sweeps, data sets, fleets."""
