"""One page to look at: what was learned, how good it is, what it cost, and what to know before trusting it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages import contract
from stages.contract import Job, StageError

if TYPE_CHECKING:
    import numpy as np

    from stages.formats.clip import Clip

OVERLAYS = 6
FILMS = {
    "heldout": "frames never trained on: the clip on the left, ours on the right",
    "turntable": "the person from all sides",
    "motion": "a motion that is not in the clip",
    "scene": "the scene without the person",
}
CURVE = (
    "The clock stands still while accuracy is measured. `hugs costs VIDEO --plot` sets all pipelines that were run on "
    "this clip beside each other, here, too."
)
COSTS = "../../costs"
"""Where `hugs costs --plot` draws, from the report; pipelines run later are none of this stage's inputs, so it is only shown."""
CALLED = (
    "Each effect was measured before training; it is modelled where the value is beyond the threshold, unless the settings "
    "say always or never. What could not be measured is off. Gained: what the held-out frames of the curve lose when what "
    "was trained is drawn without it; a training without it may lose less, since the rest would have made up for it "
    "(`--set survey.NAME=never` tells). Empty for passers-by, whom no held-out frame is to show, for a sky, which is part "
    "of the scene, and for a lens, which sfm takes out before training (`--set sfm.undistort=never` tells). Cost: of the "
    "time of training, by steps timed with and without at the end, to within some 5 % of it."
)
AGAIN = "train again: `hugs run VIDEO train --force`"
PROTOCOLS = {
    "heldout": "held out",
    "heldout_fitted": "held out, poses fitted",
}
REGIONS = {"full": "whole picture", "person_crop": "box of the person", "person_white": "person over white"}
MASKED = {"masked_full": "person times mask, whole", "masked_crop": "person times mask, its box"}

STAMP = {"seconds": float, "peak_memory_bytes": int, "notes": [str], "warnings": [str]}
SCORES = {str: {str: (float, None)}}
METRICS = {"heldout": SCORES, "heldout_fitted?": SCORES, "gaussians": {"human": int, "scene": int}, "protocol": str}
METRICS |= {"seconds": {"total": float}, "peak_memory_bytes": int}
MEASURE = {"value": (float, None), "unit": str, "verdict": str}
EFFECT = MEASURE | {"threshold": float, "confidence": float, "frames": [str], "on": bool}
SURVEY = {"measures": {str: MEASURE}, "effects": {str: EFFECT}, "decisions": {str: bool}}
WORTH = {"psnr": (float, None), "psnr_person": (float, None), "seconds": float}
TRAINED = {"seconds_by_part": {str: float}, "effects": {str: WORTH}}
RUNGS = {"of?": int, "rungs?": [{"how": str, "models": [{"registered": int}]}], "mapper?": str}
"""What is taken from stamp.json, metrics.json, survey.json, train.json, and sfm.json (rungs where cameras were mapped)."""


class Params(contract.Params):
    pass


def run(
    job: Job,
    params: Params,
    *,
    frames: Path,
    masks: Path,
    sfm: Path,
    smpl: Path,
    survey: Path,
    train: Path,
    export: Path,
    render: Path,
    evaluate: Path,
) -> None:
    """Write report.html, one self-contained page."""
    from stages.formats import page
    from stages.formats.clip import load_clip
    from stages.formats.facts import read_facts

    folders = (frames, masks, sfm, smpl, survey, train, export, render, evaluate)
    names = ("frames", "masks", "sfm", "smpl", "survey", "train", "export", "render", "evaluate")
    stamps = {name: read_facts(folder / "stamp.json", STAMP) for name, folder in zip(names, folders, strict=True)}
    listing = read_facts(frames / "frames.json", {"video": {"path": str}})
    metrics, found = read_facts(evaluate / "metrics.json", METRICS), read_facts(survey / "survey.json", SURVEY)
    trained = read_facts(train / "train.json", TRAINED)
    clip = load_clip(sfm, smpl)
    name = Path(listing["video"]["path"]).name
    sizes = metrics["gaussians"]
    parts = [
        f"<h1>{page.escape(name)}</h1>",
        f'<p class="soft">{len(clip.names)} frames of {clip.width}x{clip.height} px, '
        f"{sizes['human']:,} Gaussians in the person, {sizes['scene']:,} in the scene</p>",
        page.facts(_headline(metrics)),
        *(page.warning(f"{stage}: {text}") for stage, stamp in stamps.items() for text in stamp["warnings"]),
        page.section("What was learned", _films(render)),
        page.section(
            "Held-out frames",
            page.row([page.picture(*shot) for shot in _comparisons(evaluate)], 260),
            note="The clip on the left, ours in the middle, the person alone on the right. Nothing of these frames was "
            "trained on.",
        ),
        page.section("Accuracy on held-out frames", _accuracy(metrics), note=metrics["protocol"]),
        *_beside_the_paper(listing.get("dataset"), metrics),
        page.section("Accuracy over time", _curve(train), page.aside(f"{COSTS}.svg", f"{COSTS}.html"), note=CURVE),
        page.section(
            "Where the time went", _times(stamps), "<p>Training, step by step:</p>", _parts(trained["seconds_by_part"])
        ),
        page.section(
            "The body fit",
            page.row([page.picture(*shot) for shot in _overlays(clip)], 320),
            note="The fitted body over the frames. Where the outline leaves the person, the avatar suffers.",
        ),
        page.section(
            "What this clip called for",
            _effects(found, trained["effects"]),
            note=CALLED,
        ),
        page.section("What else was measured", _measures(found) + _rungs(read_facts(sfm / "sfm.json", RUNGS))),
        page.section("Notes", page.table(["stage", "note"], _notes(stamps))),
    ]
    (job.out / "report.html").write_text(page.page(f"{name}: hugs", parts), encoding="utf-8")
    job.note(f"report.html, {(job.out / 'report.html').stat().st_size / 2**20:.1f} MiB")


