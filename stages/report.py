"""One page: the result in pictures and videos, its accuracy, its cost, and the warnings. Its words are in report.html."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages import contract
from stages.contract import Job, StageError, StageRecord
from stages.formats.facts import MASKED_REGIONS, REGIONS

if TYPE_CHECKING:
    from stages.formats.clip import Clip
    from stages.formats.facts import Dataset, Gain, Metrics, Sfm, Smpl, Survey
    from stages.formats.page import Figure
    from stages.records import Ground

LOADS = (*contract.TORCH, "matplotlib.figure")
OVERLAYS = 6
FILMS = {
    "heldout": "held-out frames: the clip on the left, ours on the right",
    "turntable": "the person from all sides",
    "motion": "a motion that is not in the clip",
    "scene": "the scene without the person",
}
COSTS = "../../costs"
"""Where `hugs costs --plot` draws, seen from the report. Pipelines that run later are no input of this stage, so the page
can only point at the plot; the browser shows it once it is there."""
VIEWER = "../export/viewer.html"
"""The page of the stage export, seen from the report."""
AGAIN = "train again: `hugs run VIDEO train --force`"
PROTOCOLS = {
    "heldout": "held out",
    "heldout_far": "held out, the poses farthest from training",
    "heldout_fitted": "held out, poses fitted",
}

Columns = tuple[list[list[str]], tuple[int, ...], list[float]]
"""Rows of cells, the columns that are numbers, and a share (0 to 1) for each row."""


class Params(contract.Params):
    pass


def run(
    job: Job,
    params: Params,
    *,
    frames: Path,
    sfm: Path,
    smpl: Path,
    survey: Path,
    train: Path,
    export: Path,
    render: Path,
    evaluate: Path,
) -> None:
    """Write report.html, one self-contained page. Of `export` it shows the cost, and points at its page."""
    from stages.formats import page
    from stages.formats.clip import load_people
    from stages.formats.datasets.published import COMPARED
    from stages.formats.facts import Listing, Metrics, Sfm, Smpl, Survey, Trained, read_facts
    from stages.formats.ground import read_ground
    from stages.formats.people import folder_of

    ground = read_ground(smpl / "ground.json")
    listing = read_facts(frames / "frames.json", Listing)
    metrics, found = read_facts(evaluate / "metrics.json", Metrics), read_facts(survey / "survey.json", Survey)
    trained, cameras = read_facts(train / "train.json", Trained), read_facts(sfm / "sfm.json", Sfm)
    people, dataset = load_people(sfm, smpl), listing.dataset
    clip, numbers = people[0], range(1, 1 + len(people))
    video = Path(listing.video.path).name
    text = page.fill(
        "report.html",
        title=f"{video}: hugs",
        video=video,
        size=(len(clip.names), clip.width, clip.height, metrics.gaussians.human, metrics.gaussians.scene),
        headline=_headline(metrics),
        warnings=[(stage, text) for stage, record in job.upstream.items() for text in record.warnings],
        films=_films(render, numbers),
        viewer=VIEWER if (export / "viewer.html").is_file() else None,
        comparisons=_comparisons(evaluate, numbers),
        accuracy=_accuracy(metrics),
        protocol=metrics.protocol,
        beside_paper=_beside_paper(dataset, metrics),
        compared=COMPARED.get(dataset.name) if dataset else None,
        curve=_curve(train),
        costs=COSTS,
        times=_stage_times(job.upstream),
        parts=_training_times(trained.seconds_by_part),
        overlays=[
            figure
            for one in people
            for figure in _overlays(
                one, ground, read_facts(folder_of(smpl, one.person) / "smpl.json", Smpl), _who(one.person, numbers)
            )
        ],
        effects=_effects(found, trained.effects),
        measures=_measures(found),
        scene=found.decisions.get("scene", True),
        rungs=_rungs(cameras),
        mapper=cameras.mapper or "none of them",
        notes=[(stage, note) for stage, record in job.upstream.items() for note in record.notes],
    )
    (job.out / "report.html").write_text(text, encoding="utf-8")
    job.note(f"report.html, {(job.out / 'report.html').stat().st_size / 2**20:.1f} MiB")


def _headline(metrics: Metrics) -> list[tuple[str, str]]:
    held = metrics.heldout
    of_first = ", person 1" if metrics.people else ""
    names = {region: name + of_first * (region != "full") for region, name in REGIONS.items()}
    values = [(f"PSNR, {name}", held[region]["psnr"]) for region, name in names.items()]
    known = [(name, f"{value:.1f} dB") for name, value in values if value is not None]
    seconds, memory = metrics.seconds.total, metrics.peak_memory_bytes / 2**30
    return [*known, ("from video to avatar", _duration(seconds)), ("peak memory", f"{memory:.1f} GiB")]


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 60 else f"{int(seconds // 60)} min {int(seconds % 60)} s"


def _films(render: Path, people: range) -> list[Figure]:
    from stages.formats import page
    from stages.formats.people import folder_of

    places = {_who(person, people): folder_of(render, person) for person in people}
    known = [(place / f"{name}.mp4", who + said) for name, said in FILMS.items() for who, place in places.items()]
    return [page.film(path, caption) for path, caption in known if path.exists()]


def _who(person: int, people: range) -> str:
    """How a caption begins where there are several people."""
    return f"person {person}: " if len(people) > 1 else ""


def _comparisons(evaluate: Path, people: range) -> list[Figure]:
    from stages.formats import page
    from stages.formats.images import read_image
    from stages.formats.people import folder_of

    places = {_who(person, people): folder_of(evaluate, person) / "heldout" for person in people}
    paths = [(who, path) for who, place in places.items() for path in sorted(place.glob("*.png"))]
    return [page.picture(read_image(path), f"{who}frame {path.stem}") for who, path in paths]


def _accuracy(metrics: Metrics) -> list[list[str]]:
    """Poses, region, PSNR, SSIM, LPIPS."""
    rows = []
    first = {protocol: getattr(metrics, protocol) for protocol in PROTOCOLS}
    for person, scores in {"1": first, **metrics.people}.items():
        who = f", person {person}" if metrics.people else ""
        for protocol, title in PROTOCOLS.items():
            for region, where in (REGIONS | MASKED_REGIONS).items():
                values = scores.get(protocol, {}).get(region, {})
                if values.get("psnr") is not None and (region != "full" or person == "1"):
                    numbers = ((values[name], digits) for name, digits in (("psnr", 2), ("ssim", 3), ("lpips", 3)))
                    row = ["too small" if n is None else f"{n:.{d}f}" for n, d in numbers]
                    rows.append([title, where + who * (region != "full"), *row])
    return rows


def _beside_paper(dataset: Dataset | None, metrics: Metrics) -> list[list[str]]:
    """Region, measure, our number and the HUGS paper's, for a sequence of the paper; else nothing."""
    from stages.formats.datasets.published import published

    rows = []
    for region, theirs in published(dataset.name, dataset.sequence).items() if dataset else ():
        ours = metrics.heldout.get(region, {})
        columns = zip(("PSNR dB", "SSIM", "LPIPS"), ("psnr_per_channel", "ssim", "lpips_legacy"), theirs, strict=True)
        for title, name, number in columns:
            if number is not None:
                value = "not measured" if ours.get(name) is None else f"{ours[name]:.{2 if title == 'PSNR dB' else 3}f}"
                rows.append([(REGIONS | MASKED_REGIONS)[region], title, value, f"{number:.2f}"])
    return rows


def _curve(train: Path) -> str:
    """A plot of curve.csv as SVG, '' where it has fewer than two points."""
    import csv
    import math

    from markupsafe import Markup

    from stages.formats import plot

    lines = []
    try:
        with (train / "curve.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        for column, name in (("psnr", "whole picture"), ("psnr_person", "box of the person")):
            dots = tuple(plot.Dot(float(r["seconds"]) / 60, float(r[column])) for r in rows if r[column])
            if not all(math.isfinite(dot.x) and math.isfinite(dot.y) for dot in dots):
                raise ValueError(f"{column} is not finite")
            lines += [plot.Line(name, dots)] if len(dots) > 1 else []
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise StageError(f"cannot read {train / 'curve.csv'}", AGAIN, [repr(error)]) from error
    return Markup(plot.svg(plot.plot([plot.Panel("minutes of training", "PSNR dB", tuple(lines))]))) if lines else ""


def _stage_times(records: Mapping[str, StageRecord]) -> Columns:
    longest = max((record.seconds for record in records.values()), default=1.0) or 1.0
    rows = [
        [name, _duration(record.seconds), f"{record.peak_memory_bytes / 2**20:.0f} MiB"]
        for name, record in records.items()
    ]
    return rows, (1, 2), [record.seconds / longest for record in records.values()]


def _training_times(spent: dict[str, float]) -> Columns:
    total = sum(spent.values()) or 1.0
    rows = [[name, _duration(seconds), f"{100 * seconds / total:.0f} %"] for name, seconds in spent.items()]
    return rows, (1, 2), [seconds / total for seconds in spent.values()]


def _overlays(clip: Clip, ground: Ground, fit: Smpl, who: str) -> list[Figure]:
    """Over evenly spread frames the posed body in blue and the edge of the mask in orange, and the body from the side.

    `who` begins each caption.
    """
    import cv2
    import numpy as np

    from stages.avatar.cameras.pinhole import camera_centers
    from stages.avatar.kernels.mesh import covered
    from stages.estimators.bodyfit.posed import posed_bodies
    from stages.estimators.bodyfit.side_view import side_view
    from stages.formats import page

    chosen = np.linspace(0, len(clip.names) - 1, min(OVERLAYS, len(clip.names))).round().astype(int)
    model, figures = clip.body_model, []
    for i, vertices in zip(chosen, posed_bodies(model, clip.body, chosen.tolist()), strict=True):
        image = clip.images(i).copy()
        inside = covered(vertices, model.faces, clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
        image[inside] = (0.6 * image[inside] + 0.4 * np.array([31, 111, 235])).astype(np.uint8)
        edges, _ = cv2.findContours((clip.own_mask(i) > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, edges, -1, (255, 140, 0), max(1, clip.height // 400))
        expected = fit.expected_error_mm.get(clip.names[i])
        off = None if expected is None else np.array(expected.along) / 1000
        eye = camera_centers(clip.viewmats[i : i + 1])[0]
        beside = side_view(vertices, model.faces, model.J_regressor @ vertices, off, eye, ground, clip.height)
        frame = f"{who}frame {clip.names[i]}"
        caption = f"{frame}: body blue, mask edge orange; beside it from the side, the camera far to the left"
        figures.append(page.picture(np.concatenate([image, beside], 1), caption))
    return figures


def _effects(found: Survey, gains: dict[str, Gain]) -> list[list[str]]:
    """A row for each effect of the survey, the modelled ones first, with its gain in training."""
    rows = []
    for name, effect in sorted(found.effects.items(), key=lambda item: not item[1].on):
        value = "" if effect.value is None else f"{effect.value:.3g} {effect.unit}"
        gain = gains.get(name)
        known = (gain.psnr, gain.psnr_person, gain.psnr_far) if gain else ()
        gained = " / ".join(f"{db:+.2f} dB" for db in known if db is not None)
        cost = (f"{round(gain.seconds)} s" if gain.seconds > 0 else "not measurable") if gain else ""
        rows.append([name.replace("_", " "), "on" if effect.on else "off", value, f"{effect.threshold:g}"]
                    + [effect.verdict, f"{effect.confidence:.0%}", gained, cost, ", ".join(effect.frames)])  # fmt: skip
    return rows


def _measures(found: Survey) -> list[list[str]]:
    return [[name.replace("_", " "), f"{_number(m.value)} {m.unit}", m.verdict] for name, m in found.measures.items()]


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _rungs(found: Sfm) -> list[str]:
    """A clause for each way in which sfm tried to map the cameras."""
    clauses = []
    for rung in found.rungs:
        best = max((model.registered for model in rung.models), default=0)
        clauses.append(f"{rung.how} {best} of {found.of} frames in the largest of {len(rung.models)} models")
    return clauses
