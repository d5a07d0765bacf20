"""A face is learned where it is large, seen and the body has one that moves; drawn heads, and what hides them."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import look_at, pinhole, project
from stages.estimators.detectors import face
from stages.estimators.detectors.evidence import FRAMES, ClipEvidence
from stages.estimators.person.crops import Roi
from stages.formats.body_model import read_body_model
from stages.formats.clip import Clip
from stages.formats.hands_face import read_hands_face
from stages.records import BodyPoses, Cameras
from stages.synthetic.clip import FOCAL
from stages.synthetic.room import make_room
from tests.made.gestures import ARC, views
from tests.made.hidden import BARE, HIDING, Face
from tests.made.networks import fetched
from tests.made.smplx import made_smplx
from tests.made.synthetic.clip import Renderer

SIZE = 320, 384
DRAWN = 6
KITCHEN = {
    20: Roi(267, 184, 67, 0.01),
    30: Roi(266, 233, 63, -0.02),
    40: Roi(262, 290, 59, 0.01),
    70: Roi(264, 240, 59, -0.01),
    80: Roi(250, 205, 60, -0.03),
    90: Roi(238, 187, 62, -0.04),
    130: Roi(210, 214, 63, -0.05),
    140: Roi(233, 240, 62, -0.02),
    180: Roi(312, 164, 80, 0.1),
    190: Roi(303, 147, 82, 0.17),
}
"""Where the phone clip's man has his face, as `smpl` fitted him."""


@dataclass(frozen=True)
class Pictured(Clip):
    """A clip whose pictures lie in no folder, and the frames that were read."""

    pictures: tuple[np.ndarray, ...] = ()
    read: list[int] = field(default_factory=list)

    def images(self, i: int) -> np.ndarray:
        self.read.append(i)
        return self.pictures[i % len(self.pictures)]


def pictured(viewmats, K, orient, pictures, transl=(0, 0, 0), model=None, size=(480, 864)) -> ClipEvidence:
    """The free body in T-pose as cameras [F,4,4] see it, turned by `orient` [F,3] rad."""
    count, names = len(viewmats), tuple(map(str, range(len(viewmats))))
    where = np.tile(np.asarray(transl, float), (count, 1))
    poses = BodyPoses(names, np.zeros(10), orient, np.zeros((count, 69)), where, np.ones(count))
    cameras, nothing = Cameras(names, viewmats, np.tile(K, (count, 1, 1)), *size), np.zeros((0, 3))
    clip = Pictured(
        Path(), cameras, viewmats, nothing, nothing, poses, model or read_body_model(), pictures=tuple(pictures)
    )
    return ClipEvidence(clip, SimpleNamespace(verdict="moving"))


def head_on(away: float, turned: float = 0.0, frames: int = 8, model=None, pictures=()) -> ClipEvidence:
    """The free body seen from `away` m, its face turned aside by so many rad."""
    orient = np.tile(Rotation.from_euler("y", turned).as_rotvec(), (frames, 1))
    eye = np.array([0.0, 0.3, away])
    viewmats = np.tile(look_at(eye, np.array([0.0, 0.3, 0.0]), np.array([0.0, 1.0, 0.0])), (frames, 1, 1))
    return pictured(viewmats, pinhole(800, 480, 864), orient, pictures, model=model)


def faces(clip: Clip) -> list[Face]:
    """Where the fitted face is in each picture."""
    placed, heads = face.faces_of(clip, read_hands_face(clip.body_model))
    high = np.einsum("fnj,fj->fn", placed - placed.mean(1, keepdims=True), heads[:, :, 1])[0]
    pixels = project(placed, clip.viewmats, clip.Ks)[0]
    return [Face(xy, (high - high.min()) / np.ptp(high)) for xy in pixels]


def covered(evidence: ClipEvidence, hide) -> ClipEvidence:
    """The same clip with each picture changed."""
    clip = evidence.clip
    pictures = tuple(hide(picture, where) for picture, where in zip(clip.pictures, faces(clip)))
    return replace(evidence, clip=replace(clip, pictures=pictures, read=[]))


@pytest.fixture(scope="module")
def drawn():
    """The free body's head, 62 px high, drawn from 26 degrees left to 26 right."""
    model, K = read_body_model(), pinhole(FOCAL * SIZE[1], *SIZE)
    renderer = Renderer(model, make_room(np.random.default_rng(2)), np.zeros(10), K)
    viewmats, still = views("near", np.linspace(-ARC, ARC, DRAWN), np.zeros((DRAWN, 6))), np.zeros((DRAWN, 3))
    shot = renderer.views(viewmats, still, np.zeros((DRAWN, 69)), *SIZE, lambda done: None)
    return pictured(viewmats, K, still, shot.images, shot.transl[0], size=SIZE)


@pytest.mark.parametrize("away", [3.7, 1.3])
def test_only_a_large_face_is_looked_at_by_the_network(away, monkeypatch):
    asked = []

    class Network:
        def presence(self, image, where):
            asked.append(where)
            return 0.51

    monkeypatch.setattr(face, "FaceNetwork", Network)
    evidence = head_on(away, frames=2 * FRAMES, pictures=[np.zeros((864, 480, 3), np.uint8)])
    found, far = face.detect(evidence), away == 3.7
    assert found.called_for is not far and found.unit == face.UNIT
    assert found.value == pytest.approx(800 * 0.18 / (away - 0.1), rel=0.1), "a face is about 18 cm high"
    assert len(asked) == len(evidence.clip.read) == (0 if far else FRAMES)
    assert far or evidence.clip.read[-1] == 2 * FRAMES - 1, "from the first to the last"


