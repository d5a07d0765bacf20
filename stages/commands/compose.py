"""A film of people of several clips in one scene. No pipeline names it; `hugs compose` and `hugs animate` run it."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stages import contract
from stages.contract import Job, StageError
from stages.filming.spec import Film

if TYPE_CHECKING:
    from stages.avatar.rasterize import Camera
    from stages.filming.cast import Actor
    from stages.filming.colours import Look
    from stages.filming.parts import Parts
    from stages.filming.setting import Setting
    from stages.filming.shoot import Shoot


PLAN = "plan.json"
VIEWS = ("clip", "auto", "before")  # of which a plan takes the first that cuts nobody off


class Params(Film):
    """The keys of film.yaml; `code` stands for the version of the program, with which all that was kept is out of date."""

    plan: bool = contract.internal(False)
    """Make nothing but a PLAN in `job.out`: where people stand, and a camera that shows them."""
    keep: bool = contract.internal(True)
    """Keep in `job.out` what a later run may use."""
    code: str = contract.internal("")


def run(job: Job, params: Params) -> None:
    """Draw the film that `params` describe, and write what they ask for; `job.out` keeps its pieces for the next run.

    All is read and looked at before anything is drawn. StageError for what cannot be read or does not go together.
    """
    from stages.filming.checks import faults_of
    from stages.filming.parts import Parts
    from stages.filming.setting import load_setting
    from stages.filming.shoot import Shoot
    from stages.formats.budget import check_count

    _check_endings(params)
    lengths = [("seconds", params.seconds or 0), ("moment", params.moment)]
    lengths += [("start", person.start) for person in params.people]
    lengths += [("at", second) for second in (params.out.stills.at if params.out.stills else ())]
    for key, seconds in lengths:
        check_count(abs(seconds) * params.fps, "pictures", f"a film with `{key}: {seconds:g}`")
    setting = load_setting(params, job.device)
    for fact in setting.scene.said if setting.scene else ():
        job.warn(fact)
    cast = _cast(job, params, setting)
    count = length_of(params, cast)
    check_count(count, "pictures", "the film")
    kind, cameras = _cameras(job, params, count, setting, cast)
    for fault in faults_of(cast, setting.ground, count, params.fps):
        job.warn(fault)
    if params.plan:
        places = [((actor.place - setting.ground.point) @ setting.ground.turn)[[0, 2]].round(2) + 0.0 for actor in cast]
        (job.out / PLAN).write_text(json.dumps({"camera": kind, "at": [place.tolist() for place in places]}))
        return
    shoot = Shoot(setting, cast, cameras, params.fps)
    with tempfile.TemporaryDirectory() as passing:
        _write(job, params, shoot, Parts(job.out if params.keep else Path(passing), params.code, job))


def _cameras(
    job: Job, film: Params, count: int, setting: Setting, cast: Sequence[Actor]
) -> tuple[str, Sequence[Camera]]:
    """The kind of the film's cameras, of a plan the first of VIEWS that shows all people, and the cameras; says what they lack."""
    from stages.filming.framing import faults, framed, framings, shows

    lacks: dict[str, list[str]] = {}
    for kind in VIEWS if film.plan else (film.camera,):
        cameras, fact = framed(kind, count, film.fps, film.size, setting, cast)
        seen = framings(cameras, film.fps, setting, cast)
        lacks[kind] = faults(seen, cast)
        if shows(seen):
            break
    for other in list(lacks)[:-1]:
        job.note(f"not `camera: {other}`: {'; '.join(lacks[other])}", at_once=True)
    if fact:
        job.note(fact, at_once=True)
    for lack in lacks[kind]:
        job.warn(lack)
    return kind, cameras


def length_of(film: Film, cast: Sequence[Actor]) -> int:
    """How many pictures the film has: as said, or until the last motion has ended once."""
    if film.seconds is not None:
        return max(1, round(film.seconds * film.fps))
    return max(1, *(actor.first + len(actor.transl) for actor in cast))


def names_of(film: Film) -> list[str]:
    """A name for each person, of letters and digits: the clip's or the file's, with a number where two share it."""
    names: list[str] = []
    for person in film.people:
        own = person.avatar.parent.name if person.avatar.is_dir() else person.avatar.stem
        plain = re.sub(r"\W", "_", own, flags=re.ASCII) or "person"
        plain = plain if plain[0].isalpha() else f"person_{plain}"
        numbered = (plain, *(f"{plain}_{number}" for number in range(2, len(film.people) + 2)))
        names.append(next(name for name in numbered if name not in ("scene", *names)))
    return names


def _check_endings(film: Film) -> None:
    from stages.avatar.motion.formulas import GESTURED, MOTIONS
    from stages.filming.cameras import AUTO, KINDS
    from stages.filming.outputs import check_splats

    wanted = {"film": ".mp4", "alpha": ".mov", "page": ".html", "glb": ".glb", "usd": ".usdc"}
    for name, ending in wanted.items():
        path = getattr(film.out, name)
        if path is not None and path.suffix.lower() != ending:
            facts = [f"it ends in {path.suffix!r}"]
            raise StageError(f"cannot write {path}: `out: {name}` is a {ending}", f"give it the ending {ending}", facts)
    if film.out.splats is not None:
        check_splats(film.out.splats)
    for person in film.people:
        if not Path(person.motion).suffix and person.motion not in ("clip", *MOTIONS, *GESTURED):
            hint = f"a .bvh or .npz, or one of clip, {', '.join(MOTIONS | GESTURED)}"
            raise StageError(f"no motion {person.motion!r}", hint)
    if not Path(film.camera).suffix and film.camera not in (AUTO, *KINDS):
        raise StageError(f"no camera {film.camera!r}", f"an .npz of cameras, or one of {AUTO}, {', '.join(KINDS)}")
    if film.out.usd is not None:
        from stages.formats.exchange.usd import check_usd

        check_usd()


