"""Every command that takes an avatar, with every kind of avatar: `animate`, `compose`, `render`, and the front for scripts."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hugs as front
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.rig import rig_of
from stages.filming import outputs
from stages.formats.cameras import write_cameras
from stages.formats.exchange.splats_glb import write_splats_glb
from stages.formats.images import read_image
from stages.formats.splats import read_avatar, write_splats
from stages.records import Avatar, Cameras
from tests.made import finished
from tests.made.clothes import dress, some_clothes
from tests.made.command import hugs_here
from tests.made.meshes import coarse
from tests.made.tiny import colour_of

pytestmark = pytest.mark.slow


def npz(path: Path, avatar: Avatar) -> None:
    write_splats(path.with_suffix(".npz"), avatar)


def glb(path: Path, avatar: Avatar) -> None:
    write_splats_glb(path.with_suffix(".glb"), rig_of(avatar), [])


def older(path: Path, avatar: Avatar, version: int | None) -> None:
    """As a hugs wrote it that said no version, or that of clothes without bones."""
    npz(path, avatar)
    with np.load(path.with_suffix(".npz")) as file:
        arrays = {name: file[name] for name in file if name != "version"}
    if version:
        arrays |= {"version": np.int32(version), "clothes_nodes": np.zeros((4, 3), np.float32)}
    np.savez(path.with_suffix(".npz"), **arrays)


def plain(avatar: Avatar) -> Avatar:
    return avatar


def clothed(avatar: Avatar) -> Avatar:
    return dress(avatar, some_clothes())


def all_cloth(avatar: Avatar) -> Avatar:
    """Most Gaussians hang on bones of clothes alone."""
    worn = clothed(avatar)
    weights = np.array(worn.lbs_weights)
    loose = weights[:, 24:].sum(1) > 0.5
    weights[loose, :24] = 0
    return replace(worn, lbs_weights=weights / weights.sum(1, keepdims=True))


def as_smpl(avatar: Avatar) -> Avatar:
    """On another body than the free one: its joints are elsewhere."""
    return replace(avatar, joints=avatar.joints + [0.01, -0.225, 0.03], means=avatar.means + [0.01, -0.225, 0.03])


KINDS: dict[str, tuple[Callable[[Avatar], Avatar], Callable[[Path, Avatar], None]]] = {
    "plain.npz": (plain, npz),
    "plain.glb": (plain, glb),
    "clothes.npz": (clothed, npz),
    "clothes.glb": (clothed, glb),
    "smpl_clothes.npz": (lambda avatar: clothed(as_smpl(avatar)), npz),
    "smpl_clothes.glb": (lambda avatar: clothed(as_smpl(avatar)), glb),
    "smpl_cloth_alone.npz": (lambda avatar: all_cloth(as_smpl(avatar)), npz),
    "unsaid.npz": (as_smpl, partial(older, version=None)),
    "before_bones.npz": (lambda avatar: replace(avatar, antialias=True), partial(older, version=1)),
}
RUNS: dict[str, list[str]] = {
    "work/ann/default": [],
    "work/bare/default": [],
    "work/two/default": ["--who", "2"],
    "work/worn/default": [],
}
OUTS = {"film": ".mp4", "alpha": ".mov", "page": ".html", "splats": ".ply", "glb": ".glb"}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Avatars of all KINDS, and runs: plain, without a scene, of two people, and in clothes."""
    folder = tmp_path_factory.mktemp("kinds")
    for clip in ("ann", "bare", "two", "worn"):
        finished.make(folder, clip)
    avatar = read_avatar(folder / "work/ann/default/train/avatar.npz")
    thin = {name: getattr(avatar, name)[::4] for name in ("quats", "scales", "opacities", "sh0", "shN", "lbs_weights")}
    avatar = replace(avatar, means=avatar.means[::4], **thin)
    base = replace(avatar, joints=avatar.joints - [0.01, -0.225, 0.03], means=avatar.means - [0.01, -0.225, 0.03])
    for name, (change, write) in KINDS.items():
        write(folder / name, change(base))
    (folder / "work/bare/default/train/scene.npz").unlink()
    write_splats(folder / "work/worn/default/train/avatar.npz", clothed(avatar))
    second = folder / "work/two/default/train/people/2"
    shutil.copytree(folder / "work/two/default/train", second, ignore=shutil.ignore_patterns("people", "scene.npz"))
    write_splats(second / "avatar.npz", clothed(avatar))
    ahead = look_at(np.array([0.0, 0, 3]), np.zeros(3), np.array([0.0, 1, 0]))
    write_cameras(folder / "view.npz", Cameras(("000",), ahead[None], pinhole(100.0, 96, 128)[None], 96, 128))
    np.savez(folder / "moves.npz", poses=np.zeros((3, 72)), trans=np.zeros((3, 3)), fps=4)
    return folder


@pytest.fixture
def hugs(made, monkeypatch, capsys):
    monkeypatch.setattr(outputs, "MESH", (500, 64))
    with coarse():
        yield partial(hugs_here, made, monkeypatch, capsys)


def film_of(people: list[str], name: str, kinds: Iterable[str] = OUTS) -> str:
    outs = ", ".join(f"{kind}: {name}{OUTS[kind]}" for kind in kinds)
    return (
        f"scene: work/ann/default\npeople: [{', '.join(people)}]\nfps: 4\nseconds: 0.25\nsize: [48, 64]\n"
        f"camera: before\nout: {{{outs}, stills: {{folder: {name}_at, at: [0]}}}}\n"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_animated_rendered_and_loaded(kind, made, hugs):
    name = f"out_{kind.replace('.', '_')}"
    hugs("animate", "--avatar", kind, "moves.npz", "--camera", "view.npz", "--fps", "4", "--out", f"{name}.mp4")
    hugs("render", "--avatar", kind, "--cameras", "view.npz", "--out", f"{name}_views")
    assert (colour_of(read_image(made / f"{name}_views/000.png")[..., :3]) >= 0).sum() > 100
    person = front.load(made / kind).pose()
    assert np.isfinite(person.means).all() and len(person.means) > 400


def test_every_kind_of_file_is_in_a_film_in_all_that_it_is_written_as(made, hugs):
    (made / "all.yaml").write_text(
        film_of([f"{{avatar: {kind}, motion: squats, at: [0, {i}]}}" for i, kind in enumerate(KINDS)], "all")
    )
    hugs("compose", "all.yaml")
    assert len({path.suffix for path in made.glob("all.*")}) == 6
    seen = colour_of(read_image(made / "all_at/000.000.png"))
    assert (seen >= 0).sum() > 100


def test_every_kind_of_run_is_animated_composed_and_rendered(made, hugs):
    people = []
    for run, who in RUNS.items():
        clip = Path(run).parent.name
        said = ("moves.npz", *who, "--only", "human", "--fps", "4", "--camera", "view.npz", "--out", f"{clip}_own.mp4")
        hugs("animate", f"{clip}.mp4", *said)
        hugs("render", f"{clip}.mp4", *who, "--cameras", "view.npz", "--only", "human", "--out", f"{clip}_views")
        people.append(f"{{avatar: {run}, who: {int((who or ['', 1])[1])}, motion: squats, at: [{len(people)}, 0]}}")
    hugs("animate", "--avatar", "smpl_clothes.npz", "moves.npz", "--scene", "work/two/default", "--fps", "4")
    (made / "runs.yaml").write_text(film_of(people, "runs", ("film", "splats", "glb")))
    hugs("compose", "runs.yaml")
    assert (colour_of(read_image(made / "runs_at/000.000.png")) >= 0).sum() > 100
