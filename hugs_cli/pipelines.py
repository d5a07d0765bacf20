"""pipelines.yaml -> a checked Pipeline: known keys, known settings, needs that match what each stage takes."""

from __future__ import annotations

import graphlib
import re
import reprlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from importlib.metadata import files
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from hugs_cli import plain_yaml
from hugs_cli.studies import variants
from hugs_cli.words import command
from stages.contract import DISTRIBUTION, Params, StageError, StageModule, load_stage, marked

FILE = Path(__file__).parents[1] / "pipelines.yaml"
if not FILE.exists():  # installed, not a checkout
    FILE = Path(next(file.locate() for file in files(DISTRIBUTION) or () if file.name == "pipelines.yaml")).resolve()
SOURCES = {
    "video": "VIDEO",
    "mask_files": "--masks",
    "cameras": "--cameras",
    "smpl_fit": "--smpl-fit",
    "landmarks": "--landmarks",
    "face": "--face",
    "body_model": "--body-model",
}
PIPELINE_KEYS = ("doc", "extends", "report", "stages")
STAGE_KEYS = ("needs", "module", "params")
NAME = re.compile(r"[a-z][a-z0-9_]*")
RESERVED = ("store",)  # a folder beside the pipelines' folders


class UsageError(StageError):
    """What was asked for cannot be understood or found: exit code 2."""


@dataclass(frozen=True)
class Stage:
    """One stage of one pipeline: its module, what it needs, and its checked settings."""

    name: str
    module: str
    needs: tuple[str, ...]
    params: Params
    resumes: bool
    loads: tuple[str, ...]
    doc: str

    def settings(self, speed_only: bool = False) -> dict[str, Any]:
        """The settings that make the result (or those that only change speed), as plain JSON values."""
        fields = type(self.params).model_fields
        chosen = {name for name, info in fields.items() if marked(info, "speed_only") == speed_only}
        return self.params.model_dump(mode="json", include=chosen)


@dataclass(frozen=True)
class Pipeline:
    """Stages by name, in an order that runs every stage after what it needs."""

    name: str
    doc: str
    stages: dict[str, Stage]
    report: str | None = None
    """The module that makes the page of its results; None: there is no page."""

    def upstream(self, wanted: Iterable[str]) -> list[str]:
        """The wanted stages and everything they need, in running order; UsageError for an unknown name."""
        found, open_ = set(), list(wanted)
        for name in open_:
            if name not in self.stages and not NAME.fullmatch(name):
                hint = "`hugs fleet` takes several clips; if these are pictures of one clip, give their folder"
                raise UsageError(f"{name} is no stage of pipeline {self.name}: one clip is taken at a time", hint)
            if name not in self.stages:
                raise unknown("stage", name, self.stages, f"pipeline {self.name}")
            if name not in found:
                found.add(name)
                open_ += [need for need in self.stages[name].needs if need in self.stages]
        return [name for name in self.stages if name in found]


Override = tuple[str, str, Any]  # stage, setting, value


def load(name: str, overrides: Iterable[str | Override] = (), file: Path = FILE) -> Pipeline:
    """Read one pipeline, apply overrides (`stage.param=value` as text), and check it all; UsageError says what is wrong.

    `NAME.VARIANT` is a variant of pipeline NAME, see variants.py.
    """
    name, _, changed = name.partition(".")
    entry = merged(name, read_yaml(file), file)
    stages = entry["stages"]
    for override in overrides:
        stage, param, value = parse_override(override) if isinstance(override, str) else override
        if stage not in stages:
            raise unknown("stage", stage, stages, f"--set {stage}.{param}")
        stages[stage]["params"][param] = value
    checked = {stage: check_stage(stage, stages[stage], stages, name) for stage in running_order(stages, name)}
    if entry["report"] is not None:
        module_of(str(entry["report"]), f"pipeline {name}, report")
    pipeline = Pipeline(name, entry["doc"], checked, entry["report"])
    return variant(pipeline, changed) if changed else pipeline


