"""Finds the person in every frame: takes masks given by the user, or segments by itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import NAME, read_facts

PERSON_SHARE = 5e-4
"""Share of the picture below which a mask shows nobody."""
BORDER_SHARE = 0.01
"""Share of a picture's side that the person covers when it counts as cut off there."""
MANY = 0.2
"""Share of frames from which a finding is a warning."""
ASPECT = 0.01
"""Relative difference in width / height up to which a mask of another size is taken for the same picture."""

LISTING = {"width": int, "height": int, "video": {"frames": int}, "frames": [{"name": NAME, "index": int}]}
"""What is taken from frames.json."""


class Params(contract.Params):
    """How given masks are read."""

    invert: Literal["auto", "always", "never"] = "auto"
    """Swap person and background of given masks; auto does so if most of the picture and of its border is marked."""


def run(job: Job, params: Params, *, frames: Path, mask_files: Path | None = None) -> None:
    """Write masks/%06d.png (0..255, 255 = person) for every frame and masks.json.

    Masks that a data set brought along are taken like given ones, unless others are given.
    Raises StageError if given masks do not fit the frames, or if no frame shows a person.
    """
    from stages.formats.capture import given_by
    from stages.formats.images import write_mask

    facts = read_facts(frames / "frames.json", LISTING)
    names = [frame["name"] for frame in facts["frames"]]
    mask_files = mask_files or given_by(frames, "masks")
    if mask_files is not None:
        source, details, masks = imported(job, params, facts, Path(mask_files))
    else:
        source, details, masks = "blazepose", {}, segmented([frames / "images" / f"{name}.png" for name in names])
        job.note("outlines by BlazePose, a small network; `--masks DIR` takes better ones")
    (job.out / "masks").mkdir(exist_ok=True)
    found = {}
    for i, (name, mask) in enumerate(zip(names, masks, strict=True)):
        write_mask(job.out / "masks" / f"{name}.png", mask)
        found[name] = {"coverage": round(float((mask > 127).mean()), 5), "touches_border": touched(mask)}
        job.progress(i + 1, len(names))
    nobody = [name for name, frame in found.items() if frame["coverage"] < PERSON_SHARE]
    report(job, found, nobody)
    summary = {"source": source, **details, "no_person": nobody, "frames": found}
    (job.out / "masks.json").write_text(json.dumps(summary, indent=1) + "\n")


def segmented(paths: list[Path]):
    """Follow one person through the pictures by BlazePose and yield his outline in each, empty where he is not."""
    import numpy as np

    from stages.estimators.blazepose import BlazePose
    from stages.estimators.outline import outline
    from stages.formats.images import read_image

    network = BlazePose()
    pictures = Pictures(paths, read_image)
    for path, pose in zip(paths, network.track(pictures), strict=True):
        image = read_image(path)
        if pose is None:
            yield np.zeros(image.shape[:2], np.uint8)
        else:
            yield np.rint(outline(network, image, pose.next_roi) * 255).astype(np.uint8)


class Pictures:
    """Pictures on disk as a sequence, read when asked for."""

    def __init__(self, paths: list[Path], read):
        self.paths, self.read = paths, read

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, i: int):
        return self.read(self.paths[i])


def imported(job: Job, params: Params, facts: dict, folder: Path):
    """Join the user's masks to the frames: (source, what was decided, masks as uint8 [H,W] one by one)."""
    from stages.formats.masks import ForeignMasks, mask_files

    files = mask_files(folder)
    joined = join(job, facts, files)
    missing = [frame["name"] for frame in facts["frames"] if frame["name"] not in joined]
    if missing:
        raise StageError(
            f"masks are missing for {len(missing)} of {len(facts['frames'])} frames",
            "name each mask by its frame's number in the video (or its picture's name), or leave out --masks",
            [f"missing: {listed(missing)}", f"the folder has: {listed([file.name for file in files])}"],
        )
    given = ForeignMasks(list(joined.values()))
    areas, borders = [], []
    for path in joined.values():
        mask = given.read(path)
        areas.append(float((mask > 127).mean()))
        borders.append(border_share(mask))
    area, border = sum(areas) / len(areas), sum(borders) / len(borders)
    invert = params.invert == "always" or (params.invert == "auto" and area > 0.5 and border > 0.5)
    marked = f"marked: {area:.0%} of the picture, {border:.0%} of its border"
    job.note(f"given masks {'inverted' if invert else 'taken as they are, white = person'} ({marked})")
    if params.invert == "auto" and (area > 0.5) != (border > 0.5):
        job.warn(f"unsure whether the given masks mark the person ({marked}); see --set masks.invert=always|never")
    encodings = given.encodings()
    job.note("encoding of given masks: " + "; ".join(f"{words} ({count} files)" for words, count in encodings.items()))
    size = (facts["width"], facts["height"])
    paths = [joined[frame["name"]] for frame in facts["frames"]]
    masks = (fitted(given.read(path), size, path, invert) for path in paths)
    unused = len(set(files) - set(joined.values()))
    details = {"folder": folder.name, "inverted": invert, "encodings": encodings, "unused": unused}
    return "imported", details, masks


