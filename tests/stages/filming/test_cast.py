"""People on the floor of a film: where they stand, which pose a picture shows, their size and colours."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import PosedAvatar
from stages.contract import StageError
from stages.filming.cast import cast, in_colour, moved
from stages.filming.spec import Person
from stages.formats.body_model import read_body_model
from stages.formats.ground import read_ground
from stages.formats.hands_face import read_hands_face
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar, write_splats
from stages.gestures import FACE_NAMES
from stages.records import Ground
from tests.made.said import holds

FPS, JAW = 30.0, FACE_NAMES.index("jawOpen")
LEAN = Rotation.from_euler("xyz", [170, 20, -11], degrees=True)  # a floor that no axis of its world is square to
SLOPE = Ground(
    np.array([0.3, -2.0, 5.0]), LEAN.apply([0, 1, 0]), LEAN.apply([0, 0, 1]), 1.0, 0.01, 0.01, 9, "a floor elsewhere"
)


@pytest.fixture(scope="module")
def run(tiny):
    return tiny["train"].parent


def heights(actor, ground, pictures):
    """Of the lowest sole over the floor in each picture, m."""
    rows = [actor.row(picture) for picture in pictures]
    points, _ = actor.soles.at(actor.global_orient[rows], actor.body_pose[rows], actor.transl[rows])
    points = actor.place + actor.scale * (points - actor.place)
    return ((points - ground.point) @ ground.up).min(1)


@pytest.mark.parametrize("at", [(0.0, 0.0), (2.0, -2.2), (-1.0, 2.8)])
@pytest.mark.parametrize("motion", ["clip", "walk_in_place"])
def test_soles_are_on_another_floor_wherever_they_stand_on_it(run, at, motion):
    actor = cast(Person(avatar=run, motion=motion, at=at, turn=77, scale=1.3), "a", SLOPE, FPS, "cpu")
    low = heights(actor, SLOPE, range(len(actor.transl)))
    assert np.abs(low).max() < 0.02
    first = actor.joints([0])[0, 0]
    left, ahead = ((first - SLOPE.point) @ SLOPE.turn)[[0, 2]]
    start = np.array(at) + (0.05 if motion == "clip" else 0)
    np.testing.assert_allclose([left, ahead], start, atol=0.15)


def test_people_look_ahead_or_where_they_are_turned(run):
    for turn, way in ((0, [0, 0, 1]), (90, [1, 0, 0]), (-30, [-0.5, 0, np.sqrt(0.75)])):
        actor = cast(Person(avatar=run, motion="wave", turn=turn), "a", SLOPE, FPS, "cpu")
        looks = Rotation.from_rotvec(actor.global_orient[0]).apply([0, 0, 1])
        assert looks @ (SLOPE.turn @ way) > 0.99


def test_in_their_own_scene_people_do_what_they_did_there(tiny, run):
    """With their feet put on the floor, which is at most a few millimetres."""
    body, ground = read_poses(tiny["train"] / "body.npz"), read_ground(tiny["smpl"] / "ground.json")
    actor = cast(Person(avatar=run), "a", ground, 10.0, "cpu")
    assert len(actor.transl) == 7, "nobody is seen in the last frame"
    _, joints = actor.soles.at(body.global_orient[:7], body.body_pose[:7], body.transl[:7])
    away = actor.joints(range(7)) - joints
    assert np.abs(away - np.median(away, (0, 1))).max() < 0.02 and np.abs(away).max() < 0.04


def test_a_motion_begins_ends_loops_and_goes_at_its_speed(run):
    def rows(**more):
        actor = cast(Person(avatar=run, motion="squats", **more), "a", SLOPE, FPS, "cpu")
        return len(actor.transl), [actor.row(picture) for picture in (0, 30, 119, 130)]

    assert rows() == (120, [0, 30, 119, 119])
    assert rows(start=1.0) == (120, [0, 0, 89, 100])
    assert rows(start=-0.5) == (120, [15, 45, 119, 119])
    assert rows(start=-0.5, loop=True) == (120, [15, 45, 14, 25])
    assert rows(speed=2.0) == (60, [0, 30, 59, 59])


def test_a_made_motion_that_is_over_at_once_is_refused(run):
    with pytest.raises(StageError, match="wave is over") as refused:
        cast(Person(avatar=run, motion="wave", speed=100), "a", SLOPE, FPS, "cpu")
    assert (
        len(refused.value.facts) == 1
        and holds(refused.value.facts[0], "4 s", 100, 30)
        and "speed" in refused.value.hint
    )


def test_size_is_about_the_place_and_colours_are_multiplied(run):
    plain = cast(Person(avatar=run, motion="wave", at=(1, 1)), "a", SLOPE, FPS, "cpu")
    giant = cast(Person(avatar=run, motion="wave", at=(1, 1), scale=2), "a", SLOPE, FPS, "cpu")
    one, two = (torch.as_tensor(actor.splats(9).means).double().numpy() for actor in (plain, giant))
    np.testing.assert_allclose(two - plain.place, 2 * (one - plain.place), atol=1e-5)
    np.testing.assert_allclose(giant.splats(9).axes, 2 * plain.splats(9).axes, atol=1e-6)
    (small, thin), (large, thick) = ([part.double().numpy() for part in actor.casters(9)] for actor in (plain, giant))
    np.testing.assert_allclose(large - plain.place, 2 * (small - plain.place), atol=1e-5)
    np.testing.assert_allclose(thick, 4 * thin, atol=1e-7)
    gain = np.array([0.5, 1.0, 1.4])
    eye = torch.zeros(3)
    coloured = in_colour(plain, gain).splats(9).colors(eye)
    np.testing.assert_allclose(coloured, plain.splats(9).colors(eye) * torch.as_tensor(gain).float(), atol=1e-5)


def test_what_casts_the_shadow_is_the_body_or_where_that_is_not_known_the_gaussians(tiny, run, tmp_path):
    own = cast(Person(avatar=run, motion="wave"), "a", SLOPE, FPS, "cpu")
    alone = cast(Person(avatar=run / "train" / "avatar.npz", motion="wave"), "a", SLOPE, FPS, "cpu")
    assert alone.model is not None
    np.testing.assert_allclose(alone.baked.casters.middles, own.baked.casters.middles, atol=1e-6)
    avatar = read_avatar(tiny["train"] / "avatar.npz")
    write_splats(tmp_path / "other.npz", replace(avatar, joints=avatar.joints * [1.1, 1, 1]))
    other = cast(Person(avatar=tmp_path / "other.npz", motion="wave"), "a", SLOPE, FPS, "cpu")
    assert other.model is None
    limb = own.baked.casters.covariances.diagonal(dim1=1, dim2=2).sum(1) > 1e-4
    held = replace(avatar, joints=avatar.joints * [1.1, 1, 1], casters=(np.ones((24, 3)), np.zeros((24, 3, 3))))
    write_splats(tmp_path / "held.npz", held)
    told = cast(Person(avatar=tmp_path / "held.npz", motion="wave"), "a", SLOPE, FPS, "cpu")
    assert (told.baked.casters.middles == 1).all(), "as the file has it"
    assert (other.baked.casters.middles - own.baked.casters.middles)[limb].norm(dim=1).median() < 0.05
    half = np.arange(len(avatar)) % 2 == 0
    for opacity, seen in ((0.2, False), (0.5, True)):  # a haze of half the Gaussians, a metre away
        means, opacities = avatar.means + half[:, None], np.where(half, opacity, 0.9)
        hazy = replace(avatar, joints=avatar.joints * [1.1, 1, 1], means=means, opacities=opacities)
        write_splats(tmp_path / "hazy.npz", hazy)
        hazy = cast(Person(avatar=tmp_path / "hazy.npz", motion="wave"), "a", SLOPE, FPS, "cpu")
        away = (hazy.baked.casters.middles - other.baked.casters.middles)[limb].norm(dim=1)
        assert (away.median() > 0.3) == seen and (seen or away.median() < 0.1)


def test_a_file_has_no_clip_to_move_as_in(run):
    with pytest.raises(StageError, match="no clip") as refused:
        cast(Person(avatar=run / "train" / "avatar.npz"), "a", SLOPE, FPS, "cpu")
    assert "motion: moves.bvh" in refused.value.hint


def test_all_of_a_person_is_where_it_is_drawn(run):
    actor = cast(Person(avatar=run, motion="wave"), "a", SLOPE, FPS, "meta")
    assert {part.device.type for part in (*actor.casters(0), *actor.splats(0)[:4])} == {"meta"}


def test_a_motion_begins_with_the_picture_nearest_to_its_start_and_a_loop_was_going_on_before(run):
    once, loop = (
        cast(Person(avatar=run, motion="squats", start=0.29, loop=loop), "a", SLOPE, FPS, "cpu")
        for loop in (False, True)
    )
    count = len(once.transl)
    assert once.first == loop.first == 9, "of 0.29 s at 30 a second"
    assert [once.row(picture) for picture in (0, 8, 9, 10, 9 + count)] == [0, 0, 0, 1, count - 1]
    assert [loop.row(picture) for picture in (0, 8, 9, 10, 9 + count)] == [count - 9, count - 1, 0, 1, 0]


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_all_of_somebody_who_is_moved_moves(run, scale):
    actor, way = (
        cast(Person(avatar=run, motion="wave", scale=scale), "a", SLOPE, FPS, "cpu"),
        np.array([0.3, -1.0, 2.0]),
    )
    there = moved(actor, way)
    np.testing.assert_allclose(there.joints([0, 9]) - actor.joints([0, 9]), np.tile(way, (2, 24, 1)), atol=1e-6)
    for one, other in ((actor.splats(9).means, there.splats(9).means), (actor.casters(9)[0], there.casters(9)[0])):
        np.testing.assert_allclose(other - one, np.tile(way, (len(one), 1)), atol=1e-5)


def test_fingers_and_a_face_move_as_made_or_captured(tiny, tmp_path):
    """A made motion moves both; of a capture each picture shows what it has at its time, at the motion's speed."""
    body = read_body_model()
    record = attach(read_avatar(tiny["train"] / "avatar.npz"), body, read_hands_face(body))
    write_splats(tmp_path / "avatar.npz", record)
    rows = "".join(f"{second},{value}\n" for second, value in enumerate([0, 0, 1, 1, 1]))
    (tmp_path / "take.csv").write_text(f"time,jawOpen\n{rows}")
    made = Person(avatar=tmp_path / "avatar.npz", motion="count_to_five")
    told, bare = (cast(one, "a", SLOPE, FPS, "cpu") for one in (made, made.model_copy(update={"motion": "wave"})))
    assert told.placed.hands is not None and told.placed.face is not None and bare.placed.hands is None
    fingers, jaw = record.fingers.rows, record.face.rows[np.abs(record.face.moves[JAW]).max(1) > 0.01]
    quiet = PosedAvatar.of(told.baked, told.global_orient, told.body_pose, told.transl)
    way = (told.splats(60).means - quiet.splats(60).means).norm(dim=1)
    assert way[fingers].max() > 0.02 and way.median() < 1e-6
    captured = made.model_copy(update={"motion": "wave", "face": tmp_path / "take.csv", "speed": 2.0})
    actor = cast(captured, "a", SLOPE, FPS, "cpu")
    opened = [float((actor.splats(i).means - bare.splats(2 * i).means).norm(dim=1)[jaw].max()) for i in (10, 45)]
    assert opened[0] < 1e-3 < 0.005 < opened[1] and any("take.csv" in fact for fact in actor.facts)


