"""`hugs.run` works like the command `hugs run`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hugs.progress import Hear, console_for
from hugs_cli import pipelines
from hugs_cli.cache import engine
from hugs_cli.cache.engine import RunStopped
from hugs_cli.device import device_of
from hugs_cli.options import MAX_SEED, RunOptions
from hugs_cli.pipelines import UsageError
from hugs_cli.within import promise

if TYPE_CHECKING:
    from hugs.avatar import Avatar

Pathish = str | PathLike[str]


def run(
    video: Pathish,
    pipeline: str = "default",
    work: Pathish = "work",
    settings: Mapping[str, Any] | None = None,
    progress: Hear | None = None,
    *,
    masks: Pathish | None = None,
    person: str | None = None,
    cameras: Pathish | None = None,
    smpl_fit: Pathish | None = None,
    landmarks: Pathish | None = None,
    face: Pathish | None = None,
    body_model: Pathish | None = None,
    height: str | float | Sequence[str | float] | None = None,
    scale: str | None = None,
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    within: str | None = None,
    pipelines_file: Pathish | None = None,
) -> Avatar:
    """Run a pipeline on a clip, as `hugs run` does, and return the avatar, as `hugs.load` of the run's folder does.

    The results are in the command's folder, `WORK/CLIP/PIPELINE`, and fresh results there are reused. Each stage
    runs in a process of its own, so a script needs no `if __name__ == "__main__"`. `progress` is called with
    a `Progress`; without it the lines of the command go to stderr. Ctrl-C stops the stage and raises KeyboardInterrupt:
    finished stages are kept, and the next call continues.

    - `video`: a video, a folder of pictures, or the folder of a data set. `pipeline`: a name in pipelines.yaml or `pipelines_file`.
    - `work`: the folder of all results. `settings`: by stage and name, for example {"train.steps": 4000}; `hugs stages` lists them.
    - `masks`, `cameras`, `smpl_fit`, `landmarks`, `face`, `body_model`: files of other programs, see docs/inputs.md.
    - `person`: the id of the person to follow, if several are in view; "all" makes an avatar of each.
    - `height`: of the person, barefoot, in m or as "6ft1"; a list for several people, in order. `scale`: a length on the page and
      its true length, for example "2.31=2.00"; or "cameras".
    - `seed`: of all random numbers. `device`: "auto", "cpu" or "cuda". `force`: run all stages again.
    - `within`: train for what is left of a time such as "10m" or "1h30m"; results lie in `WORK/CLIP/PIPELINE.TIME`.

    StageError, with the facts and the hint that the command prints; KeyboardInterrupt after Ctrl-C.

        avatar = hugs.run("dance.mp4", settings={"train.steps": 4000}, progress=print)
    """
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"no such seed: {seed}", f"seeds go from 0 to {MAX_SEED}")
    given = RunOptions(
        set_=[f"{name}={json.dumps(value)}" for name, value in (settings or {}).items()],
        masks=_path(masks),
        person=person,
        cameras=_path(cameras),
        smpl_fit=_path(smpl_fit),
        landmarks=_path(landmarks),
        face=_path(face),
        body_model=_path(body_model),
        height=_texts(height),
        scale=scale,
        seed=seed,
        pipeline=pipeline,
        work=Path(work),
        pipelines_file=_path(pipelines_file) or pipelines.FILE,
    )
    folder = _finish(given, Path(video), device, force, progress, within)
    from hugs.avatar import load  # torch, which no stage's process shares

    return load(folder)


def _finish(
    given: RunOptions, video: Path, device: str, force: bool, progress: Hear | None, within: str | None
) -> Path:
    """Bring all stages up to date, `within` a time if there is one; returns the folder of their links."""
    session = given.session(video)
    wanted = list(session.pipeline.stages)
    promised = None if within is None else promise(session, None, within)
    session = promised.session if promised else session
    session.check_sources()
    session.workspace.create()
    console = console_for(progress)
    console.header(video.name, "", session.pipeline.name, str(session.workspace.root), *device_of(device))
    forced = frozenset(wanted if force else ())
    try:
        if promised:
            promised.keep(forced, device, console)
        else:
            engine.run(session, wanted, forced, device, console, report=True)
    except RunStopped as stopped:
        where = f" in {stopped.stage}" if stopped.stage else ""
        raise KeyboardInterrupt(f"stopped{where}; finished stages are kept") from None
    return session.workspace.links


def _path(given: Pathish | None) -> Path | None:
    return None if given is None else Path(given)


def _texts(given: str | float | Sequence[str | float] | None) -> list[str] | None:
    """One value or several as texts, as on a command line."""
    if given is None:
        return None
    return [str(one) for one in ([given] if isinstance(given, str | int | float) else given)]