def test_a_face_is_not_learned_where_it_is_turned_away_or_the_body_has_none(monkeypatch):
    monkeypatch.setattr(face, "FaceNetwork", None)
    for turned in (1.2, 2.0):
        aside = face.detect(head_on(1.3, turned))
        assert aside.value is None and "fewer than 5" in aside.verdict
    bare = face.detect(head_on(1.3, model=replace(read_body_model(), name="another")))
    assert bare.value is None and "no face" in bare.verdict


def test_a_face_of_jaw_and_eyes_alone_is_nearly_as_high(tmp_path):
    arrays = made_smplx()
    np.savez(tmp_path / "SMPLX.npz", **arrays | {"shapedirs": arrays["shapedirs"][..., :16]})
    high = [np.ptp(face.faces_of(clip, read_hands_face(clip.body_model))[0][0, :, 1])
            for clip in (head_on(1.3, model=model).clip for model in (None, read_body_model(tmp_path / "SMPLX.npz")))]  # fmt: skip
    assert high[1] == pytest.approx(high[0], rel=0.25)


def test_a_face_that_is_given_is_on_and_no_network_is_asked(monkeypatch):
    monkeypatch.setattr(face, "FaceNetwork", None)
    evidence = head_on(1.3)
    body = replace(evidence.clip.body, face=np.zeros((8, 52)))
    found = face.detect(replace(evidence, clip=replace(evidence.clip, body=body)))
    assert found.called_for and "--face" in found.verdict


@pytest.mark.parametrize(("sure", "on"), [(4, True), (3, False), (0, False)])
def test_half_of_the_frames_must_show_the_face(sure, on, monkeypatch):
    said = iter([0.4] * (8 - sure) + [0.6] * sure)
    monkeypatch.setattr(face, "FaceNetwork", lambda: SimpleNamespace(presence=lambda image, where: next(said)))
    found = face.detect(head_on(1.3, pictures=[np.zeros((864, 480, 3), np.uint8)]))
    assert found.called_for is on
    if not on:
        assert (found.value, found.threshold, found.verdict) == (sure / 8, 0.5, "hidden or blurred")
        assert found.frames == ("0", "1", "2"), "those that show it least"


def test_without_the_network_nothing_is_known_and_what_to_run_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    found = face.detect(head_on(1.3))
    assert found.value is None and not found.called_for
    assert all(
        part in found.verdict for part in ("face_landmark", "hugs doctor --fetch", "hugs run VIDEO survey --force")
    )
    assert face.detect(head_on(3.7)).verdict == "too small", "which takes no network"


@pytest.mark.parametrize("degrees", [0, 40, -170])
def test_the_crop_is_the_faces_and_turned_as_the_head_is_in_the_picture(degrees, monkeypatch):
    asked = []
    network = SimpleNamespace(presence=lambda image, where: asked.append(where) or 1.0)
    monkeypatch.setattr(face, "FaceNetwork", lambda: network)
    evidence = head_on(1.3, pictures=[np.zeros((864, 480, 3), np.uint8)])
    clip, turn = evidence.clip, np.eye(4)
    turn[:2, :2] = [[np.cos(np.radians(degrees)), -np.sin(np.radians(degrees))],
                    [np.sin(np.radians(degrees)), np.cos(np.radians(degrees))]]  # fmt: skip
    rolled = replace(clip, viewmats=turn @ clip.viewmats, cameras=replace(clip.cameras, viewmats=turn @ clip.viewmats))
    face.detect(replace(evidence, clip=rolled))
    xy, roi = faces(rolled)[0].xy, asked[0]
    assert np.degrees(roi.angle) % 360 == pytest.approx(degrees % 360, abs=2)
    assert roi.side == pytest.approx(np.ptp(faces(clip)[0].xy[:, 1]), rel=0.02)
    assert np.abs(xy.mean(0) - [roi.x, roi.y]).max() < 0.15 * roi.side


@pytest.mark.slow
@pytest.mark.parametrize("what", BARE)
def test_a_drawn_head_is_seen_also_with_glasses_softly_and_in_little_light(drawn, what):
    fetched("face_landmark.tflite")
    found = face.detect(covered(drawn, BARE[what]))
    assert found.called_for and found.value == pytest.approx(62, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("what", HIDING)
def test_what_hides_a_face_switches_it_off(drawn, what):
    fetched("face_landmark.tflite")
    found = face.detect(covered(drawn, HIDING[what]))
    assert not found.called_for and found.verdict == "hidden or blurred" and found.value < 0.5


@pytest.mark.slow
def test_the_kitchen_man_whose_mask_hides_his_face_has_none_that_is_learned(kitchen):
    """His pictures moved so that his face is where that of the fitted head is."""
    fetched("face_landmark.tflite")
    evidence = head_on(2.2, frames=len(KITCHEN))
    xy = faces(evidence.clip)[0].xy
    there = np.vstack([Roi.fitting(xy, 0.0).matrix(), [0, 0, 1]])
    pictures = [
        cv2.warpAffine(kitchen[i], (there @ np.linalg.inv(np.vstack([roi.matrix(), [0, 0, 1]])))[:2], (480, 864))
        for i, roi in KITCHEN.items()
    ]
    found = face.detect(replace(evidence, clip=replace(evidence.clip, pictures=tuple(pictures))))
    assert not found.called_for and found.verdict == "hidden or blurred" and found.value == 0
