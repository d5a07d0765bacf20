"""film.yaml -> the settings of stages/compose.py: known keys, paths from the file's own folder, runs that are finished."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from hugs_cli import plain_yaml
from hugs_cli.cache.workspace import Stamp
from hugs_cli.pipelines import UsageError, unknown
from stages.contract import Params, load_stage

MODULE = "stages.compose"
STAGES = ("train", "smpl", "sfm", "frames")  # of a run that a person, or a scene with `survey`, is taken from
HINT = "`hugs compose --init RUN RUN` writes one to begin with"
INTERNAL = ("keep", "code")


def read_film(file: Path) -> dict[str, Any]:
    """What the file says, with paths from its folder; UsageError where it is no film."""
    try:
        content = plain_yaml.read(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {file}", HINT, [str(error.strerror)]) from error
    except (yaml.YAMLError, ValueError) as error:
        raise UsageError(f"{file} is not valid YAML", "mend what is named above", str(error).splitlines()) from error
    if not isinstance(content, dict):
        raise UsageError(f"{file} holds no film", HINT, [f"it is {reprlib.repr(content)}"])
    check_keys(content, load_stage(MODULE).params, file.name)
    return with_paths(content, file.parent)


def check_keys(value: Any, form: type[BaseModel], where: str) -> None:
    """UsageError for a key that is not one of the form's, or of the forms inside it, with the nearest that is."""
    if not isinstance(value, dict):
        return
    for key, inner in value.items():
        fields = {name: info for name, info in form.model_fields.items() if name not in INTERNAL}
        if key not in fields:
            raise unknown("key", str(key), fields, where)
        for own in forms(fields[key].annotation):
            for i, one in enumerate(inner if isinstance(inner, list) else [inner]):
                place = f"{where}, {key}" + (f" {i + 1}" if isinstance(inner, list) else "")
                check_keys(one, own, place)


def forms(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models in a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from forms(part)


def with_paths(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The film with every path that it names taken from `folder`."""

    def at(path: Any) -> Any:
        return str(folder / path) if isinstance(path, str) else path

    film = dict(content)
    film |= {key: at(film[key]) for key in ("scene", "gaussians", "camera") if key in film and is_path(key, film[key])}
    if isinstance(film.get("people"), list):
        film["people"] = [
            {key: at(value) if is_path(key, value) else value for key, value in one.items()}
            if isinstance(one, dict)
            else one
            for one in film["people"]
        ]
    if isinstance(film.get("out"), dict):
        film["out"] = {
            key: {**value, "folder": at(value["folder"])}
            if key == "stills" and isinstance(value, dict) and "folder" in value
            else at(value)
            for key, value in film["out"].items()
        }
    return film


def quoted(path: str) -> str:
    """A path as YAML reads it back: in quotes where it would be something else, or be cut at a #."""
    try:
        same = plain_yaml.read(f"{{key: {path}}}") == {"key": path}
    except (yaml.YAMLError, ValueError):
        same = False
    return path if same else json.dumps(path, ensure_ascii=False)


def is_path(key: str, value: Any) -> bool:
    """Whether a value names a file or a folder: motions and cameras may be words, too."""
    if key in ("motion", "camera"):
        return isinstance(value, str) and bool(Path(value).suffix)
    return key in ("avatar", "scene", "gaussians")


def checked(film: Mapping[str, Any], where: str) -> Params:
    """The film as settings; UsageError with all values that are not valid."""
    try:
        return load_stage(MODULE).params(**film)
    except ValidationError as error:
        facts = [
            f"{place(e['loc'])}: {e['msg'][0].lower()}{e['msg'][1:]}, got {reprlib.repr(e['input'])}"
            for e in error.errors(include_url=False)
        ]
        raise UsageError(f"{where}: not a film that can be made", HINT, facts) from error


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
                raise UsageError(f"{who}: {path} is no finished run", "finish it with `hugs run VIDEO`", facts)
            check_together(who, path)
        read.append(path)
    files = [Path(person.motion) for person in people if is_path("motion", person.motion)]
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
            raise UsageError(f"{who}: {run} is half made again", "finish it with `hugs run VIDEO`", facts)


def outputs(film: Any) -> list[Path]:
    """All files that a film is written to, and the folder of its stills."""
    out = film.out
    paths = [getattr(out, name) for name in ("film", "alpha", "page", "splats", "glb", "usd")]
    return [path for path in paths if path is not None] + ([out.stills.folder] if out.stills else [])