def join(job: Job, facts: dict, files: list[Path]) -> dict[str, Path]:
    """Frame name -> mask file: by the same stem, else by the frame's number in the video; never by order.

    Files numbered from 1 to the number of the video's frames, with no 0, are taken as counted from 1, and that is said.
    """
    from stages.formats.masks import number, stem

    by_stem = {stem(file): file for file in files}
    numbers = [number(stem(file)) for file in files]
    total = facts["video"]["frames"]
    named = any("source" in frame for frame in facts["frames"])
    first = 1 if not named and 0 not in numbers and total in numbers else 0
    unique = {n: file for n, file in zip(numbers, files, strict=True) if n is not None and numbers.count(n) == 1}
    if first:
        job.warn(f"given masks are numbered 1 to {total}: taken as counted from 1")
    joined = {}
    for frame in facts["frames"]:
        exact = by_stem.get(frame.get("source", frame["name"])) if not first else None
        file = exact or (None if "source" in frame else unique.get(frame["index"] + first))
        if file is not None:
            joined[frame["name"]] = file
    return joined


def fitted(mask, size: tuple[int, int], path: Path, invert: bool):
    """A given mask at the frames' size, person white; StageError if its shape is that of another picture."""
    import cv2

    height, width = mask.shape
    if abs(width * size[1] / (height * size[0]) - 1) > ASPECT:
        raise StageError(
            f"{path.name} is not a mask of these frames",
            "make masks from the same video, turned as it is shown",
            [f"mask {width}x{height}, frames {size[0]}x{size[1]}"],
        )
    if (width, height) != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
    return 255 - mask if invert else mask


def border_share(mask) -> float:
    """Share of the picture's outermost pixels that are marked."""
    import numpy as np

    return float((np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) > 127).mean())


def touched(mask) -> list[str]:
    """The sides of the picture at which the person is cut off."""
    sides = {"top": mask[0], "bottom": mask[-1], "left": mask[:, 0], "right": mask[:, -1]}
    return [side for side, line in sides.items() if (line > 127).mean() > BORDER_SHARE]


def report(job: Job, found: dict[str, dict], nobody: list[str]) -> None:
    """Say how much of the pictures the person covers, and where he is missing or cut off; StageError if nowhere."""
    count = len(found)
    if len(nobody) == count:
        raise StageError(
            f"no person found in any of {count} frames",
            "film one person, whole and upright; or give masks with `--masks DIR`",
            ["the built-in segmenter follows one person and needs some of the body in view"],
        )
    shares = sorted(frame["coverage"] for name, frame in found.items() if name not in nobody)
    job.note(f"person covers {shares[len(shares) // 2]:.1%} of the picture ({shares[0]:.1%} to {shares[-1]:.1%})")
    if nobody:
        say = job.warn if len(nobody) > MANY * count else job.note
        say(f"nobody in {len(nobody)} of {count} frames: {listed(nobody)}")
    for side in ("top", "bottom", "left", "right"):
        cut = [name for name, frame in found.items() if side in frame["touches_border"]]
        if cut:
            say = job.warn if len(cut) > MANY * count else job.note
            say(f"the person is cut off at the {side} in {len(cut)} of {count} frames: {listed(cut)}")


def listed(names: list[str], most: int = 8) -> str:
    """The first names of a list, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
