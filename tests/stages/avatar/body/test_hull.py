"""Cloth off the body: a tube around two legs is found where masks show it, and nothing where they show the body alone."""

import numpy as np
import pytest

from stages.avatar.body.hull import CELL, CLEAR, Carved, Sight, Skin, Space, beyond, carve, space_around, surface
from stages.avatar.cameras.pinhole import look_at, pinhole

SIDE = 96
K = pinhole(90.0, SIDE, SIDE)


def column(x: float, radius: float, top: float, bottom: float, count: int = 900) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of an upright cylinder's side."""
    i = np.arange(count)
    angle, height = 2.399963 * i, bottom + (top - bottom) * (i + 0.5) / count
    normals = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    return np.array([x, 0, 0]) + radius * normals + height[:, None] * [0, 1, 0], normals


@pytest.fixture(scope="module")
def legs() -> Skin:
    return two_legs()


def two_legs(apart: float = 0.12) -> Skin:
    """Two upright legs, `apart` m each from the middle."""
    (left, out), (right, outer) = column(apart, 0.07, 0.5, -0.5), column(-apart, 0.07, 0.5, -0.5)
    weights = np.zeros((len(left) + len(right), 24))
    weights[: len(left), 1] = weights[len(left) :, 2] = 1
    return Skin(np.concatenate([left, right]), np.concatenate([out, outer]), weights)


@pytest.fixture(scope="module")
def space(legs) -> Space:
    return space_around(legs)


@pytest.fixture(scope="module")
def skirt(legs, space) -> Carved:
    """What twelve frames from all around tell of a skirt."""
    return carve(space, pictures(legs, 0.3))


def pictures(
    legs: Skin, skirt: float | None, step: float = 0.0, arc: float = 2 * np.pi, apart: float = 0.12, frames: int = 12
) -> list[Sight]:
    """`frames` from an `arc` around; `skirt`: the radius of a tube from 0.2 down to -0.2.

    The left leg steps aside by up to `step`.
    """
    found = []
    for i, turn in enumerate(np.linspace(0, arc, frames, endpoint=False)):
        bones = np.tile(np.eye(4), (24, 1, 1))
        bones[1, 0, 3] = step * (i % 3) / 2
        view = look_at(2.5 * np.array([np.sin(turn), 0.1, np.cos(turn)]), np.zeros(3), np.array([0.0, 1, 0]))
        rays = np.stack(np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5), -1)
        body = covers(view, rays, apart + bones[1, 0, 3], 0.07, 0.5) | covers(view, rays, -apart, 0.07, 0.5)
        worn = body if skirt is None else body | covers(view, rays, bones[1, 0, 3] / 2, skirt, 0.2)
        found.append(Sight(bones, view, K, worn * 1.0, body))
    return found


def covers(view: np.ndarray, pixels: np.ndarray, x: float, radius: float, half: float) -> np.ndarray:
    """Where a camera sees an upright cylinder: its outline from points all over it, closed by their convex hull."""
    import cv2

    places = column(x, radius, half, -half, 400)[0]
    local = places @ view[:3, :3].T + view[:3, 3]
    at = (local[:, :2] / local[:, 2:] * np.diag(K)[:2] + K[:2, 2] - 0.5).astype(np.float32)
    canvas = np.zeros(pixels.shape[:2], np.uint8)
    cv2.fillConvexPoly(canvas, np.rint(cv2.convexHull(at) * 16).astype(np.int32), 1, shift=4)
    return canvas.astype(bool)


def test_weights_spread_from_the_skin_and_are_halves_between_two_legs(legs):
    points = np.array([[0.12, 0, 0.08], [-0.2, 0.1, 0], [0, 0, 0], [0, 0.2, 0.2]])
    weights = legs.spread(points)
    np.testing.assert_allclose(weights.sum(1), 1)
    assert weights[0, 1] > 0.9 and weights[1, 2] > 0.95
    np.testing.assert_allclose(weights[2:, 1:3], 0.5, atol=0.02)


def test_a_skirt_is_found_and_is_one_tube_not_two_legs(legs, space, skirt):
    inside = skirt.cloth
    middle = (np.abs(space.points[:, 1]) < 0.15) & (np.hypot(space.points[:, 0], space.points[:, 2]) < 0.25)
    assert inside[middle & (space.away > CELL) & (np.abs(space.points[:, 2]) > 0.09)].mean() > 0.95
    assert not inside[np.abs(space.points[:, 1]) > 0.3].any()
    cloth = surface(space, legs, skirt, CELL)
    side = np.abs(cloth.points[:, 1]) < 0.12
    radius = np.hypot(cloth.points[side, 0], cloth.points[side, 2])
    assert np.abs(radius - 0.3).max() < 0.04 and np.abs(np.median(radius) - 0.3) < 0.015
    outward = (cloth.normals[side] * cloth.points[side]).sum(1) / radius
    assert outward.min() > 0.8 and (cloth.away > CLEAR).all()
    np.testing.assert_allclose(cloth.weights.sum(1), 1)


def test_a_skirt_that_goes_along_with_both_legs_is_found_while_they_step(legs, space):
    inside = carve(space, pictures(legs, 0.3, step=0.16)).cloth
    front = (np.abs(space.points[:, 0]) < 0.05) & (space.points[:, 2] > 0.1) & (space.points[:, 2] < 0.2)
    assert inside[front & (np.abs(space.points[:, 1]) < 0.15)].all()


