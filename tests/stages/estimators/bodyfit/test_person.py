"""The masked person is found among all that a tool saw, whoever comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.contract import StageError
from stages.estimators.bodyfit.person import choose_person, overlaps
from stages.formats.body_model import read_body_model
from stages.formats.given_fits.record import SmplFit, join_fits
from tests.made import bodyfit_clips
from tests.made.said import holds

MODEL = read_body_model()
FRAMES = 6


@pytest.fixture(scope="module")
def clip():
    clip = bodyfit_clips.make(MODEL, frames=FRAMES, betas=(0.0,))
    return clip, clip.masks()


def walk(clip, aside=0.0, rows=range(FRAMES), track="0"):
    """An upright body where the clip's stands, `aside` metres to the right in each camera."""
    views = clip.cameras.viewmats.copy()
    views[:, :3, 3] *= clip.scale
    pelvis = np.einsum("fij,fj->fi", views[:, :3, :3], clip.joints[:, 0]) + views[:, :3, 3]
    rest = MODEL.J_regressor[0] @ MODEL.v_template
    count = len(list(rows))
    turned = np.tile([np.pi, 0, 0], (count, 1))  # camera axes: y down
    fit = SmplFit(
        "f", "ROMP", np.zeros((count, 10)), turned, np.zeros((count, 69)), (pelvis - rest + [aside, 0, 0])[rows]
    )
    return replace(fit, tracks=(track,) * count, numbers=np.array(rows))


def both(*fits):
    fit = join_fits(fits, "f")
    return fit, fit.numbers


def test_the_person_on_the_masks_wins_whatever_the_order(clip):
    clip, masks = clip
    person, stranger = walk(clip, track="b"), walk(clip, aside=1.0, track="a")
    for order in ((person, stranger), (stranger, person)):
        fit, frames, found = choose_person(*both(*order), clip.cameras, masks, MODEL)
        assert found["person"] == "b" and set(fit.tracks) == {"b"} and frames.tolist() == list(range(FRAMES))
        assert found["people"]["b"] > 0.5 > 2 * found["people"]["a"]
        np.testing.assert_array_equal(fit.transl, person.transl)


def test_without_tracks_each_frame_is_chosen_on_its_own(clip):
    clip, masks = clip
    person, stranger = walk(clip, track=""), walk(clip, aside=1.0, track="")
    rows, frames = both(person, stranger)
    order = np.random.default_rng(0).permutation(2 * FRAMES)
    fit, frames, found = choose_person(rows.rows(order), frames[order], clip.cameras, masks, MODEL)
    np.testing.assert_array_equal(fit.transl, person.transl)
    assert found["people"] == {"": found["overlap"]} and found["overlap"] > 0.5


def test_a_long_track_wins_over_a_better_moment(clip):
    clip, masks = clip
    long, short = walk(clip, aside=0.4, track="long"), walk(clip, rows=range(2), track="short")
    _, frames, found = choose_person(*both(short, long), clip.cameras, masks, MODEL)
    assert found["person"] == "long" and found["people"]["short"] > found["people"]["long"] and len(frames) == FRAMES


def test_a_fit_of_somebody_else_is_refused(clip):
    clip, masks = clip
    fit = walk(clip, aside=2.5)
    with pytest.raises(StageError, match="masks") as caught:
        choose_person(fit, fit.numbers, clip.cameras, masks, MODEL)
    assert holds(caught.value.facts[0], "6 frames")


def test_specks_of_a_mask_do_not_count(clip):
    clip, masks = clip
    specked = [mask.copy() for mask in masks]
    for mask in specked:
        mask[:8, :8] = mask[-8:, -8:] = 255
    fit = walk(clip)
    shares = [overlaps(fit, fit.numbers, clip.cameras, m, MODEL) for m in (masks, specked)]
    np.testing.assert_array_equal(*shares)


def test_empty_masks_have_no_say(clip):
    clip, masks = clip
    empty = [masks[0], *(np.zeros_like(m) for m in masks[1:])]
    fit = walk(clip)
    share = overlaps(fit, fit.numbers, clip.cameras, empty, MODEL)
    assert share[0] > 0.5 and np.isnan(share[1:]).all()
    kept, _, found = choose_person(fit, fit.numbers, clip.cameras, [np.zeros_like(m) for m in masks], MODEL)
    assert len(kept) == FRAMES and found["overlap"] is None