def variant(pipeline: Pipeline, name: str) -> Pipeline:
    """The pipeline with the settings of a variant, see variants.py; UsageError if there is none, or it does not fit."""
    where, known = f"pipeline {pipeline.name}", [*variants.ABLATIONS, *variants.AXES]
    stage, settings = variants.changes(name, lambda name: unknown("variant", name, known, where))
    pipeline.upstream([stage])  # refuses a pipeline without it
    old = pipeline.stages[stage]
    new = checked(type(old.params), old.params.model_dump() | settings, stage, pipeline.name)
    return replace(pipeline, name=f"{pipeline.name}.{name}", stages=pipeline.stages | {stage: replace(old, params=new)})


def names(file: Path = FILE) -> dict[str, str]:
    """Every pipeline of the file with its one-line description."""
    return {name: str(entry.get("doc", "")) for name, entry in read_yaml(file).items() if isinstance(entry, dict)}


def document(file: Path, hint: str, most: int = plain_yaml.MOST) -> Any:
    """What a YAML file of at most so many values holds; UsageError where it cannot be read."""
    return read_text(text_of(file, hint), f"{file} is not valid YAML", "correct what is named above", most)


def text_of(file: Path, hint: str) -> str:
    """The text of a file in UTF-8; UsageError if it cannot be read."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {file}", hint, [getattr(error, "strerror", None) or str(error)]) from error


def read_text(text: str, problem: str, hint: str, most: int = plain_yaml.MOST) -> Any:
    """The value of a YAML text; UsageError with that problem and hint where it has none."""
    try:
        return plain_yaml.read(text, most)
    except (yaml.YAMLError, ValueError) as error:
        raise UsageError(problem, hint, str(error).splitlines()) from error


def read_yaml(file: Path) -> dict[str, Any]:
    """The file as a mapping of pipelines; UsageError if it is missing or no such mapping."""
    content = document(file, "give the file with `--pipelines-file`")
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise UsageError(f"{file} holds no pipelines", "it maps a pipeline's name to doc, extends and stages")
    return content


def merged(name: str, content: dict[str, Any], file: Path, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """One pipeline with what it extends folded in: stage by stage, setting by setting; `stage: null` leaves one out."""
    if name not in content:
        raise unknown("pipeline", name, content, file.name)
    if name in seen:
        raise UsageError(f"pipeline {name} extends itself", f"look at {file.name}", [" -> ".join((*seen, name))])
    if not NAME.fullmatch(name) or name in RESERVED:
        raise UsageError(f"{name!r} cannot name a pipeline", "use small letters, digits and _; not `store`")
    entry = content[name]
    where = f"pipeline {name}"
    check_keys(entry, PIPELINE_KEYS, where)
    base = (
        merged(entry["extends"], content, file, (*seen, name)) if "extends" in entry else {"stages": {}, "report": None}
    )
    stages = dict(base["stages"])
    for stage, own in check_keys(entry.get("stages", {}), None, f"{where}, stages").items():
        if own is None:
            stages.pop(stage, None)
            continue
        if not (isinstance(stage, str) and NAME.fullmatch(stage)):
            raise UsageError(f"{where}: {stage!r} cannot name a stage", "use small letters, digits and _")
        check_keys(own, STAGE_KEYS, f"{where}, stage {stage}")
        old = stages.get(stage, {"needs": None, "module": f"stages.{stage}", "params": {}})
        params = {**old["params"], **check_keys(own.get("params", {}), None, f"{where}, stage {stage}, params")}
        stages[stage] = {**old, **own, "params": params}
    copied = {stage: {**value, "params": dict(value["params"])} for stage, value in stages.items()}
    return {"doc": str(entry.get("doc", "")), "report": entry.get("report", base["report"]), "stages": copied}


def check_keys(value: Any, allowed: tuple[str, ...] | None, where: str) -> dict[str, Any]:
    """The value if it is a mapping of allowed keys, else UsageError with the nearest allowed key."""
    if not isinstance(value, dict):
        raise UsageError(
            f"{where}: a mapping is needed, not {reprlib.repr(value)}", "see the other pipelines for the form"
        )
    for key in value:
        if allowed is not None and key not in allowed:
            raise unknown("key", str(key), allowed, where)
    return value


def running_order(stages: dict[str, Any], pipeline: str) -> list[str]:
    """Stages after what they need, otherwise in the order of the file; UsageError for unknown needs and cycles."""
    for stage, entry in stages.items():
        if not isinstance(entry["needs"], list):
            raise UsageError(f"pipeline {pipeline}, stage {stage}: needs is missing", "give it as `needs: [video]`")
        for need in entry["needs"]:
            if not isinstance(need, str) or need not in (*stages, *SOURCES):
                raise unknown("need", str(need), [*stages, *SOURCES], f"pipeline {pipeline}, stage {stage}")
    graph = graphlib.TopologicalSorter({s: [n for n in e["needs"] if n in stages] for s, e in stages.items()})
    try:
        graph.prepare()
    except graphlib.CycleError as error:
        circle = " -> ".join(error.args[1])
        raise UsageError(
            f"pipeline {pipeline}: stages need each other in a circle", "remove one of these", [circle]
        ) from error
    order: list[str] = []
    ready: list[str] = []
    position = {stage: i for i, stage in enumerate(stages)}
    while graph.is_active():
        ready = sorted([*ready, *graph.get_ready()], key=position.__getitem__)
        order.append(ready.pop(0))
        graph.done(order[-1])
    return order


def check_stage(name: str, entry: dict[str, Any], stages: dict[str, Any], pipeline: str) -> Stage:
    """Import a stage's (light) module, compare `needs` with the keywords of run(), and check the settings."""
    where = f"pipeline {pipeline}, stage {name}"
    module = module_of(str(entry["module"]), where)
    if set(module.inputs) != set(entry["needs"]):
        facts = [f"needs: {', '.join(entry['needs'])}", f"run() takes: {', '.join(module.inputs)}"]
        raise UsageError(f"{where}: needs and {entry['module']}.run() differ", "give both the same names", facts)
    params = checked(module.params, entry["params"], name, pipeline)
    return Stage(name, entry["module"], tuple(entry["needs"]), params, module.resumes, tuple(module.loads), module.doc)


