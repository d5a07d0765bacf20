"""The .json files that stages write for each other: one model a file, checked when it is read."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, ValidationError
from pydantic_core import PydanticCustomError

from stages.contract import StageError

MADE_BY = {"split": "sfm", "ground": "smpl", "metrics": "evaluate"}
"""The stage that writes a file, where the file is not named after it."""
WANTED = {
    "string_type": "a text",
    "int_type": "a whole number",
    "greater_than": "a whole number",
    "less_than": "a whole number",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "named values",
    "model_type": "named values",
    "too_short": "a list with something in it",
}
"""Pydantic's name of an error -> the kind of value that is wanted there."""


def is_file_name(text: str) -> bool:
    """True if the text names a file of the folder that it is put into, never one elsewhere."""
    return text not in ("", ".", "..") and not set(text) & set("/\\\0")


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise PydanticCustomError("wanted", "a number")
    return value  # a whole number stays one


def _file_name(text: str) -> str:
    if not is_file_name(text):
        raise PydanticCustomError("wanted", "a file name")
    return text


Number = Annotated[float, PlainValidator(_number)]
"""Finite."""
Whole = Annotated[int, Field(gt=-(1 << 63), lt=1 << 63)]
FileName = Annotated[str, AfterValidator(_file_name)]
Scores = dict[str, dict[str, Number | None]]
"""Region of the picture -> metric -> value, None where nothing was measured."""


class Facts(BaseModel):
    """The keys that are read; the file may hold others."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")


class Video(Facts):
    path: str
    frames: Whole
    """Of the whole video, not only those that were picked."""
    width: Whole = 0
    """Of its own pictures, in px; 0: as those of the frames."""
    height: Whole = 0


class Dataset(Facts):
    name: str
    sequence: str
    rule: str
    """How the pictures were split, in words."""


class Frame(Facts):
    name: FileName
    index: Whole
    """The frame's number in the video, from 0."""
    time_s: Number
    source: str = ""
    """The picture's own name without suffix, where a folder of pictures was given."""


class Told(Facts):
    """A focal length that the file tells, as a share of the picture's longer side, its spread (of the logarithm), and where."""

    share: Number
    spread: Number
    words: str


class Listing(Facts):
    """frames.json of the stages frames, neuman and zju."""

    width: Whole
    height: Whole
    video: Video
    frames: tuple[Frame, ...]
    dataset: Dataset | None = None
    focal: Told | None = None

    def of(self, names: Sequence[str]) -> Self:
        """The same with these frames alone; StageError for names that the clip does not have."""
        known = {frame.name: frame for frame in self.frames}
        if missing := [name for name in names if name not in known]:
            facts = [f"{len(missing)} frames, first {missing[0]}"]
            raise StageError(
                "there are poses of frames that are not of this clip", "hugs run VIDEO train --force", facts
            )
        return self.model_copy(update={"frames": tuple(known[name] for name in names)})

    def times(self, names: Sequence[str]) -> list[float]:
        """When frames were taken, s; StageError as `of`."""
        return [frame.time_s for frame in self.of(names).frames]


class DatasetFrame(Frame):
    split: str
    moment: Whole


class DatasetListing(Listing):
    """frames.json of a data set."""

    dataset: Dataset
    frames: tuple[DatasetFrame, ...]


class GivenSfm(Facts):
    """given/sfm.json: numbers about cameras that came with a data set."""

    reprojection_px: Number | None = None
    median_triangulation_deg: Number | None = None


class Distortion(Facts):
    max_shift_px: Number


class SparseModel(Facts):
    registered: Whole


class Rung(Facts):
    how: str
    models: tuple[SparseModel, ...]


class Sfm(GivenSfm):
    """sfm.json of the stages sfm and calibrated; `rungs`, `of` and `mapper` only where COLMAP mapped."""

    verdict: str
    distortion: Distortion
    of: Whole = 0
    rungs: tuple[Rung, ...] = ()
    mapper: str = ""


class Expected(Facts):
    along: tuple[Number, ...]
    across: tuple[Number, ...]