def test_a_jaw_of_an_smplx_motion_opens_the_avatars_mouth(tiny, tmp_path):
    body = read_body_model()
    record = attach(read_avatar(tiny["train"] / "avatar.npz"), body, read_hands_face(body))
    write_splats(tmp_path / "avatar.npz", record)
    poses = np.zeros((40, 165))
    poses[20:, 66] = np.radians(22)
    np.savez(tmp_path / "m.npz", poses=poses, trans=np.zeros((40, 3)), fps=FPS, expression=np.ones((40, 10)))
    actor = cast(Person(avatar=tmp_path / "avatar.npz", motion=str(tmp_path / "m.npz")), "a", SLOPE, FPS, "cpu")
    jaw = record.face.rows[np.abs(record.face.moves[JAW]).max(1) > 0.01]
    way = (actor.splats(30).means - actor.splats(5).means)[jaw]
    assert way.norm(dim=1).max() > 0.005 and holds(actor.facts[0], "jaw and eyes", "10 expressions left out")


def test_an_avatar_without_a_face_counts_to_five_and_the_lack_is_named(tiny, tmp_path):
    body = read_body_model()
    record = attach(read_avatar(tiny["train"] / "avatar.npz"), body, read_hands_face(body))
    write_splats(tmp_path / "avatar.npz", replace(record, face=None))
    actor = cast(Person(avatar=tmp_path / "avatar.npz", motion="count_to_five"), "a", SLOPE, FPS, "cpu")
    quiet = PosedAvatar.of(actor.baked, actor.global_orient, actor.body_pose, actor.transl)
    assert (actor.splats(60).means - quiet.splats(60).means).norm(dim=1).max() > 0.02
    assert holds(" ".join(actor.facts), "count_to_five", "no face") and "no fingers" not in " ".join(actor.facts)


def test_a_face_that_does_not_move_is_refused(run, tmp_path):
    with pytest.raises(StageError, match="no face"):
        cast(Person(avatar=run, motion="wave", face=tmp_path / "take.csv"), "a", SLOPE, FPS, "cpu")