def test_few_sides_tell_of_no_cloth_since_outlines_are_as_deep_as_one_likes(legs, space, skirt):
    """A man who is filmed from the front alone had wings to the front and the back."""
    assert not carve(space, pictures(legs, 0.3, arc=np.pi / 2)).cloth.any()
    assert carve(space, pictures(legs, 0.3, arc=np.pi)).cloth.sum() > 0.9 * skirt.cloth.sum()


def test_a_body_alone_has_no_cloth_between_legs_that_step_or_stand(legs, space):
    for step in (0.0, 0.16):
        assert not carve(space, pictures(legs, None, step)).cloth.any()


def test_what_few_frames_show_is_no_cloth(legs, space, skirt):
    assert not carve(space, pictures(legs, 0.3)[:3]).cloth.any()
    rare = [*pictures(legs, 0.3)[:4], *pictures(legs, None)[4:]]
    assert carve(space, rare).cloth.sum() < 0.1 * skirt.cloth.sum()
    within = [sight._replace(viewmat=np.eye(4)) for sight in pictures(legs, 0.3)]
    assert not carve(space, within).cloth[space.points[:, 2] < 0.05].any(), "what is behind the camera is not seen"


def test_finer_points_are_nearer_to_each_other(legs, space, skirt):
    coarse, fine = (surface(space, legs, skirt, spacing) for spacing in (CELL, CELL / 2))
    assert fine.spacing == pytest.approx(CELL / 2, rel=0.02) and 3 < len(fine.points) / len(coarse.points) < 5


def trousers(legs: Skin, off: float, webbed: bool = False, apart: float = 0.12, frames: int = 12) -> list[Sight]:
    """Frames of legs whose masks reach `off` m beyond them, and, if `webbed`, fill what is between the two."""
    found = []
    for sight in pictures(legs, None, apart=apart, frames=frames):
        rays = np.zeros((SIDE, SIDE))
        left, right = (covers(sight.viewmat, rays, x, 0.07 + off, 0.5) for x in (apart, -apart))
        mask = left | right
        if webbed:
            import cv2

            edge = np.argwhere(mask)[:, ::-1].astype(np.int32)
            mask = cv2.fillConvexPoly(mask.astype(np.uint8), cv2.convexHull(edge), 1).astype(bool)
        found.append(sight._replace(mask=mask * 1.0))
    return found


def bagged(legs: Skin, beside: float) -> list[Sight]:
    """Twelve frames of legs with a bag `beside` the left one, m from its middle."""
    bag = (covers(one.viewmat, one.body, 0.12 + beside, 0.06, 0.12) for one in pictures(legs, None))
    return [one._replace(mask=(one.body | more) * 1.0) for one, more in zip(pictures(legs, None), bag)]


def test_trousers_that_stand_no_further_off_than_a_fit_errs_are_no_cloth(legs, space):
    carved = carve(space, trousers(legs, 0.03))
    assert not carved.cloth.any() and not carved.far.any() and carved.volume(space) == 0


def test_wide_trouser_legs_go_with_their_limbs_as_skin_does(monkeypatch):
    apart = two_legs(0.22)
    space, worn = space_around(apart), trousers(apart, 0.07, apart=0.22, frames=16)
    assert not carve(space, worn).cloth.any()
    monkeypatch.setattr("stages.avatar.body.hull.ONE_LIMB", 1.1)
    assert carve(space, worn).far.any(), "else this test says nothing"


def test_a_bag_beside_one_leg_is_found(legs, space):
    carved = carve(space, bagged(legs, 0.15))
    assert carved.volume(space) > 0 and space.points[carved.far, 0].min() > 0.12


@pytest.mark.parametrize("by", [(0.01, 0, 0), (-0.01, 0, 0), (0, 0, 0.01)])
def test_what_is_found_does_not_hang_on_a_centimetre_of_the_fit(legs, space, by):
    """Bodies, not masks, a centimetre off: the bag is always there, trousers never are."""
    moved = np.eye(4)
    moved[:3, 3] = by

    def fitted(sights: list[Sight]) -> list[Sight]:
        return [one._replace(bones=one.bones @ moved) for one in sights]

    assert carve(space, fitted(bagged(legs, 0.15))).volume(space) > 0
    assert carve(space, fitted(trousers(legs, 0.02))).volume(space) == 0


def test_what_never_leaves_the_gap_between_two_limbs_is_no_cloth(legs, space, monkeypatch):
    """Two thighs that no frame separates made a web of cloth, torn by every step."""
    assert not carve(space, trousers(legs, 0.0, webbed=True)).cloth.any()
    monkeypatch.setattr("stages.avatar.body.hull.GAP", 0.0)
    monkeypatch.setattr("stages.avatar.body.hull.FAR", 0.0)
    assert carve(space, trousers(legs, 0.0, webbed=True)).cloth.any(), "else this test says nothing"


def test_gaps_are_closed_and_outlines_grown_by_so_many_pixels():
    body = np.zeros((40, 60), bool)
    body[10:30, 5:15] = body[10:30, 23:33] = True  # a gap of 8 px
    near, far = beyond(body, 5.0, 3.0)
    assert not near[12:28, 15:23].any() and near[5, 19] and near[20, 34] and near[20, 4]
    assert not far[20, 33:36].any() and far[20, 37] and not far[20, 3:5].any() and far[20, 1]
    open_gap, _ = beyond(body, 3.0, 3.0)
    assert open_gap[12:28, 15:23].all() and (open_gap == ~body).all()
    for empty in beyond(np.zeros_like(body), 5.0, 3.0):
        assert empty.all()
    corner = np.zeros_like(body)
    corner[:4, :4] = True
    near, far = beyond(corner, 5.0, 3.0)
    assert not near[:4, :4].any() and not far[:6, :6].any() and far[0, 8]
