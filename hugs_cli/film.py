"""film.yaml -> the settings of stages/commands/compose.py: known keys, paths from the file's own folder, runs that are finished."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from hugs_cli import plain_yaml
from hugs_cli.cache.workspace import Stamp
from hugs_cli.pipelines import UsageError, document, unknown, wrong_values
from stages.contract import Params, listed, load_stage

MODULE = "stages.commands.compose"
STAGES = ("train", "smpl", "sfm", "frames")  # of a run that a person, or a scene with `survey`, is taken from
HINT = "`hugs compose --init RUN RUN` writes one to begin with"


def read_film(file: Path) -> Params:
    """The film of a file, with paths from its folder; UsageError where it is none."""
    return checked(document(file, HINT), file.name, file.parent)


def checked(content: Any, where: str, folder: Path = Path()) -> Params:
    """The film as settings, with paths from `folder`; UsageError for unknown keys and values that are not valid."""
    form = load_stage(MODULE).params
    if not isinstance(content, dict):
        raise UsageError(f"{where} holds no film", HINT, [f"it is {reprlib.repr(content)}"])
    strange: list[tuple[int | str, ...]] = [(key,) for key in content if key in {*form.model_fields} - {*listed(form)}]
    facts: list[str] = []
    try:
        film = form(**{str(key): value for key, value in content.items()})
    except ValidationError as error:
        strange += [e["loc"] for e in error.errors() if e["type"] == "extra_forbidden"]
        facts = wrong_values(error, place)
    for *inside, key in strange:
        raise unknown(
            "key", str(key), listed(form_at(form, inside)), ", ".join([where, place(inside)] if inside else [where])
        )
    if facts:
        raise UsageError(f"{where}: not a valid film", HINT, facts)
    return with_paths(film, folder)


def form_at(form: Any, keys: Sequence[int | str]) -> type[BaseModel]:
    """The form to which the keys lead from another one, through optional values and lists."""
    for key in keys:
        kinds = [form.model_fields[key].annotation] if isinstance(key, str) else []
        while kinds and not (isinstance(form := kinds.pop(), type) and issubclass(form, BaseModel)):
            kinds += getattr(form, "__args__", ())
    return form


def with_paths(value: Any, folder: Path, key: str = "") -> Any:
    """A film, or a value of a `key` in it, with every path taken from `folder`."""
    if isinstance(value, BaseModel):
        return value.model_copy(update={key: with_paths(one, folder, key) for key, one in value})
    if isinstance(value, list):
        return [with_paths(one, folder) for one in value]
    return type(value)(folder / value) if isinstance(value, Path) or is_path(key, value) else value


def quoted(path: str) -> str:
    """A path as YAML reads it back: in quotes where it would be something else, or be cut at a #."""
    try:
        same = plain_yaml.read(f"{{key: {path}}}") == {"key": path}
    except (yaml.YAMLError, ValueError):
        same = False
    return path if same else json.dumps(path, ensure_ascii=False)


def is_path(key: str, value: Any) -> bool:
    """Whether a motion or a camera, which may be words, names a file."""
    return key in ("motion", "camera") and bool(Path(value).suffix)


def place(keys: Sequence[int | str]) -> str:
    """Where a value stands: ("people", 0, "at", 1) -> people 1, at 2."""
    words = ""
    for key in keys:
        words += f" {key + 1}" if isinstance(key, int) else f", {key}"
    return words.removeprefix(", ")


def check_sources(film: Any) -> list[Path]:
    """The files and folders that a film reads; UsageError for one that is missing, or a run that is not finished."""
    people = film.people
    named = [("scene", film.scene)] + [(f"person {i + 1}", person.avatar) for i, person in enumerate(people)]
    read: list[Path] = []
    for who, path in named:
        if path is None:
            continue
        if not path.exists():
            raise UsageError(
                f"{who}: nothing at {path}", "give the folder of a run, such as work/dance/default, or a file"
            )
        if path.is_dir():
            stages = STAGES + (("survey",) if who == "scene" else ())
            missing = [stage for stage in stages if Stamp.read(path / stage) is None]
            if missing:
                facts = [f"no finished {', '.join(missing)} in it"]
                raise UsageError(f"{who}: {path} is not a finished run", "finish it with `hugs run VIDEO`", facts)
            check_together(who, path)
        read.append(path)
    files = [Path(person.motion) for person in people if is_path("motion", person.motion)]
    files += [person.face for person in people if person.face]
    files += [Path(film.camera)] if is_path("camera", film.camera) else []
    files += [film.gaussians] if film.gaussians else []
    for file in files:
        if not file.is_file():
            raise UsageError(f"no file at {file}", "check the path")
    return read + files


def check_together(who: str, run: Path) -> None:
    """UsageError where training used another body fit or other cameras than the run now has: they are in other worlds."""
    train = Stamp.read(run / "train")
    for stage in ("sfm", "smpl"):
        now = Stamp.read(run / stage)
        if train and now and train.inputs.get(stage, now.content) != now.content:
            facts = [f"{stage} was made again after train"]
            raise UsageError(f"{who}: parts of {run} were made again", "finish it with `hugs run VIDEO`", facts)


def outputs(film: Any) -> list[Path]:
    """All files that a film is written to, and the folder of its stills."""
    out = film.out
    paths = [getattr(out, name) for name in ("film", "alpha", "page", "splats", "glb", "usd")]
    return [path for path in paths if path is not None] + ([out.stills.folder] if out.stills else [])
