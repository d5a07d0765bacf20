"""What a stage is: its settings, its job, its errors, and the one way to load one by name."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

DISTRIBUTION = "hugs-avatar"
"""The name of the package."""


class Params(BaseModel):
    """Settings of one stage: frozen, finite, unknown keys refused, docstrings under the fields shown by `hugs stages`."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def internal(default: Any, **limits: Any) -> Any:
    """A setting that commands give and no user: it is not listed."""
    return Field(default, json_schema_extra={"internal": True}, **limits)


def listed(form: type[BaseModel]) -> dict[str, FieldInfo]:
    """The settings of a form that users give, by name."""
    return {name: info for name, info in form.model_fields.items() if not marked(info, "internal")}


def speed_only(default: Any, **limits: Any) -> Any:
    """A setting that changes the speed and never the result. It stays out of the stage's key."""
    return Field(default, json_schema_extra={"speed_only": True}, **limits)


def marked(setting: FieldInfo, mark: str) -> bool:
    """Whether a setting was declared with `internal`, or with `speed_only`."""
    return isinstance(setting.json_schema_extra, dict) and bool(setting.json_schema_extra.get(mark))


LONGEST = 2000


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}... ({len(text):,} letters)"


class StageError(Exception):
    """A stage cannot do its work.

    `problem` is one line: what is wrong, lower case, no full stop. `facts` are lines with numbers and names.
    `hint` names the command or the change that helps. Texts are cut at LONGEST letters: names in files may be of any length.

        try:
            avatar = hugs.load("work/dance/default")
        except hugs.StageError as error:
            print(error.hint)
    """

    def __init__(self, problem: str, hint: str = "", facts: Sequence[str] = ()):
        self.problem = _short(problem)
        super().__init__(self.problem)
        self.facts = tuple(map(_short, facts))
        self.hint = hint

    def __str__(self) -> str:
        """Problem, facts and hint, a line each."""
        return "\n".join(
            [self.problem, *(f"  {fact}" for fact in self.facts), *([f"hint: {self.hint}"] if self.hint else [])]
        )


@contextmanager
def whole(
    out: Path, noted: Callable[[Path], None] = lambda part: None, flush: bool = False, ending: str | None = None
) -> Iterator[Path]:
    """The one writer of files that others read: a path beside `out`, of its ending or another, whose file takes the place of
    `out`, or of the link there, in one step when the block has ended well.

    `noted` hears of it just before; `flush`: the disk has it by then. Else `out` stays as it was, and nothing else is left.
    """
    part = out.with_name(f".hugs-{os.urandom(6).hex()}{out.suffix[-16:] if ending is None else ending}")
    try:
        yield part
        if flush:
            with open(part, "rb") as file:
                os.fsync(file.fileno())
        noted(part)
        os.replace(part, out)
    finally:
        with suppress(OSError):  # it is there only where something failed
            part.unlink()


@dataclass(frozen=True)
class StageRecord:
    """What a finished stage cost and said. Evaluate and report write it down."""

    seconds: float
    peak_memory_bytes: int
    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()


@dataclass
class Job:
    """One run of one stage: where to write, what to run on, and how to talk to the person watching.

    `out` is an empty folder, or, when the stage module says `RESUMES = True`, what a killed run of the same key left.
    """

    out: Path
    device: str = "cpu"
    seed: int = 0
    emit: Callable[[dict[str, Any]], None] = lambda event: None
    upstream: Mapping[str, StageRecord] = field(default_factory=dict)
    """Every stage before this one, direct input or not, by name in running order; filled by the engine."""
    _stop: bool = field(default=False, repr=False)

    def progress(self, done: int, total: int, left: float | None = None, **numbers: Any) -> None:
        """Report that `done` of `total` steps are finished, with named numbers worth seeing.

        `left` seconds to go, from a stage that knows better than by its speed so far.
        """
        known = {} if left is None else {"left": left}
        self.emit({"event": "progress", "done": done, "total": total, "numbers": numbers} | known)

    def note(self, text: str, at_once: bool = False) -> None:
        """Say one fact about the result; it is shown beside the stage when it ends, or at once, and kept in its stamp."""
        self.emit({"event": "note", "text": text} | ({"at_once": True} if at_once else {}))

    def warn(self, text: str) -> None:
        """Say what a user should know before trusting the result; shown, kept in the stamp and put in the report."""
        self.emit({"event": "warning", "text": text})

    @contextmanager
    def writes(self, out: Path) -> Iterator[Path]:
        """`whole` for what a command is asked for; whoever listens may note what is about to appear at `out`."""
        with whole(out, lambda part: self.emit({"event": "writes", "out": out, "part": part})) as part:
            yield part

    @property
    def stop_asked(self) -> bool:
        """True after Ctrl-C or SIGTERM: write a checkpoint and raise `Stopped`."""
        return self._stop

    def listen_for_stop(self) -> None:
        """Turn SIGINT and SIGTERM into `stop_asked` for stages that can checkpoint."""

        def ask(signum: int, frame: Any) -> None:
            self._stop = True

        signal.signal(signal.SIGINT, ask)
        signal.signal(signal.SIGTERM, ask)


