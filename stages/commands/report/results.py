"""What training and the stages after it leave: films, accuracy, times, effects, files."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.contract import StageError, StageRecord
from stages.formats.facts import MASKED_REGIONS, REGIONS

if TYPE_CHECKING:
    from stages.formats.facts import Dataset, Gain, Metrics, Survey
    from stages.formats.page import Figure

FILMS = {
    "heldout": "held-out frames: the clip on the left, ours on the right",
    "turntable": "the person from all sides",
    "motion": "a motion that is not in the clip",
    "scene": "the scene without the person",
}
VIEWER = "viewer.html"
"""The page of the stage export."""
AGAIN = "train again: `hugs run VIDEO train --force`"
PROTOCOLS = {
    "heldout": "held out",
    "heldout_far": "held out, the poses farthest from training",
    "heldout_fitted": "held out, poses fitted",
}

Columns = tuple[list[list[str]], tuple[int, ...], list[float]]
"""Rows of cells, the columns that are numbers, and a share (0 to 1) for each row."""


def measured(survey: Path) -> dict[str, Any]:
    """What `survey` found, and whether there is a scene."""
    from stages.formats.facts import Survey, read_facts

    found = read_facts(survey / "survey.json", Survey)
    return {"measures": _measures(found), "scene": found.decisions.get("scene", True), "effects": _effects(found, {})}


def so_far(train: Path, known: dict[tuple[str, str], Any]) -> dict[str, Any]:
    """A training under way: its last picture, and its curve; those of `known` where they are the same."""
    from stages.formats import page
    from stages.formats.images import read_image

    caption = "the clip, a held-out frame drawn now, the person alone"
    return {
        "live": _if_new(known, train / "live.png", lambda path: page.picture(read_image(path), caption)),
        "curve": _if_new(known, train / "curve.csv", lambda path: _curve(path.parent)),
    }


def _if_new(known: dict[tuple[str, str], Any], path: Path, make: Callable[[Path], Any]) -> Any:
    """What is made of a file, again where the file has changed; None without it."""
    if not path.is_file():
        return None
    key = path.name, str(path.stat().st_mtime_ns)
    if key not in known:
        for old in [one for one in known if one[0] == path.name]:
            del known[old]
        known[key] = make(path)
    return known[key]


def training(train: Path) -> dict[str, Any]:
    """A finished training: its curve, and where its time went."""
    from stages.formats.facts import Trained, read_facts

    trained = read_facts(train / "train.json", Trained)
    return {"curve": _curve(train), "parts": _training_times(trained.seconds_by_part)}


def effects(survey: Path, train: Path) -> dict[str, Any]:
    """What the clip called for, and what it was worth."""
    from stages.formats.facts import Survey, Trained, read_facts

    gains = read_facts(train / "train.json", Trained).effects
    return {"effects": _effects(read_facts(survey / "survey.json", Survey), gains)}


def files(export: Path) -> dict[str, Any]:
    """The exported files, as (path from the pipeline's folder, size), and the page among them."""
    named = sorted(path for path in export.iterdir() if path.suffix not in (".txt", ".json", ".html"))
    sizes = [(f"export/{path.name}", f"{path.stat().st_size / 2**20:.1f} MiB") for path in named]
    return {"files": sizes, "viewer": f"export/{VIEWER}" if (export / VIEWER).is_file() else None}


def films(sfm: Path, render: Path) -> dict[str, Any]:
    """The films, of each person."""
    from stages.formats import page
    from stages.formats.people import folder_of, people_of

    places = {who_of(person, people_of(sfm)): folder_of(render, person) for person in people_of(sfm)}
    known = [(place / f"{name}.mp4", who + said) for name, said in FILMS.items() for who, place in places.items()]
    return {"films": [page.film(path, caption) for path, caption in known if path.exists()]}


def accuracy(frames: Path, sfm: Path, evaluate: Path) -> dict[str, Any]:
    """What was measured on held-out frames, and pictures of these."""
    from stages.formats.datasets.published import COMPARED
    from stages.formats.facts import Listing, Metrics, read_facts
    from stages.formats.people import people_of

    metrics, dataset = (
        read_facts(evaluate / "metrics.json", Metrics),
        read_facts(frames / "frames.json", Listing).dataset,
    )
    return {
        "headline": _headline(metrics),
        "gaussians": (metrics.gaussians.human, metrics.gaussians.scene),
        "comparisons": _comparisons(evaluate, people_of(sfm)),
        "accuracy": _accuracy(metrics),
        "protocol": metrics.protocol,
        "beside_paper": _beside_paper(dataset, metrics),
        "compared": COMPARED.get(dataset.name) if dataset else None,
    }


def stage_times(records: Mapping[str, StageRecord]) -> Columns:
    """A row for each finished stage."""
    longest = max((record.seconds for record in records.values()), default=1.0) or 1.0
    rows = [
        [name, _duration(record.seconds), f"{record.peak_memory_bytes / 2**20:.0f} MiB"]
        for name, record in records.items()
    ]
    return rows, (1, 2), [record.seconds / longest for record in records.values()]


def who_of(person: int, people: Sequence[int]) -> str:
    """How a caption begins where there are several people."""
    return f"person {person}: " if len(people) > 1 else ""


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


def _comparisons(evaluate: Path, people: Sequence[int]) -> list[Figure]:
    from stages.formats import page
    from stages.formats.images import read_image
    from stages.formats.people import folder_of

    places = {who_of(person, people): folder_of(evaluate, person) / "heldout" for person in people}
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


def _training_times(spent: dict[str, float]) -> Columns:
    total = sum(spent.values()) or 1.0
    rows = [[name, _duration(seconds), f"{100 * seconds / total:.0f} %"] for name, seconds in spent.items()]
    return rows, (1, 2), [seconds / total for seconds in spent.values()]


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
