"""Effects of the synthetic clip: each changes what it is about, by as much as it says, and nothing else."""

import hashlib
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from stages.avatar.cameras import lens
from stages.avatar.cameras.pinhole import camera_centers, pinhole
from stages.formats.body_model import read_body_model
from stages.synthetic import person
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import ClipEffects, Course, gains, open_times, readout_times, to_linear, to_srgb
from tests.made.synthetic.passers import make_passers
from tests.made.worlds import unproject

WIDTH, HEIGHT, FRAMES = 90, 120, 5
AS_BEFORE = "c1315ebb4ed884f43a57dd9f56baa6f9d9f7296d6da8dffd6167bfc78ac2bcb6"
"""SHA-256 of pictures and masks of a clip made before there were effects."""


@pytest.fixture(scope="module")
def setting():
    """A stage without effects, and where camera and person go."""
    room, rng = synthetic.room_of(3)
    stage = synthetic.Renderer(read_body_model(), room, np.zeros(10), pinhole(114.0, WIDTH, HEIGHT))
    viewmats = synthetic.camera_path(FRAMES, 5.0, "moving", rng)
    return stage, viewmats, *person.make_motion(FRAMES, 5.0, rng)


@pytest.fixture(scope="module")
def shown(setting):
    """Views with the effects that are named."""
    known = {}

    def show(passers=(), gain=None, **strengths):
        key = (len(passers), gain is None, *strengths.items())
        if key not in known:
            stage, *rest = setting
            stage = replace(stage, effects=ClipEffects(**strengths))
            known[key] = stage.views(*rest, WIDTH, HEIGHT, lambda n: None, passers, gain)
        return known[key]

    return show


@pytest.mark.slow
def test_without_effects_the_bytes_are_those_of_before_there_were_any():
    clip = synthetic.make_clip(read_body_model(), seed=3, width=48, height=64, frames=3)
    found = hashlib.sha256()
    for views in (clip.frames, clip.novel):
        found.update(views.images.tobytes() + views.masks.tobytes())
    assert found.hexdigest() == AS_BEFORE


def test_what_belongs_to_a_recording_is_left_out_of_novel_views():
    every = ClipEffects(*[0.1 * (i + 1) for i in range(len(fields(ClipEffects)))])
    kept = {field.name for field in fields(ClipEffects) if getattr(every.scene_only(), field.name)}
    assert kept == {"view_dependence", "shadow", "shading", "clothing", "sky", "antialias"}


def test_gains_have_the_spread_that_was_asked_for():
    found = np.log(gains(ClipEffects(exposure=0.1), 40, np.random.default_rng(0)))
    assert found.mean(1).std() == pytest.approx(0.1, rel=1e-9) and abs(found.mean()) < 1e-12
    assert 0.005 < (found - found.mean(1, keepdims=True)).std() < 0.05, "and a little drift of the colours"


def test_gains_scale_the_pictures(shown):
    factor = np.array([0.8, 0.9, 0.7])
    darker = shown(gain=np.tile(factor, (FRAMES, 1))).images.astype(float)
    assert np.abs(darker - shown().images * factor).max() <= 1.0


def test_gloss_brightens_the_room_and_moves_with_the_view(shown):
    plain, glossy = shown(), shown(view_dependence=0.3)
    added = glossy.images.astype(float) - plain.images
    assert added.min() >= 0 and added.max() > 30
    assert (added[plain.masks == 255] == 0).all(), "the person stays dull"


def test_a_lens_moves_every_pixel_as_the_model_says(shown, setting):
    k, K = -0.1, setting[0].K
    plain, bent = (v.images[0].astype(float) for v in (shown(), shown(lens=k)))
    at = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1) + 0.5
    ideal = lens.undistort((at - K[:2, 2]) / K[0, 0], k) * K[0, 0] + K[:2, 2]
    inside = ((ideal > 1) & (ideal < [WIDTH - 1, HEIGHT - 1])).all(-1)
    x, y = np.moveaxis(ideal - 0.5, -1, 0)
    wanted = np.stack([map_coordinates(plain[..., c], [y, x], order=1) for c in range(3)], -1)
    off = np.abs(bent - wanted)[inside].mean()
    assert np.abs(bent - plain)[inside].mean() > 2 * off and off < 4


def test_a_rolling_shutter_reads_each_row_at_its_own_time(shown, setting):
    stage, viewmats, orient, pose = setting
    rolled = replace(stage, effects=ClipEffects(rolling_shutter=0.8))
    _, vertices, _ = person.pose_body(stage.body, stage.betas, orient, pose)
    course, fine, size = Course(viewmats, vertices), stage.K, (WIDTH, HEIGHT)
    picture, _ = rolled.draw(course, 2, fine, *size, 0, ())
    times = readout_times(rolled.effects, HEIGHT)
    for row in (3, 40, 60, 100):
        then, _ = stage.draw(course, 2 + times[row], fine, *size, 0, ())
        same = np.abs(picture[row] - then[row]).max(-1) < 0.02
        assert same.mean() > 0.9, "but where the person's outline moves between rows"
    middle, _ = stage.draw(course, 2, fine, *size, 0, ())
    assert np.abs(picture - middle)[[3, 100]].mean() > 5 * np.abs(picture - middle)[[59, 60]].mean()