class Stopped(Exception):
    """A stage was asked to stop and left what it needs to go on from in `job.out`."""


Cost = Callable[[Any, Mapping[str, Path]], float]
Published = Callable[[str, str], Mapping[str, Sequence[float | None]]]


TORCH = ("torch", "scipy.spatial", "numba")
"""For LOADS: what stages need that compute with torch or draw."""
ADAM = (*TORCH, "torch._dynamo")
"""Also what torch's optimisers load."""


@dataclass(frozen=True)
class StageModule:
    """All that the command line knows of a stage. A module must have `Params` and `run`; the rest it may have."""

    params: type[Params]
    run: Callable[..., None]
    """Takes a Job, its Params, and its inputs by name; the first line of its docstring describes the stage."""
    resumes: bool = False
    """RESUMES: a run that was cut short goes on in its folder."""
    loads: Sequence[str] = ()
    """LOADS: libraries that take long to load; its process does so while the stage before it runs."""
    cost: Cost | None = None
    """cost(params, folders): time of the stage after the last step of training, in training steps.
    `folders` are the finished stages before training, by name."""
    shorter: Mapping[str, float] = field(default_factory=dict)
    """SHORTER: the most that settings may be when time is short (`--within`)."""
    check: Callable[..., None] | None = None
    """check(params, **sources): StageError where `run` would refuse its settings, or files that the user gave, for what they
    are. It is quick, needs no other stage, and refuses nothing that `run` takes. Its keyword-only parameters name sources,
    which are None where they are not given."""
    compiled: Callable[[], bool] | None = None
    """compiled(): whether the kernels that it runs on a CPU are there, and need not be compiled first."""
    sizes: Callable[[Any, Path], tuple[float, float]] | None = None
    """sizes(params, video): how many frames, of how many pixels each, it will probably pick."""
    moves: Callable[[Path], bool] | None = None
    """moves(video): whether the camera seems to move, at a glance."""
    published: Published | None = None
    """published(dataset, sequence): the paper's PSNR, SSIM and LPIPS by region, empty if it has none."""

    @property
    def inputs(self) -> list[str]:
        """The keyword-only parameters of `run`."""
        return keywords(self.run)

    @property
    def doc(self) -> str:
        """One line: what the stage does."""
        return (inspect.getdoc(self.run) or "").partition("\n")[0]


def keywords(function: Callable[..., None]) -> list[str]:
    """The names of the keyword-only parameters of a function."""
    parameters = inspect.signature(function).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


def load_stage(name: str) -> StageModule:
    """Import a stage's module by its dotted name. The only way from the command line to a stage."""
    module = importlib.import_module(name)
    known = ("RESUMES", "LOADS", "cost", "SHORTER", "check", "compiled", "sizes", "moves", "published")
    optional = {key: getattr(module, key, None) for key in known}
    given = {key.lower(): value for key, value in optional.items() if value is not None}
    return StageModule(module.Params, module.run, **given)


def version() -> str:
    """The version of hugs, as 0.3.0."""
    from importlib import metadata

    return metadata.version(DISTRIBUTION)


def build() -> str:
    """The version and, of a checkout or of an installation from one by its address, the commit: 0.3.0+1a2b3c4d."""
    from importlib import metadata

    origin = json.loads(metadata.distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
    commit, root = origin.get("vcs_info", {}).get("commit_id", ""), Path(__file__).parents[1]
    if (root / ".git").exists() and shutil.which("git"):
        asked = ["git", "-C", str(root), "rev-parse", "HEAD"]
        commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return f"{version()}+{commit[:8]}" if commit else version()


MAXRSS = 1 if sys.platform == "darwin" else 1024
"""Bytes in one unit of `ru_maxrss`: macOS counts bytes, Linux kilobytes."""


def peak_memory() -> int:
    """The most memory that this process held at once, in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS
