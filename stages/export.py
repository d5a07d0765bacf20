"""Write person and scene in the formats that other programs open."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.formats.exchange.limits import held, unmarked
from stages.formats.exchange.vrm_meta import VrmMeta
from stages.formats.facts import Listing, read_facts
from stages.formats.people import folder_of, job_of, model_of, people_of

if TYPE_CHECKING:
    from stages.avatar.motion.placing import Soles
    from stages.formats.viewer import Exhibit
    from stages.records import Avatar, Ground, Rig, Scene, Take

LOADS = contract.TORCH
RIGGED = ("glb", "vrm", "splats_glb")
MOVING = ("usd_motion", "ply_motion", "spz_motion")
ACCOUNT = 10  # pictures of a motion between two reports
Format = Literal[
    "ply", "spz", "glb", "bvh", "viewer", "vrm", "splats_glb", "usd", "usd_motion", "ply_motion", "spz_motion", "sog"
]


class Params(contract.Params):
    formats: list[Format] = Field(["ply", "spz", "glb", "bvh", "viewer"])
    """What to write beside avatar.npz. viewer is the page viewer.html; vrm is avatar.vrm; splats_glb are the Gaussians on the
    skeleton; usd needs the extra `usd`, sog the extra `sog`; bvh is the clip's motion, and also `motion` where that is another;
    ..._motion is a file, or a folder of numbered files, of the person in `motion`."""
    names: Literal["smpl", "mixamo", "vrm", "unreal"] = "smpl"
    """Names of the joints in avatar.glb, avatar.vrm and motion.bvh."""
    triangles: int = Field(20_000, ge=200, le=200_000)
    """Approximate number of triangles of the mesh in avatar.glb and avatar.vrm."""
    texture: int = Field(2048, ge=64, le=8192)
    """Width and height of the mesh's texture, px."""
    motion: Literal["clip", "jumping_jacks", "walk_in_place", "wave", "squats", "all"] = "clip"
    """Motion in the formats bvh and ..._motion; clip: the clip's own; all: that and the generated ones."""
    vrm: VrmMeta = VrmMeta()
    """Name, authors and permissions in avatar.vrm."""
    spz_axes: Literal["y_down", "y_up"] = "y_down"
    """Which way is up in .spz files: y_down as in a .ply, which most programs expect, or y_up as in the specification."""
    spz_version: Literal[3, 4] = 3
    """Version of .spz files; 4 is a little smaller, but some programs refuse it."""


def check(params: Params) -> None:
    """See `contract.StageModule`: a format that needs a package which is missing."""
    from stages.formats.exchange.sog import check_sog
    from stages.formats.exchange.usd import check_usd

    formats: set[str] = set(params.formats)
    if formats & {"usd", "usd_motion"}:
        check_usd()
    if "sog" in formats:
        check_sog()


def run(job: Job, params: Params, *, frames: Path, sfm: Path, smpl: Path, train: Path) -> None:
    """Write avatar.npz (skeleton and weights), avatar and scene as .ply, .spz, .glb or other formats, and viewer.html.

    Files of further people are in people/2 and so on; the page shows all.
    """
    from stages.avatar.drawing.rig import rig_of
    from stages.avatar.motion.placing import Soles
    from stages.filming.clip_cast import completed
    from stages.filming.clip_page import clip_page
    from stages.formats.body_model import read_body_model
    from stages.formats.effects import read_effects
    from stages.formats.ground import read_ground, write_ground
    from stages.formats.splats import read_avatar, read_scene

    formats: set[str] = set(params.formats)
    check(params)
    people = people_of(sfm)
    scene = read_scene(train / "scene.npz") if (train / "scene.npz").exists() else None
    ground = read_ground(smpl / "ground.json")
    write_ground(job.out / "ground.json", ground)
    shaded = read_effects(train / "effects.npz").shading is not None
    cast: list[tuple[Avatar, Rig, Soles]] = []
    for person in people:
        there, out = folder_of(train, person), folder_of(job.out, person)
        own = job if len(people) == 1 else replace(job_of(job, person), out=out)
        own.out.mkdir(parents=True, exist_ok=True)
        avatar = completed(read_avatar(there / "avatar.npz"), read_body_model(model_of(smpl, person)))
        shutil.copyfile(there / "avatar.npz", own.out / "avatar.npz")
        around = scene if person == 1 else None
        own.note(f"avatar {len(avatar)} Gaussians" + (f", scene {len(around)}" if around else ""))
        rig = rig_of(avatar)
        soles = Soles.of_rig(rig)
        _still(own, params, avatar, around, soles, ground)
        moves, bodies = bool(formats & {*RIGGED, "bvh", *MOVING}), folder_of(smpl, person)
        takes = _takes(frames, bodies, there, ground, soles, avatar) if moves else []
        if formats & set(RIGGED):
            _rigged(own, params, avatar, rig, takes, soles.floor)
        if "bvh" in formats:
            _motions(own, params, rig, takes, soles.floor)
        if formats & set(MOVING):
            for take in _chosen(takes, params.motion):
                _moving(own, params, avatar, take, soles.floor)
        _lacks_of_person(own, formats, avatar, rig)
        cast.append((avatar, rig, soles))
        job.progress(len(cast), len(people) + 1)
    _lacks(job, params, [avatar for avatar, *_ in cast], scene, shaded)
    if "viewer" in formats:
        _viewer(job, clip_page(frames, sfm, smpl, train, cast, scene, ground))


def _still(job: Job, params: Params, avatar: Avatar, scene: Scene | None, soles: Soles, ground: Ground) -> None:
    """The person in the canonical pose, soles at height 0, and the scene. Viewers take ply, spz and sog as y down.

    There the scene keeps the axes of its cameras, y down. In USD y is up, and the scene's floor is at 0.
    """
    import numpy as np

    from stages.avatar.splats.turn import OVER, turned
    from stages.formats.exchange.ply import write_ply
    from stages.formats.exchange.sog import write_sog
    from stages.formats.exchange.usd import write_usd

    formats: set[str] = set(params.formats)
    feet, _ = soles.at(np.zeros((1, 3)), avatar.canonical_pose[None], np.zeros((1, 3)))
    below = np.array([0, feet[..., 1].min(), 0])
    down = {"avatar": turned(avatar, OVER, below)} | ({"scene": scene} if scene else {})
    for name, splats in down.items():
        if "ply" in formats:
            _say_held(job, f"{name}.ply", write_ply(job.out / f"{name}.ply", splats))
        if "spz" in formats:
            _say_held(job, f"{name}.spz", _spz(params)(job.out / f"{name}.spz", splats))
        if "sog" in formats:
            write_sog(job.out / f"{name}.sog", splats)
    if "usd" in formats:
        write_usd(job.out / "avatar.usdc", {"avatar": turned(avatar, np.eye(3), below)})
    if "usd" in formats and scene:
        write_usd(job.out / "scene.usdc", {"scene": turned(scene, ground.turn.T, ground.point)})


def _spz(params: Params) -> Callable[[Path, Scene], dict[str, int]]:
    """What writes Gaussians whose y is down as .spz, with the axes and of the version that are wanted."""
    from stages.avatar.splats.turn import OVER, turned
    from stages.formats.exchange.spz import write_spz

    def write(path: Path, splats: Scene) -> dict[str, int]:
        return write_spz(path, splats if params.spz_axes == "y_down" else turned(splats, OVER), params.spz_version)

    return write


def _say_held(job: Job, name: str, clamped: dict[str, int]) -> None:
    for line in held(name, clamped):
        job.note(line)


def _takes(frames: Path, smpl: Path, train: Path, ground: Ground, soles: Soles, avatar: Avatar) -> list[Take]:
    """The clip's own motion, if anybody was seen, and the made ones, with the avatar's clothes and fingers.

    `smpl` and `train` are the person's own folders of these stages.
    """
    import numpy as np

    from stages.avatar.drawing.avatar import load_avatar
    from stages.avatar.drawing.takes import hung
    from stages.avatar.motion.takes import clip_take, made_takes
    from stages.formats.hands import hands_in, with_hands
    from stages.formats.poses import read_poses

    body = with_hands(read_poses(train / "body.npz"), hands_in(smpl))
    clip = clip_take(body, np.array(read_facts(frames / "frames.json", Listing).times(body.names)), ground, soles)
    baked = load_avatar(avatar)
    return [hung(baked, take) for take in [*([clip] if clip else []), *made_takes(soles.joints[0])]]


def _rigged(job: Job, params: Params, avatar: Avatar, rig: Rig, takes: list[Take], floor: float) -> None:
    """The person on a skeleton with motions: as a textured mesh, and as Gaussians."""
    from stages.avatar.surface.mesh import NoSurfaceError, surface_of
    from stages.formats.exchange.avatar_glb import targets_of, write_avatar_glb
    from stages.formats.exchange.avatar_vrm import write_avatar_vrm
    from stages.formats.exchange.splats_glb import write_splats_glb
    from stages.gestures import FINGER_NAMES

    has = f"{params.names} skeleton; motions {', '.join(take.name for take in takes)}"
    glb, fingers = job.out / "avatar.glb", f", {len(FINGER_NAMES)} finger bones" * (rig.fingers is not None)
    if {"glb", "vrm"} & set(params.formats):
        try:
            mesh = surface_of(avatar, params.triangles, params.texture)
        except NoSurfaceError as error:
            hint = f"--set 'export.formats=[{', '.join(one for one in params.formats if one not in ('glb', 'vrm'))}]'"
            raise StageError("the person's Gaussians make no mesh", hint, [str(error)]) from error
        size = f"{len(mesh.faces)} triangles, texture {len(mesh.texture)} px{fingers}"
        size += f", {len(targets_of(mesh))} shapes of the face" * (mesh.morphs is not None)
        if "glb" in params.formats:
            write_avatar_glb(glb, rig, mesh, takes, params.names, floor)
            job.note(f"avatar.glb: {size}, {glb.stat().st_size / 1e6:.1f} MB; {has}")
        if "vrm" in params.formats:
            write_avatar_vrm(job.out / "avatar.vrm", rig, mesh, params.vrm, params.names, floor)
            job.note(f"avatar.vrm: {size}, as VRM 1.0 by {', '.join(params.vrm.authors)}")
        for line in mesh.said:
            job.note(f"mesh: {line}")
    if "splats_glb" in params.formats:
        write_splats_glb(job.out / "avatar_splats.glb", rig, takes, params.names, floor)
        job.note(f"avatar_splats.glb: Gaussians as points{fingers}; {has}")


def _chosen(takes: list[Take], motion: str) -> list[Take]:
    """The takes that `motion` names; StageError where nobody was seen and the clip's own is asked for."""
    found = [take for take in takes if motion in (take.name, "all")]
    if not found:
        raise StageError("nobody is seen in this clip, so it has no motion", "--set export.motion=wave")
    return found


def _motions(job: Job, params: Params, rig: Rig, takes: list[Take], floor: float) -> None:
    """motion.bvh of the clip, and a file of each other motion that `motion` names."""
    from stages.avatar.motion.takes import even
    from stages.formats.exchange.motion_bvh import write_motion_bvh

    for take in (one for one in takes if params.motion in (one.name, "all") or one.name == "clip"):
        name = "motion.bvh" if take.name == "clip" else f"motion_{take.name}.bvh"
        spaced = even(take)
        write_motion_bvh(job.out / name, rig, spaced, params.names, floor)
        made = f", {len(spaced) - len(take)} of them between two frames" if len(spaced) > len(take) else ""
        bent = ", fingers" * (spaced.fingers is not None)
        job.note(f"{name}: {len(spaced)} poses{made}{bent}, {params.names} names, metres")
    if all(take.name != "clip" for take in takes):
        job.note("no motion.bvh: nobody is seen in this clip")


