"""The command that puts people of several clips into one scene: compose. `animate` draws through it, too."""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import AbstractContextManager, nullcontext
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hugs_cli import film as films
from hugs_cli import words
from hugs_cli.cache.fingerprint import Code, digest
from hugs_cli.cache.locks import locked
from hugs_cli.cache.whole import replace
from hugs_cli.cache.workspace import LOCK
from hugs_cli.console import Console
from hugs_cli.device import device_of
from hugs_cli.direct import run_directly
from hugs_cli.options import CODE_MEMORY, Device, DeviceName, Overwrite, Work
from hugs_cli.outputs import check_out, remembering
from hugs_cli.pipelines import UsageError
from stages.contract import Job

KEPT = ".films"  # in the work folder: pieces of films, a folder each
FIRST = "film.yaml"


def compose(
    films_: Annotated[
        list[Path] | None,
        Argument(
            metavar="FILM | RUN...", help="The film (.yaml); with --init runs or exported avatars.", show_default=False
        ),
    ] = None,
    init: Annotated[
        bool, Option("--init", help="Write a film of these RUNs to begin with; the first is the scene.")
    ] = False,
    out: Annotated[Path, Option(help="With --init: the film to write.")] = Path(FIRST),
    force: Overwrite = False,
    device: DeviceName = Device.auto,
    work: Work = Path("work"),
) -> None:
    """Put people of several clips into one scene.

    `hugs compose --init work/kitchen/default work/dance/default` writes film.yaml, if possible with places and a camera that show
    everybody. `hugs compose film.yaml` makes a film, pictures, a page or files for other programs. Outputs that are up to date are
    not made again; a film that was interrupted continues.
    """
    given = films_ or []
    if init:
        begin(given, out, force, device.value, work)
        return
    if len(given) != 1:
        raise UsageError(f"{len(given)} films to make", "`hugs compose film.yaml`")
    console = Console()
    for path in composed(given[0], device.value, work, force, console):
        console.result(words.relative(path))


def composed(file: Path, device: str, work: Path, force: bool, console: Console) -> list[Path]:
    """Make the film of a file, keeping its pieces in the work folder; names what was made."""
    film = films.read_film(file)
    if not films.outputs(film):
        raise UsageError(f"{file.name} names no output", "add `out: {film: film.mp4}`")
    kept = work / KEPT / f"{file.stem}-{digest(os.path.realpath(file))[:8]}"
    return shoot(film, kept, device, work, force, [file], console, "compose")


def shoot(
    film: Any,
    kept: Path | None,
    device: str,
    work: Path,
    force: bool,
    given: list[Path],
    console: Console,
    name: str,
) -> list[Path]:
    """Make a film, keeping its pieces in the folder `kept`, and name what was made; `given` is not written over."""
    sources = [*given, *films.check_sources(film)]
    outs, folder = films.outputs(film), film.out.stills and film.out.stills.folder
    for one, other in permutations(outs, 2):
        place, inside = (Path(os.path.realpath(path)) for path in (one, other))
        if place == inside or (one != folder and place in inside.parents):
            raise UsageError(f"{one} and {other} cannot both be written", "give each another path")
    for path in outs:
        check_out(path, work, sources, force, is_folder=path == folder)
    where, _ = device_of(device)
    emit = remembering(work, console.listens(name))
    code = Code(work / CODE_MEMORY)
    settings = film.model_dump() | {"keep": kept is not None, "code": digest(code.digests(films.MODULE))}
    alone: AbstractContextManager[Any] = nullcontext()
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        code.save()
        alone = locked(kept / LOCK, lambda holder: console.say(f"waiting: {holder} is making this film"), without=True)
    with alone:
        run_directly(films.MODULE, Job(kept or work, where, emit=emit), settings)
    return outs