class Size(Facts):
    """Of people and world: `times_fit` as large as bodies alone made them, `how` a metre is known and to which share of itself."""

    times_fit: Number = 1.0
    how: str = ""
    error: Number | None = None


class Smpl(Facts):
    """smpl.json; how far each joint of a frame is probably off, where the stage estimated the poses, and doubtful frames."""

    expected_error_mm: dict[str, Expected] = {}
    doubtful: tuple[str, ...] = ()
    metre: Size = Size()


class SplitRow(Facts):
    split: str
    moment: Whole


class SplitFacts(Facts):
    """split.json."""

    rule: str
    frames: dict[str, SplitRow]


class Measure(Facts):
    value: Number | None
    unit: str
    verdict: str


class MeasuredEffect(Measure):
    threshold: Number
    confidence: Number
    frames: tuple[str, ...]
    on: bool


class Survey(Facts):
    """survey.json."""

    measures: dict[str, Measure]
    effects: dict[str, MeasuredEffect]
    decisions: dict[str, bool]
    starts: dict[str, list[Number]]


class Gain(Facts):
    psnr: Number | None
    psnr_person: Number | None
    psnr_far: Number | None = None
    seconds: Number


class Trained(Facts):
    """train.json."""

    seconds_by_part: dict[str, Number]
    effects: dict[str, Gain]
    exposure: dict[str, list[Number]]


class Sizes(Facts):
    human: Whole
    scene: Whole


class Seconds(Facts):
    total: Number


REGIONS = {"full": "whole picture", "person_crop": "box of the person", "person_white": "person over white"}
MASKED_REGIONS = {"masked_full": "person times mask, whole", "masked_crop": "person times mask, its box"}
"""The regions of metrics.json, in words."""


class Metrics(Facts):
    """metrics.json of the evaluate stage."""

    heldout: Scores
    heldout_fitted: Scores = {}
    heldout_far: Scores = {}
    people: dict[str, dict[str, Scores]] = {}
    """Of each further person, by number: protocol -> scores."""
    gaussians: Sizes
    protocol: str
    seconds: Seconds
    peak_memory_bytes: Whole


F = TypeVar("F", bound=Facts)


def write_facts(path: Path, facts: Mapping[str, Any]) -> None:
    """Write values as JSON."""
    path.write_text(json.dumps(facts, indent=1) + "\n")


def read_facts(path: Path, form: type[F], hint: str = "") -> F:
    """Read a .json file as `form`; StageError where it cannot be read, or with the place that does not fit.

    `hint` for a file of another program; without it a stage has written the file.
    """
    try:
        return parse(path.read_bytes(), form)
    except (OSError, NotJson) as error:
        raise StageError(f"cannot read {path}", hint or _again(path), [str(error)]) from error
    except ValueError as error:
        raise not_as_written(path, str(error), hint) from error


def not_as_written(path: Path, fact: str, hint: str = "") -> StageError:
    """The error for a file that is not as its stage or program writes it; `fact` names the place in it."""
    return StageError(f"{path} is not as its {'program' if hint else 'stage'} writes it", hint or _again(path), [fact])


def _again(path: Path) -> str:
    return f"run the stage again: `hugs run VIDEO {MADE_BY.get(path.stem, path.stem)} --force`"


class NotJson(ValueError):
    """A text is no JSON."""


def parse(text: str | bytes, form: type[F]) -> F:
    """The facts in a JSON text; NotJson, or ValueError with the first place that does not fit and its value."""
    try:
        return form.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    kind, place = first["type"], _place(first["loc"])
    if kind == "json_invalid":
        raise NotJson(first["msg"])
    if kind == "missing":
        raise ValueError(f"{_place(first['loc'][:-1]) or 'it'} has no {first['loc'][-1]}")
    raise ValueError(f"{place or 'it'} is {_short(first['input'])}, not {WANTED.get(kind, first['msg'])}")


def _place(keys: tuple[int | str, ...]) -> str:
    """Where a value stands: ("frames", 3, "name") -> frames[3].name."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".")


def _short(value: Any) -> str:
    """A value in a few letters."""
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