def _moving(job: Job, params: Params, avatar: Avatar, take: Take, floor: float) -> None:
    """The person in one motion on a floor at height 0: a USD with a sample a frame, folders of numbered PLY or SPZ."""
    import numpy as np

    from stages.avatar.drawing.avatar import load_avatar
    from stages.avatar.drawing.takes import posed
    from stages.avatar.splats.turn import OVER, turned
    from stages.formats.exchange.ply import write_ply
    from stages.formats.exchange.usd import write_usd

    baked, name = load_avatar(avatar, job.device), f"avatar_{take.name}"
    numbered: dict[str, tuple[str, Callable[[Path, Scene], dict[str, int]]]] = {
        "ply_motion": ("ply", write_ply),
        "spz_motion": ("spz", _spz(params)),
    }
    chosen = [numbered[one] for one in params.formats if one in numbered]
    most: dict[str, dict[str, int]] = {}
    for ending, _ in chosen:
        most[ending] = {}
        (job.out / f"{name}_{ending}").mkdir()

    def pictures() -> Iterator[Scene]:
        for number, posed_there in enumerate(posed(baked, take)):
            splats = replace(posed_there, means=posed_there.means - np.array([0, floor, 0], np.float32))
            for ending, write in chosen:
                clamped = write(job.out / f"{name}_{ending}" / f"frame{number:05d}.{ending}", turned(splats, OVER))
                for what, count in clamped.items():
                    most[ending][what] = max(count, most[ending].get(what, 0))
            if number % ACCOUNT == 0:
                job.progress(number, len(take))
            yield splats

    if "usd_motion" in params.formats:
        fps = (len(take) - 1) / take.times[-1] if len(take) > 1 else 1.0
        write_usd(job.out / f"{name}.usdc", {}, {"avatar": pictures()}, fps)
    else:
        for _ in pictures():
            pass
    for ending, clamped in most.items():
        _say_held(job, f"a file of {name}_{ending}", clamped)
    job.note(f"{name}: {len(take)} poses, clothes as they move")


def _among(formats: set[str], *names: str) -> str:
    return ", ".join(name for name in names if name in formats)


def _lacks_of_person(job: Job, formats: set[str], avatar: Avatar, rig: Rig) -> None:
    """Say what the files of one person do not hold."""
    if "splats_glb" in formats:
        job.note(
            "avatar_splats.glb: eight bones for each Gaussian; the first four "
            f"hold {100 * rig.kept.mean():.1f} % of the weights"
        )
    if avatar.clothes is not None:
        if rigged := _among(formats, "glb", "splats_glb"):
            job.note(f"{rigged}: the {len(avatar.clothes)} bones of clothes move in the file's own motions")
        if stiff := _among(formats, "ply", "spz", "usd", "sog", "vrm"):
            job.note(f"clothes have {len(avatar.clothes)} bones and stand still in {stiff}")


def _lacks(job: Job, params: Params, people: list[Avatar], scene: Scene | None, lit: bool) -> None:
    """Say once what each format that was written does not hold, and which way up it stands; `lit`: by a light of the clip."""
    formats: set[str] = set(params.formats)
    spz = ("spz", "spz_motion")
    turned = set(spz) if params.spz_axes == "y_up" else set()
    if down := _among(formats - turned, "ply", "spz", "sog"):
        job.note(
            f"{down}: y down, upright in SuperSplat and PlayCanvas; for Spark and viser, turn by 180 degrees about x"
        )
    if up := _among(formats & ({"usd", "usd_motion"} | turned), "usd", "usd_motion", *spz):
        job.note(f"{up}: y up")
    if people[0].shN.shape[1] and (meshes := _among(formats, "glb", "vrm")):
        job.note(f"{meshes}: the texture holds no view-dependent colours")
    if people[0].shN.shape[1] and "splats_glb" in formats:
        job.note("avatar_splats.glb: view-dependent colours turn with the person, not with each bone")
    if lit and (
        even := _among(
            formats, "ply", "spz", "glb", "vrm", "splats_glb", "usd", "sog", "ply_motion", "spz_motion", "usd_motion"
        )
    ):
        job.note(f"the person's colours in {even} are those in even light, without the light of the clip")
    antialias = any(avatar.antialias for avatar in people) or (scene is not None and scene.antialias)
    if antialias and (names := _among(formats, "splats_glb", "usd", "usd_motion")):
        job.note(unmarked(names))


def _viewer(job: Job, shown: Exhibit) -> None:
    """The page on which people and scene move: viewer.html."""
    from stages.formats.viewer import write_viewer

    path = job.out / "viewer.html"
    lacks = write_viewer(path, shown)
    job.note(f"viewer.html, {path.stat().st_size / 1e6:.1f} MB")
    for line in lacks:
        job.note(f"not in viewer.html: {line}")
