"""`hugs.export`, `hugs.animate` and `hugs.compose` work like the commands of these names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hugs.progress import Hear, console_for
from hugs_cli import film as films
from hugs_cli import pipelines
from hugs_cli.app_compose import composed, shoot
from hugs_cli.app_draw import animated, staged
from hugs_cli.app_export import exported
from hugs_cli.cache.workspace import read_json
from hugs_cli.options import RunOptions
from hugs_cli.pipelines import UsageError

if TYPE_CHECKING:
    from hugs.avatar import Avatar

Pathish = str | PathLike[str]
WORK = Path("work")


def export(
    run: Pathish | Avatar,
    out: Pathish,
    formats: Sequence[str] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    force: bool = False,
    device: str = "auto",
    progress: Hear | None = None,
    pipelines_file: Pathish | None = None,
) -> list[Path]:
    """Write avatar and scene of a finished run to the folder `out`, as `hugs export` does, and return the paths of the files.

    - `run`: the folder of a run, such as "work/dance/default", or an avatar that `hugs.load` read from it. The run's own export
      does not change.
    - `formats`: for example ["ply", "glb", "bvh"], see docs/exports.md; by default those of the run. `settings`: of the stage,
      for example {"names": "mixamo", "triangles": 5000}; `hugs stages export` lists all.
    - `force`: overwrite files that others made. `device`: "auto", "cpu" or "cuda". `progress`: called with a `Progress`.
    - `pipelines_file`: the file of the run's pipeline; by default pipelines.yaml.

    StageError, with facts and a hint, if the run is not finished, or if a file may not be overwritten.

        hugs.export("work/dance/default", "out", formats=["glb", "ply"])
    """
    values = dict(settings or {}) | ({} if formats is None else {"formats": list(formats)})
    console = console_for(progress)
    video, given = _run(_place(run), Path(pipelines_file or pipelines.FILE))
    given = given.of_last_run(video, console)
    return list(exported(video, Path(out), values, given, device, force, console))


def animate(
    person: Pathish | Avatar,
    motion: Pathish,
    out: Pathish,
    *,
    scene: Pathish | None = None,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    who: int = 1,
    only: str = "both",
    camera: Pathish | None = None,
    fps: float = 30.0,
    settings: Mapping[str, Any] | None = None,
    force: bool = False,
    device: str = "auto",
    progress: Hear | None = None,
) -> Path:
    """Make a film in which a person performs a motion file, as `hugs animate` does, and return the path of the film.

    - `person`: the folder of a run, such as "work/dance/default", the file of an avatar, or an avatar that `hugs.load` read.
    - `who`: the number of the person in a run, from 1 on.
    - `motion`: a .bvh of any skeleton, or an .npz of SMPL poses. `out`: the .mp4 to write, with `fps` frames a second.
    - `scene`: the folder of another run, or a .ply, .spz or .npz; by default the person's own. `at` [3] m: the place of the soles.
    - `only`: "both", or "human" over white. `camera`: a kind of docs/films.md, or an .npz as for `hugs render`.
    - `settings`: keys of a person in docs/films.md, for example {"motion_fps": 60, "up": "z"}.
    - `force`: overwrite a file that others made. `device`: "auto", "cpu" or "cuda". `progress`: called with a `Progress`.

    StageError, with facts and a hint, if the run is not finished, or if a file cannot be read or may not be overwritten.

        hugs.animate("work/dance/default", "moves.bvh", "dance-moves.mp4")
    """
    behind = None if scene is None else Path(scene)
    actor: dict[str, Any] = {"avatar": _place(person), "who": who, "motion": str(motion), **(settings or {})}
    film: dict[str, Any] = {"fps": fps, "only": only, "out": {"film": Path(out)}}
    film |= staged(actor, behind, at, None if camera is None else str(camera))
    (made,) = animated(film, device, _work(_place(person)), force, [], console_for(progress))
    return made


def compose(
    film: Pathish | Mapping[str, Any],
    *,
    work: Pathish = WORK,
    force: bool = False,
    device: str = "auto",
    progress: Hear | None = None,
) -> list[Path]:
    """Put people of several clips into one scene, as `hugs compose` does, and return the paths of the files.

    - `film`: a film.yaml, or a mapping with the same keys (docs/films.md) and paths relative to the current folder. Outputs of a
      film.yaml that are up to date are not made again.
    - `work`: the folder in which pieces of films are kept. `force`: overwrite files that others made.
    - `device`: "auto", "cpu" or "cuda". `progress`: called with a `Progress`.

    StageError, with facts and a hint, for unknown keys, for runs that are not finished and for files that may not be overwritten.

        hugs.compose("film.yaml")
        ann = {"avatar": "avatar.npz", "motion": "wave"}
        hugs.compose({"people": [ann], "camera": "orbit", "out": {"film": "wave.mp4"}})
    """
    console = console_for(progress)
    if not isinstance(film, Mapping):
        return composed(Path(film), device, Path(work), force, console)
    checked = films.checked(dict(film), "film")
    if not films.outputs(checked):
        raise UsageError("the film names no output", 'add `"out": {"film": "film.mp4"}`')
    return shoot(checked, None, device, Path(work), force, [], console, "compose")


def _run(folder: Path, file: Path) -> tuple[Path, RunOptions]:
    """The clip and the options of a run, from its folder; UsageError if it is not the folder of a run."""
    place = folder.absolute()
    known = read_json(place.parent / "sources.json").get("video")
    if not isinstance(known, dict) or not isinstance(known.get("path"), str):
        hint = "give the folder of a run, such as work/dance/default"
        raise UsageError(f"{folder} is not the folder of a run", hint, [f"no clip in {place.parent / 'sources.json'}"])
    return Path(known["path"]), RunOptions(pipeline=place.name, work=place.parents[1], pipelines_file=file)


def _work(person: Path) -> Path:
    """The work folder of a run; "work" for the file of an avatar."""
    return person.absolute().parents[1] if person.is_dir() else WORK


def _place(given: Pathish | Avatar) -> Path:
    """The folder or file of an avatar; UsageError if it was made in memory."""
    place = Path(given) if isinstance(given, str | PathLike) else given.path
    if place is None:
        raise UsageError("this avatar is from no file", "give the folder of a run, such as work/dance/default")
    return place