def _headline(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    held, seconds = metrics["heldout"], metrics["seconds"]["total"]
    numbers = [
        ("PSNR, whole picture", held["full"]["psnr"], "dB"),
        ("PSNR, box of the person", held["person_crop"]["psnr"], "dB"),
        ("PSNR, person over white", held["person_white"]["psnr"], "dB"),
    ]
    shown = [(name, f"{value:.1f} {unit}") for name, value, unit in numbers if value is not None]
    memory = metrics["peak_memory_bytes"] / 2**30
    return [*shown, ("from video to avatar", _duration(seconds)), ("peak memory", f"{memory:.1f} GiB")]


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 60 else f"{int(seconds // 60)} min {int(seconds % 60)} s"


def _films(render: Path) -> str:
    from stages.formats import page

    known = [(render / f"{name}.mp4", caption) for name, caption in FILMS.items()]
    return page.row([page.film(path, caption) for path, caption in known if path.exists()], 300)


def _comparisons(evaluate: Path) -> list[tuple[np.ndarray, str]]:
    from stages.formats.images import read_image

    return [(read_image(path), f"frame {path.stem}") for path in sorted((evaluate / "heldout").glob("*.png"))]


def _accuracy(metrics: dict[str, Any]) -> str:
    from stages.formats import page

    rows = []
    for protocol, title in PROTOCOLS.items():
        for region, where in (REGIONS | MASKED).items():
            values = metrics.get(protocol, {}).get(region, {})
            if values.get("psnr") is not None:
                numbers = ((values[name], digits) for name, digits in (("psnr", 2), ("ssim", 3), ("lpips", 3)))
                rows.append([title, where, *("too small" if n is None else f"{n:.{d}f}" for n, d in numbers)])
    if not rows:
        return "<p>No held-out frame could be compared.</p>"
    return page.table(["poses", "where", "PSNR dB", "SSIM", "LPIPS"], rows, numeric=(2, 3, 4))


def _beside_the_paper(dataset: dict[str, str] | None, metrics: dict[str, Any]) -> list[str]:
    """A section with the HUGS paper's numbers beside ours, for a sequence that it has."""
    from stages.formats import page
    from stages.formats.datasets.published import COMPARED, published

    if not dataset:
        return []
    rows = []
    for region, theirs in published(dataset["name"], dataset["sequence"]).items():
        ours = metrics["heldout"].get(region, {})
        columns = zip(("PSNR dB", "SSIM", "LPIPS"), ("psnr_per_channel", "ssim", "lpips_legacy"), theirs, strict=True)
        for title, name, number in columns:
            if number is not None:
                value = "not measured" if ours.get(name) is None else f"{ours[name]:.{2 if title == 'PSNR dB' else 3}f}"
                rows.append([(REGIONS | MASKED)[region], title, value, f"{number:.2f}"])
    if not rows:
        return []
    table = page.table(["where", "measure", "ours", "HUGS, CVPR 2024"], rows, numeric=(2, 3))
    return [page.section("Beside the paper", table, note=COMPARED[dataset["name"]])]


def _curve(train: Path) -> str:
    import csv
    import math

    from stages.formats import page

    lines = {}
    try:
        with (train / "curve.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        for column, name in (("psnr", "whole picture"), ("psnr_person", "box of the person")):
            known = [(float(r["seconds"]) / 60, float(r[column])) for r in rows if r[column]]
            if not all(math.isfinite(number) for point in known for number in point):
                raise ValueError(f"{column} is not finite")
            lines[name] = tuple(zip(*known, strict=True)) if known else ((), ())
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise StageError(f"cannot read {train / 'curve.csv'}", AGAIN, [repr(error)]) from error
    return page.chart(lines, "minutes of training", "PSNR dB") or "<p>Too few measurements for a curve.</p>"


def _times(stamps: dict[str, dict[str, Any]]) -> str:
    from stages.formats import page

    spent = {name: stamp["seconds"] for name, stamp in stamps.items()}
    longest = max(spent.values(), default=1.0) or 1.0
    rows = [
        [name, _duration(s), f"{stamps[name]['peak_memory_bytes'] / 2**20:.0f} MiB", page.bar(s / longest)]
        for name, s in spent.items()
    ]
    return page.table(["stage", "time", "peak memory", ""], rows, numeric=(1, 2))


def _parts(spent: dict[str, float]) -> str:
    """What the seconds of training went into; accuracy is measured with the clock stopped."""
    from stages.formats import page

    total = sum(spent.values()) or 1.0
    rows = [[name, _duration(s), f"{100 * s / total:.0f} %", page.bar(s / total)] for name, s in spent.items()]
    return page.table(["part", "time", "share", ""], rows, numeric=(1, 2))


def _overlays(clip: Clip) -> list[tuple[np.ndarray, str]]:
    """The posed body, shaded, over evenly spread frames, its outline against the mask's."""
    import cv2
    import numpy as np

    from stages.estimators.bodyfit.silhouette import posed_bodies, silhouette

    chosen = np.linspace(0, len(clip.names) - 1, min(OVERLAYS, len(clip.names))).round().astype(int)
    shots = []
    for i, points in zip(chosen, posed_bodies(clip.body_model, clip.body, chosen.tolist()), strict=True):
        image = clip.images(i).copy()
        size = image.shape[:2]
        inside = silhouette(points, clip.body_model.faces, clip.viewmats[i], clip.Ks[i], size, size)
        image[inside] = (0.6 * image[inside] + 0.4 * np.array([31, 111, 235])).astype(np.uint8)
        edges, _ = cv2.findContours((clip.mask(i) > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, edges, -1, (255, 140, 0), max(1, clip.height // 400))
        shots.append((image, f"frame {clip.names[i]}: body blue, mask edge orange"))
    return shots


def _effects(found: dict[str, Any], worth: dict[str, dict[str, float | None]]) -> str:
    """A row for each effect of survey.json, those that are modelled first; `worth` is what train.json says of them."""
    from stages.formats import page

    rows = []
    for name, effect in sorted(found["effects"].items(), key=lambda item: not item[1]["on"]):
        value = "" if effect["value"] is None else f"{effect['value']:.3g} {effect['unit']}"
        gains = [worth.get(name, {}).get(key) for key in ("psnr", "psnr_person")]
        gained = " / ".join(f"{gain:+.2f} dB" for gain in gains if gain is not None)
        seconds = worth.get(name, {}).get("seconds")
        cost = "" if seconds is None else f"{round(seconds)} s" if seconds > 0 else "not measurable"
        rows.append([name.replace("_", " "), "on" if effect["on"] else "off", value, f"{effect['threshold']:g}"]
                    + [effect["verdict"], f"{effect['confidence']:.0%}", gained, cost, ", ".join(effect["frames"])])  # fmt: skip
    head = ["effect", "", "measured", "threshold", "verdict", "confidence", "gained, whole / person", "cost"]
    return page.table([*head, "most in frames"], rows, numeric=(3, 5, 6, 7))


def _measures(found: dict[str, Any]) -> str:
    from stages.formats import page

    rows = [
        [name.replace("_", " "), f"{_number(m.get('value'))} {m.get('unit') or ''}", str(m.get("verdict", ""))]
        for name, m in found["measures"].items()
    ]
    scene = "modelled" if found["decisions"].get("scene", True) else "left out"
    return page.table(["measured", "value", "verdict"], rows) + f"<p>The scene is {scene}.</p>"


def _rungs(found: dict[str, Any]) -> str:
    """How the cameras were found, and what was tried before, if they were mapped; `found` is sfm.json."""
    from stages.formats import page

    said = []
    for rung in found.get("rungs", []):
        best = max((model["registered"] for model in rung["models"]), default=0)
        said.append(f"{rung['how']} {best} of {found['of']} frames in the largest of {len(rung['models'])} models")
    taken = f" Taken: {found.get('mapper', 'none of them')}." if len(said) > 1 else ""
    return f"<p>Cameras: {page.escape('; '.join(said))}.{page.escape(taken)}</p>" if said else ""


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _notes(stamps: dict[str, dict[str, Any]]) -> list[list[str]]:
    return [[stage, note] for stage, stamp in stamps.items() for note in stamp["notes"]]