def _cast(job: Job, film: Film, setting: Setting) -> list[Actor]:
    """The people, in the colours of the scene; says what is to be said of them and of the scene."""
    import numpy as np

    from stages.filming.cast import cast, in_colour, moved
    from stages.filming.colours import match
    from stages.filming.standing import free_places
    from stages.formats.exchange.limits import unmarked

    said = dict.fromkeys(setting.facts)
    people, looks = [], _Looks(film, setting)
    actors = [
        cast(person, name, setting.ground, film.fps, job.device)
        for person, name in zip(film.people, names_of(film), strict=True)
    ]
    places = free_places(film, [actor.start(setting.ground) for actor in actors], setting)
    for person, actor, place in zip(film.people, actors, places, strict=True):
        if person.at is None and place != (0, 0):
            where = f"[{place[0]:g}, {place[1]:g}]"
            said[f"{actor.name} stands at {where}, where least is in the way; `at:` says where else"] = None
            actor = moved(actor, setting.ground.turn @ np.array([place[0], 0, place[1]]))
        said |= dict.fromkeys(actor.facts)
        mode = person.colour or film.colour
        if mode != "off" and setting.scene is not None and person.avatar != film.scene:
            gain, done = match(looks.of(person.avatar), looks.of_scene(), mode == "always")
            said[f"{actor.name}'s {done}"] = None
            actor = in_colour(actor, gain) if (gain != 1).any() else actor
        people.append(actor)
    flags = {actor.baked.antialias for actor in people} | ({setting.scene.antialias} if setting.scene else set())
    if True in flags:
        files = (film.out.usd, film.out.glb if setting.scene and setting.scene.antialias else None)
        if names := ", ".join(path.name for path in files if path):
            said[unmarked(names)] = None
    if len(flags) == 2:
        one = setting.scene.antialias if setting.scene else people[-1].baked.antialias
        said[f"some were learned with anti-aliasing and some without: all are drawn {'with' if one else 'without'}"] = (
            None
        )
    for fact in said:
        job.note(fact, at_once=True)
    return people


class _Looks:
    """How clips look, each measured once, when it is asked for."""

    def __init__(self, film: Film, setting: Setting):
        self.film, self.setting = film, setting
        self.known: dict[Path, Look | None] = {}

    def of(self, run: Path) -> Look | None:
        from stages.filming.colours import look_of_clip
        from stages.formats.clip import load_clip

        if run not in self.known:
            folders = (run / "sfm", run / "smpl", run / "train")
            self.known[run] = look_of_clip(load_clip(*folders)) if run.is_dir() else None
        return self.known[run]

    def of_scene(self) -> Look | None:
        from stages.filming.colours import look_of_scene

        scene, setting = self.film.scene, self.setting
        if scene is None or setting.splats is None or scene.is_dir():
            return None if scene is None else self.of(scene)
        if scene not in self.known:
            self.known[scene] = look_of_scene(setting.splats, setting.ground)
        return self.known[scene]


def _write(job: Job, film: Film, shoot: Shoot, parts: Parts) -> None:
    """Write all that is asked for, saying of each file whether it was made or was there already."""
    from stages.filming import outputs
    from stages.filming.page import page

    out, count = film.out, shoot.count

    def done(before: int = 0) -> Callable[[int], None]:
        return lambda number: job.progress(before + number, total)

    films = [(path, path is out.alpha) for path in (out.film, out.alpha) if path is not None]
    total = max(1, count * (len(films) + (out.usd is not None)))
    made: dict[Path, bool] = {}
    for number, (path, alone) in enumerate(films):
        made[path] = outputs.film(shoot, path, parts, alone, done(number * count))
    if out.stills is not None:
        fresh = [not outputs.still(shoot, out.stills.folder, second, parts) for second in out.stills.at]
        made[out.stills.folder] = not all(fresh)
    if out.page is not None:
        made[out.page], lacks = page(shoot, out.page, parts)
        for line in lacks:
            job.note(f"not in {out.page.name}: {line}", at_once=True)
    if out.splats is not None:
        made[out.splats], held = outputs.splats(shoot, out.splats, film.moment, parts)
        for line in held:
            job.note(line, at_once=True)
    if out.glb is not None:
        made[out.glb] = outputs.glb(shoot, out.glb, parts)
    if out.usd is not None:
        made[out.usd] = outputs.usd(shoot, out.usd, parts, done(len(films) * count))
    parts.tidy()
    for path, new in made.items():
        if not new:
            job.note(f"{path.name} is up to date")
    job.note(f"{count} frame{'' if count == 1 else 's'}, {count / film.fps:.1f} s at {film.fps:g} fps")