@pytest.mark.slow
def test_blur_is_the_mean_of_moments_in_linear_light(shown, setting):
    effects = ClipEffects(motion_blur=0.9)
    times = open_times(effects)
    assert abs(times.mean()) < 1e-12 and np.ptp(times) == pytest.approx(0.8)
    plain, blurred = shown(), shown(motion_blur=0.9)
    sharp = [np.abs(np.diff(views.images.astype(float), axis=2)).mean() for views in (plain, blurred)]
    assert sharp[1] < 0.8 * sharp[0]
    light = [to_linear(views.images / 255).mean() for views in (plain, blurred)]
    assert light[1] == pytest.approx(light[0], rel=0.01)
    assert ((blurred.masks > 20) & (blurred.masks < 235)).sum() > 1.5 * ((plain.masks > 20) & (plain.masks < 235)).sum()
    values = np.linspace(0, 1, 50)
    assert to_srgb(to_linear(values)) == pytest.approx(values, abs=1e-7)


def test_a_shadow_falls_on_the_floor_begins_at_the_feet_and_spares_the_person(shown):
    plain, shaded = shown(), shown(shadow=0.6)
    for i in range(FRAMES):
        background = plain.masks[i] == 0
        ratio = (shaded.images[i].astype(float).sum(-1) + 3) / (plain.images[i].astype(float).sum(-1) + 3)
        assert (shaded.images[i] == plain.images[i])[plain.masks[i] == 255].all()
        assert ratio.max() <= 1 and 0.12 < ratio[background].min() < 0.45
        rows, columns = np.nonzero(background & (ratio < 0.7))
        places = unproject(np.stack([columns, rows], 1) + 0.5, plain.depths[i][rows, columns].astype(float),
                           plain.viewmats[i], plain.Ks[i])  # fmt: skip
        assert np.abs(places[:, 1]).max() < 0.1 and len(places) > 20, "on the floor"
        feet = plain.joints[i, [7, 8, 10, 11]]
        lowest = feet[feet[:, 1].argmin()]
        assert np.linalg.norm((places - lowest)[:, [0, 2]], axis=1).min() < 0.12, "it touches the foot that stands"
        assert np.linalg.norm(places[:, [0, 2]], axis=1).max() < 1.7, "no longer than the raised arms reach"


def test_clothes_stand_off_the_body_more_in_some_poses_than_in_others(shown):
    plain, dressed = shown(), shown(clothing=0.1)
    grown = dressed.masks.sum((1, 2), dtype=float) / plain.masks.sum((1, 2), dtype=float)
    assert (grown > 1.03).all() and np.ptp(grown) > 0.02
    assert np.array_equal(plain.joints, dressed.joints)


def test_the_sky_is_infinitely_far_and_stays_where_it_is_when_the_camera_moves(shown, setting):
    plain, outside = shown(), shown(sky=1.0)
    far = np.isinf(outside.depths)
    assert 0.2 < far.mean() < 0.7 and not np.isinf(plain.depths).any()
    changed = (plain.images != outside.images).any(-1)
    assert (far & changed).sum() > 0.98 * far.sum() and (changed & ~far).mean() < 0.05, "soft edges alone"


def test_strangers_cross_behind_the_person_and_leave_the_truth_alone(shown):
    passers = make_passers(2, FRAMES, np.random.default_rng(5))
    plain, busy = shown(), shown(passers)
    changed = (plain.images != busy.images).any(-1)
    assert 0.01 < changed.mean() < 0.2 and changed.any((1, 2)).sum() >= 2
    assert not changed[plain.masks == 255].any()
    assert np.array_equal(plain.masks, busy.masks) and np.array_equal(plain.depths, busy.depths)


def test_the_camera_comes_nearer_by_the_ratio_that_was_asked_for():
    for ratio in (1.5, 2.5):
        path = synthetic.camera_path(31, 6, "moving", np.random.default_rng(0), ratio)
        away = np.linalg.norm(camera_centers(path)[:, [0, 2]], axis=1)
        assert away.max() / away.min() == pytest.approx(ratio, rel=0.08) and away.max() < 3.4


def test_strangers_are_gone_before_and_after_their_walk():
    """Their way ends behind the walls; farther on they would come behind the camera, which nothing can be drawn of."""
    passer = make_passers(1, 40, np.random.default_rng(0))[0]
    walk = [t for t in range(-40, 80) if passer.inside(t)]
    assert 26 <= len(walk) <= 29 and walk == list(range(walk[0], walk[-1] + 1))
    assert all(np.abs(passer.at(t)[:, 0]).max() < 4 for t in walk)


def test_the_camera_moves_turns_or_stands_as_asked():
    paths = {
        motion: synthetic.camera_path(30, 6, motion, np.random.default_rng(0))
        for motion in ("moving", "rotating", "static")
    }
    extent = {motion: np.ptp(camera_centers(path), axis=0).max() for motion, path in paths.items()}
    assert extent["moving"] > 1.2
    assert extent["rotating"] < 1e-12 and extent["static"] == 0
    turned = Rotation.from_matrix(paths["rotating"][:, :3, :3])
    assert np.degrees((turned[0].inv() * turned[-1]).magnitude()) > 10
    assert np.ptp(paths["static"], axis=0).max() == 0