def module_of(name: str, where: str) -> StageModule:
    """A stage's module, imported; UsageError where there is none."""
    try:
        return load_stage(name)
    except ModuleNotFoundError as error:
        if not error.name or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise UsageError(f"{where}: there is no module {name}", "write it, or correct the name") from error


def checked(kind: type[Params], values: dict[str, Any], stage: str, pipeline: str) -> Params:
    """The settings of a stage; UsageError for one that it does not have and for a value that is not valid."""
    where = f"pipeline {pipeline}, stage {stage}"
    for param in values:
        if param not in kind.model_fields:
            raise unknown("setting", str(param), kind.model_fields, where)
    try:
        return kind(**values)
    except ValidationError as error:
        facts = wrong_values(error, lambda keys: ".".join([stage, *map(str, keys)]))
        listing = command("stages", stage, pipeline=pipeline, work=Path("work"))
        raise UsageError(f"{where}: settings are not valid", f"`{listing}` lists them", facts) from error


def wrong_values(error: ValidationError, place: Callable[[tuple[int | str, ...]], str]) -> list[str]:
    """What is wrong with values, a line each; `place` names where a value stands."""
    return [
        f"{place(one['loc'])}: {one['msg'][0].lower()}{one['msg'][1:]}, got {reprlib.repr(one['input'])}"
        for one in error.errors(include_url=False)
    ]


def parse_override(text: str) -> Override:
    """`stage.param=value` -> its parts, the value read as YAML."""
    target, equals, value = text.partition("=")
    stage, dot, param = target.strip().partition(".")
    if not (equals and dot and stage and param):
        raise UsageError(f"--set {text} is not understood", "write `--set stage.param=value`")
    start = text if len(text) < 80 else f"{text[:80]}..."
    return stage, param, read_text(value, f"--set {start}: the value is not understood", "quote it for the shell")


def unknown(kind: str, name: str, allowed: Iterable[str], where: str) -> UsageError:
    """The error for a name that is not one of those allowed, with the nearest one as its hint."""
    from difflib import get_close_matches

    allowed = list(allowed)
    near = get_close_matches(name, allowed, n=1)
    hint = f"did you mean `{near[0]}`?" if near else f"one of: {', '.join(allowed)}" if allowed else "there are none"
    return UsageError(f"{where}: no {kind} {name!r}", hint)