TEMPLATE = """\
# A film of people of several clips in one scene: `{command}` makes it. Paths count from this file's folder.
scene: {scene}
# ground: {{point: [0, 1, 3], up: [0, -1, 0], ahead: [0, 0, -1]}}   # where the scene is a .ply or .spz: its floor

people:
{people}
camera: {camera}              # clip, still, follow (of the scene's clip), orbit, before, auto (one that shows them), or an .npz
light: auto               # auto: as the scene's own light falls; above; off
colour: off               # match people to the scene: off, auto (if clips differ clearly and their light is known), always
fps: 30
# seconds: 8              # by default as long as the longest motion
# size: [640, 360]        # by default that of the scene's clip; a size of another shape shows a part of its picture
# moment: 2.0             # second of the film that `splats` shows

out:
  film: {mp4}
  # page: {html}         # all of them in a browser
  # stills: {{folder: {stills}, at: [0.5, 2.0]}}
  # alpha: {mov}         # the people alone, with alpha
  # splats: {ply}        # scene and people at `moment`, .ply or .spz
  # glb: {glb}           # skinned people with their motions, and the scene
  # usd: {usdc}          # needs the extra `usd`
"""
PERSON = """\
  - avatar: {avatar}
{who}    motion: {motion}          # a .bvh or .npz; clip: as in their own clip; wave, squats, jumping_jacks, walk_in_place
    {at:<22}# m on the floor from where the scene's person stood: to their left, ahead; else where it is free
    turn: 0               # degrees to the left
    # start: 1.5          # second of the film at which the motion begins; less than 0: it is under way
    # speed: 1.0          # times as fast
    # loop: true          # begin again at the end
    # scale: 1.0          # times as large
"""
WHO = """    who: {}                # which of the people of this run
"""
AT, PLAN = "# at: [1.0, 0.0]", "plan.json"
OTHERS = "train/people/*/avatar.npz"  # of a run: its further people


def begin(runs: list[Path], out: Path, force: bool, device: str, work: Path) -> None:
    """Write a commented film of runs and exported avatars, side by side in the scene of the first."""
    if not runs:
        raise UsageError("nobody to make a film of", "`hugs compose --init work/kitchen/default work/dance/default`")
    if out.exists() and not force:
        raise UsageError(f"{out} is already there", "choose another `--out`, or overwrite it with `--force`")
    check_out(out, work, runs, force=True)
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise UsageError(f"cannot write {out}: a film is a .yaml", "`--out film.yaml`")
    names = [films.quoted(os.path.relpath(run, os.path.realpath(out.parent))) for run in runs]
    scene = names[0] if runs[0].is_dir() and (runs[0] / "train" / "scene.npz").exists() else None
    people = []
    for name, run in zip(names, runs, strict=True):
        further, motion = len(list(run.glob(OTHERS))), "clip" if run.is_dir() else "wave"
        for number in range(1, 2 + further):
            people.append({"avatar": name, "who": WHO.format(number) if further else "", "motion": motion, "at": AT})
    parts = {"scene": scene or "null", "camera": "clip" if scene else "before"}
    parts["command"] = words.command("compose", out.name, pipeline="default", work=Path("work"))
    parts |= {ending: films.quoted(f"{out.stem}.{ending}") for ending in ("mp4", "html", "mov", "ply", "glb", "usdc")}
    parts["stills"] = films.quoted(out.stem)

    def written() -> str:
        return TEMPLATE.format(**parts, people="".join(PERSON.format(**person) for person in people))

    out.parent.mkdir(parents=True, exist_ok=True)
    film = films.checked(films.plain_yaml.read(written()), out.name, out.parent)
    films.check_sources(film)
    console = Console()
    if scene:
        found = planned(film, device, work, console)
        parts["camera"] = found["camera"]
        for person, (left, ahead) in zip(people, found["at"], strict=True):
            person["at"] = person["at"] if [left, ahead] == [0, 0] else f"at: [{left:g}, {ahead:g}]"
    replace(out, written())
    console.result(words.relative(out))


def planned(film: Any, device: str, work: Path, console: Console) -> dict[str, Any]:
    """Where people of a film stand, and a camera that shows them: the keys `at` and `camera`."""
    where, _ = device_of(device)
    with tempfile.TemporaryDirectory() as folder:
        job = Job(Path(folder), where, emit=remembering(work, console.listens("compose")))
        run_directly(films.MODULE, job, film.model_dump() | {"plan": True})
        plan: dict[str, Any] = json.loads((Path(folder) / PLAN).read_bytes())
    return plan
