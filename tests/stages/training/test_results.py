"""A training that is over is kept, whoever it made: somebody who cannot be finished stays as trained, and that is said."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from stages.avatar.model.person import Canonical, rest
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.formats.splats import impossible
from stages.records import BodyModel, BodyPoses
from stages.training import results
from stages.training.finishing import settle
from tests.made.said import holds
from tests.made.tiny import make_avatar
from tests.made.training import FRAMES, TRAIN, everything, fit_of, make_clip

clip = pytest.fixture(scope="module")(make_clip)
NAN, INF = float("nan"), float("inf")
FREE = read_body_model()
PEOPLE = {  # how what was trained comes out, how many of 162 rows are kept, and what is said
    "as it should": (lambda p: p, None, ""),
    **{f"{n} Gaussians": (lambda p, n=n: Canonical(*(part[:n] for part in p)), n, "of") for n in (1, 2, 5, 9, 24, 30)},
    "all strayed": (lambda p: p._replace(means=p.means + 5), 162, "none of 162 Gaussians is finite and on the body"),
    "far off": (lambda p: p._replace(means=p.means + 1e6), 162, "none of 162 Gaussians is finite and on the body"),
    "in one place": (lambda p: p._replace(means=0 * p.means), 162, "none of 162 Gaussians is finite and on the body"),
    "of 1 km": (lambda p: p._replace(scales=0 * p.scales + 1e3), 162, "none of 162 Gaussians is finite"),
    "all but one strayed": (lambda p: p._replace(means=p.means + 5 * (torch.arange(162) > 0)[:, None]), 162, "none of"),
    "none finite": (lambda p: p._replace(means=NAN * p.means), 162, "none of 162 Gaussians is finite and on the body"),
    "all infinite": (lambda p: p._replace(sh=p.sh + INF), 162, "none of 162 Gaussians is finite and on the body"),
    "few finite": (
        lambda p: p._replace(sh=torch.where((torch.arange(162) > 5)[:, None, None], INF, p.sh)),
        6,
        "none of 162",
    ),
    "all transparent": (lambda p: p._replace(opacities=0 * p.opacities), None, ""),
}


@dataclass
class Heard:
    """What was said of a result."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str, at_once: bool = False) -> None:
        """Kept."""
        self.notes.append(text)

    def warn(self, text: str) -> None:
        """Kept."""
        self.warnings.append(text)

    def begins(self, name: str) -> None:
        """Not looked at."""


@pytest.fixture
def settles(monkeypatch):
    """In three steps: enough to fail."""
    monkeypatch.setattr(settle, "STEPS", 3)


@dataclass
class Fitted:
    """What a result needs of a clip."""

    names: tuple[str, ...]
    body: BodyPoses
    body_model: BodyModel
    hand_shape: np.ndarray | None = None


def fitted(person) -> Fitted:
    names = tuple(f"{i:06d}" for i in range(FRAMES))
    angles = person.global_orient.numpy(), person.body_pose.numpy(), person.transl.numpy()
    return Fitted(names, BodyPoses(names, np.zeros(10), *angles, person.confidence.numpy(), 1.0), FREE)


def finished(fit, clip):
    heard = Heard()
    avatar, poses, counts = results._person(fit, fit.people[0], fitted(clip[1]), heard)
    return avatar, poses, counts, heard.warnings


@pytest.mark.parametrize("how", PEOPLE)
def test_whoever_was_trained_is_kept_and_what_could_not_be_done_is_said(how, clip, settles):
    spoil, left, said = PEOPLE[how]
    fit = fit_of(clip)
    whole, first = fit.people[0].baked()[0], fit.people[0].human.initial()
    made = spoil(whole)
    begun = Canonical(*(part[: len(made.means)] for part in first))
    fit.people[0].baked = lambda: (made, rest(made, fit.people[0].canonical_bones))
    fit.people[0].human.initial = lambda: begun
    avatar, poses, counts, warnings = finished(fit, clip)
    assert all(np.isfinite(part).all() for part in vars(avatar).values() if isinstance(part, np.ndarray))
    assert not impossible(avatar)
    assert avatar.fingers is not None and avatar.face is not None
    assert np.isfinite(poses.body_pose).all()
    if left is None:
        assert not warnings and counts["lining"] + counts["strays"] > 0
    else:
        assert len(warnings) == 1 and holds(warnings[0], "not be finished") and said in warnings[0]
        assert len(avatar) == left and counts["lining"] == 0


@pytest.mark.parametrize("table", ["pose", "place"])
@pytest.mark.parametrize(("value", "frames"), [(NAN, [1]), (INF, TRAIN)])
def test_a_pose_that_is_not_finite_is_that_of_the_fit_and_the_rest_is_as_learned(clip, settles, table, value, frames):
    fit = fit_of(clip, refine_pose=True)
    with torch.no_grad():
        fit.people[0].corrections.pose.weight += 0.01
        getattr(fit.people[0].corrections, table).weight[frames] = value
    avatar, poses, _, warnings = finished(fit, clip)
    assert all(np.isfinite(part).all() for part in vars(avatar).values() if isinstance(part, np.ndarray))
    assert not impossible(avatar)
    lost = sorted({name for i in frames for name in near(i)})
    assert holds(warnings[0], "pose", *lost, "not finite"), warnings
    for mine, theirs in ((poses.global_orient, clip[1].global_orient), (poses.body_pose, clip[1].body_pose)):
        for i, name in enumerate(poses.names):
            moved = np.abs(mine[i] - theirs[i].numpy()).max()
            assert moved == 0 if name in lost else moved == pytest.approx(0.01)


def near(frame: int) -> list[str]:
    """The frame, and that which is held out, where it takes its correction from it."""
    return [f"{i:06d}" for i in ([frame, 2] if frame in (1, 3) else [frame])]


@pytest.mark.parametrize(
    ("what", "error"),
    [
        *itertools.product(["finish"], (ValueError, torch.linalg.LinAlgError, FloatingPointError, MemoryError)),
        *itertools.product(["settle", "fill_hidden"], (IndexError, FloatingPointError)),
        ("fit_swing", torch.linalg.LinAlgError),
    ],
)
def test_what_cannot_be_done_after_training_is_said_and_the_rest_is_kept(clip, settles, monkeypatch, what, error):
    def breaks(*args, **more):
        raise error("no way")

    fit = everything(clip) if what == "fit_swing" else fit_of(clip)
    monkeypatch.setattr(results, what, breaks)
    if what == "fill_hidden":
        heard = Heard()
        assert not results._filled(fit, fit.scene, heard).any()
        warnings = heard.warnings
    else:
        avatar, _, counts, warnings = finished(fit, clip)
        assert not impossible(avatar) and ("strays" in counts) == (what != "finish")
    assert len(warnings) == 1 and warnings[0].endswith("no way")


def test_a_users_model_with_fingers_alone_gives_these_and_the_lack_of_a_face_is_said(clip):
    rig = replace(read_hands_face(FREE), face_points=np.zeros((0, 3)), face_shapes=np.zeros((52, 0, 3)))
    own = replace(fitted(clip[1]), body_model=replace(FREE, name="SMPLX_NEUTRAL", fingers=rig))
    heard = Heard()
    avatar = results._with_gestures(make_avatar(FREE, every=40), own, heard)
    assert avatar.fingers is not None and avatar.face is None and not heard.warnings
    assert (
        len(heard.notes) == 1 and holds(heard.notes[0], "no face", "SMPLX_NEUTRAL") and "finger" not in heard.notes[0]
    )
