"""The detectors on made evidence: each finds what is there, measures how much, and is quiet about the rest."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import look_at, pinhole, project
from stages.avatar.splats.sh import sh_basis, spread_directions
from stages.estimators.detectors import (
    antialias,
    clothing,
    exposure,
    light,
    motion_blur,
    pose_refinement,
    shading,
    shadow,
    tracks,
)
from stages.estimators.detectors.bundle import adjust_bundle
from stages.estimators.detectors.every import DETECTORS
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.pictures import sample
from stages.formats.body_model import read_body_model
from stages.formats.facts import Distortion, Sfm
from stages.synthetic import person
from tests.made.datasets import points_of
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import ClipEffects
from tests.made.synthetic.passers import make_passers


def gains(frames: int = 30, drift: float = 0.0, step: float = 0.0, hidden: float = 0.4):
    rng = np.random.default_rng(1)
    truth = drift * np.sin(np.linspace(0, 6, frames)) + step * (np.arange(frames) >= frames // 2)
    logs = rng.normal(4.5, 0.4, 400) + truth[:, None] + rng.normal(0, 0.01, (frames, 400))
    logs[rng.random(logs.shape) < 0.1] += 0.7  # a point hidden behind something brighter
    logs[rng.random(logs.shape) < hidden] = np.nan
    return logs, truth - truth.mean()


def test_exposure_gains_survive_hidden_points_and_gaps():
    logs, truth = gains(drift=0.1, step=0.08)
    logs[7] = np.nan
    found = light.robust_gains(logs)
    seen = np.isfinite(found)
    assert not seen[7] and seen.sum() == 29
    assert np.abs(found[seen] - (truth[seen] - truth[seen].mean())).max() < 0.01


def test_steady_exposure_stays_below_the_threshold():
    found = light.robust_gains(gains()[0])
    assert found.std() < exposure.STD / 3 and np.abs(np.diff(found)).max() < exposure.STEP / 3


def test_too_few_points_are_unknown_not_zero():
    assert np.isnan(light.robust_gains(np.full((5, 10), 4.0))).all()
    assert np.isnan(light.robust_gains(np.zeros((5, 0)))).all()


def test_point_colours_leave_out_person_border_and_clipped():
    image = np.full((20, 30, 3), 100, np.uint8)
    image[:, 20:] = 255
    mask = np.zeros((20, 30), np.uint8)
    mask[:, :5] = 255
    pixels = np.array([[12.0, 10], [2, 10], [27, 10], [40, 10], [-3, 5], [12, 10]])
    logs = light.point_logs(image, mask, pixels, np.array([1.0, 1, 1, 1, 1, -1]))
    assert logs[:, 0] == pytest.approx([np.log(100), 0, 0], abs=1e-3) and np.isnan(logs[:, 1:]).all()


@pytest.mark.parametrize(("effects", "verdict"), [({}, "steady"), ({"white_balance": 0.08}, "changes tint")])
def test_a_tint_that_drifts_at_one_brightness_is_seen(effects, verdict):
    frames, rng = 12, np.random.default_rng(0)
    colors = synthetic.gains(ClipEffects(**effects), frames, np.random.default_rng(3))
    grey = np.log(colors @ [0.299, 0.587, 0.114])
    assert np.abs(grey).max() < 0.02, "brightness alone says nothing"
    base = cv2.resize(rng.uniform(60, 150, (12, 16, 3)), (160, 120))
    pictures = [(base * color).clip(0, 255).astype(np.uint8) for color in colors]
    K = pinhole(150.0, 160, 120)
    points = np.stack([*rng.uniform(-0.4, 0.4, (2, 200)), np.full(200, 1.2)], 1)
    clip = SimpleNamespace(
        names=[str(i) for i in range(frames)], points=points, Ks=np.tile(K, (frames, 1, 1)),
        viewmats=np.tile(np.eye(4), (frames, 1, 1)), images=lambda i: pictures[i],
        mask=lambda i: np.zeros((120, 160), np.uint8))  # fmt: skip
    found = exposure.detect(SimpleNamespace(clip=clip, light=light.frame_gains(clip)))
    assert found.verdict == verdict
    if effects:
        assert found.value == pytest.approx(0.1, rel=0.5) and len(found.frames) == 3


# cameras, lens and shutter, from tracks alone


@pytest.fixture(scope="module")
def seen():
    """Cameras that go around random points with a shaking hand: viewmats, Ks, points and their true pixels."""
    rng = np.random.default_rng(0)
    frames, K = 24, pinhole(300.0, 240, 320)
    points = rng.uniform([-2, -1.5, -2], [2, 1.5, 2], (300, 3))
    views = []
    for i, angle in enumerate(np.linspace(-0.4, 0.4, frames)):
        eye = [5 * np.sin(angle), 0.05 * np.sin(1.9 * i), 5 * np.cos(angle)]
        target = np.array([0.08 * np.sin(1.3 * i), 0.06 * np.sin(2.3 * i + 1), 0])
        views.append(look_at(np.array(eye), target, np.array([0, 1.0, 0])))
    viewmats, Ks = np.stack(views), np.tile(K, (frames, 1, 1))
    pixels = np.stack([project(points, view, K)[0] for view in viewmats])
    pixels[rng.random(pixels.shape[:2]) < 0.3] = np.nan
    return viewmats, Ks, points, pixels


def told(pixels, viewmats, Ks):
    """What the bundle says of noisy `pixels`."""
    pixels = pixels + np.random.default_rng(1).normal(0, 0.1, pixels.shape)
    points, angles = tracks.triangulate(pixels, viewmats, Ks)
    there = tracks.project_with_slopes(points, viewmats, Ks)[0]
    return adjust_bundle(tracks.Tracks(pixels, points, pixels - there, angles), viewmats, Ks, 320)


def test_points_are_placed_where_they_are_and_too_few_views_place_none(seen):
    viewmats, Ks, points, pixels = seen
    few = pixels.copy()
    few[5:, 0] = np.nan
    found, angles = tracks.triangulate(few, viewmats, Ks)
    assert np.isnan(found[0]).all()
    assert np.abs(found[1:] - points[1:]).max() < 1e-6
    assert (angles[1:] > 0.2).all()


def test_true_cameras_leave_nothing(seen):
    viewmats, Ks, _, pixels = seen
    left = told(pixels, viewmats, Ks)
    assert abs(left.readout) < 0.02 and abs(left.k) < 0.003 and np.median(left.mended_px) < 0.1


def test_points_behind_a_camera_that_does_not_see_them_do_no_harm(seen):
    viewmats, Ks, _, pixels = seen
    viewmats, pixels = viewmats.copy(), pixels.copy()
    viewmats[-1, :3, :3] = np.diag([-1, 1, -1]) @ viewmats[-1, :3, :3]
    viewmats[-1, :3, 3] = np.diag([-1, 1, -1]) @ viewmats[-1, :3, 3]
    pixels[-1] = np.nan
    left = told(pixels, viewmats, Ks)
    assert abs(left.readout) < 0.02 and np.isfinite([*left.mended_px, *left.speed_px, left.k, left.readout_std]).all()


def test_i09_a_readout_time_is_found_and_blamed_on_nothing_else(seen):
    viewmats, Ks, _, pixels = seen
    speed = np.gradient(np.nan_to_num(np.stack([project(seen[2], v, k)[0] for v, k in zip(viewmats, Ks)])), axis=0)
    rolled = pixels + 0.4 * speed * (pixels[..., 1:] / 320 - 0.5)
    left = told(rolled, viewmats, Ks)
    assert left.readout == pytest.approx(0.4, abs=0.03) and left.readout_std < 0.02 and abs(left.k) < 0.005


def test_a_lens_is_found_and_blamed_on_nothing_else(seen):
    viewmats, Ks, _, pixels = seen
    u = (pixels - Ks[:, None, :2, 2]) / 300
    left = told(pixels + 300 * -0.05 * u * (u**2).sum(-1, keepdims=True), viewmats, Ks)
    assert left.k == pytest.approx(-0.05, abs=0.006) and abs(left.readout) < 0.03


def test_wrong_cameras_are_found_and_blamed_on_nothing_else(seen):
    viewmats, Ks, _, pixels = seen
    turn = np.tile(np.eye(4), (24, 1, 1))
    turn[:, :3, :3] = Rotation.from_rotvec(np.random.default_rng(2).normal(0, 0.006, (24, 3))).as_matrix()
    left = told(pixels, turn @ viewmats, Ks)
    assert np.median(left.mended_px) > 1.2 and abs(left.readout) < 0.05 and abs(left.k) < 0.01


def test_too_few_points_are_unknown(seen):
    viewmats, Ks, _, pixels = seen
    assert told(pixels[:, :30], viewmats, Ks) is None
    evidence = SimpleNamespace(residuals=None, facts=Sfm(verdict="moving", distortion=Distortion(max_shift_px=0.0)))
    for name in ("lens", "rolling_shutter", "camera_refinement"):
        found = DETECTORS[name](evidence)
        assert found.value is None and not found.called_for and found.verdict.startswith("unknown")


def test_a_lens_that_sfm_took_out_is_told_with_its_shift():
    pixels = np.full((5, 2, 2), 120.0)
    pixels[1], pixels[2, 0], pixels[4, 1] = np.nan, 2.0, 30.0
    clip = SimpleNamespace(Ks=pinhole(300.0, 240, 320)[None], names=tuple("abcde"))
    points = tracks.Tracks(pixels, np.zeros((2, 3)), np.zeros_like(pixels), np.ones(2))
    facts = Sfm(verdict="moving", distortion=Distortion(max_shift_px=4.7))
    found = DETECTORS["lens"](SimpleNamespace(residuals=None, facts=facts, clip=clip, tracks=points))
    assert found.called_for and found.value == 4.7 and "sfm" in found.verdict
    assert found.frames == ("a", "c", "e"), "with points near the corners, not the one that shows none"


# pictures


@pytest.mark.parametrize("length", [1, 5, 9])
def test_the_length_of_a_blur_is_measured_along_the_motion(length):
    rng = np.random.default_rng(0)
    coarse = cv2.resize(rng.choice([40, 200], (24, 32)).astype(np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
    blurred = cv2.blur(cv2.GaussianBlur(coarse, (0, 0), 0.7), (length, 1))
    places = rng.uniform(20, 220, (60, 2))
    image, allowed = np.repeat(blurred[..., None], 3, -1), np.ones((240, 320), bool)
    found = motion_blur.blur_length(image, allowed, places, np.tile([6.0, 0.2], (60, 1)))
    across = motion_blur.blur_length(image, allowed, places, np.tile([0.2, 6.0], (60, 1)))
    assert found == pytest.approx(length if length > 1 else 0, abs=1.0) and across < 0.5


def test_of_two_lamps_that_explain_about_as_much_the_higher_one_is_taken():
    low, middle = np.radians([60, 36])
    assert shadow._cost(-0.21, middle) < shadow._cost(-0.23, low) < 0
    assert shadow._cost(-0.5, low) < shadow._cost(-0.3, 0.0), "the sun of an evening"


def test_a_shadow_is_told_from_a_pattern_and_from_noise():
    rng = np.random.default_rng(0)
    shaded = rng.random((20, 500)) < 0.3
    pattern = rng.normal(4, 1, 500)
    light = pattern - 0.5 * shaded + rng.normal(0, 0.05, (20, 500))
    light[rng.random(light.shape) < 0.3] = np.nan
    likeness, slope, _ = shadow._correlate(light, shaded)
    assert slope == pytest.approx(-0.5, abs=0.01) and likeness < -0.9
    likeness, slope, _ = shadow._correlate(light, rng.random((20, 500)) < 0.3)
    assert abs(slope) < 0.05 and abs(likeness) < 0.1


def test_light_is_told_from_a_pattern_and_patterns_that_shift_tell_no_light():
    rng, turns = np.random.default_rng(0), Rotation.random(20, random_state=0).as_matrix()
    faced = np.einsum("fij,pj->fpi", turns, spread_directions(300).numpy())
    basis = sh_basis(torch.as_tensor(faced), 2)[..., 1:].numpy()
    lamp, pattern = rng.normal(0, 0.3, 8), rng.normal(4, 1, 300)
    hidden = rng.random((20, 300)) < 0.5
    lit = np.where(hidden, np.nan, pattern + basis @ lamp + rng.normal(0, 0.1, (20, 300)))
    assert np.abs(shading.light_of(lit, basis) - lamp).max() < 0.06  # measured: 0.012
    assert shading._likeness(lit, basis @ lamp) > 0.8
    shifted = np.where(hidden, np.nan, pattern + rng.normal(0, 0.3, (20, 300)))
    assert np.abs(shading.light_of(shifted, basis)).max() < 0.15
    first = np.arange(20) < 10
    told = shading.light_of(shifted[first], basis[first])
    assert abs(shading._likeness(shifted[~first], basis[~first] @ told)) < shading.LIKENESS / 2


def ball_in_light(gains, confidence, side=160, focal=150.0):
    """A ball 3 m before a camera that turns under a lamp, another hidden behind it, before a white wall."""
    ball, count = trimesh.creation.icosphere(3, 1.0), len(gains)
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    turns = Rotation.random(count, random_state=1).as_matrix()
    bodies = np.stack([np.concatenate([0.5 * points, 0.3 * points + [0, 0, 2]]) @ np.eye(3) for _ in turns])
    bodies[:, : len(points)] = 0.5 * points @ turns.mT
    bodies += [0, 0, 3.0]
    at = (np.mgrid[:side, :side][::-1] + 0.5 - side / 2) / focal
    rays = np.moveaxis(np.concatenate([at, np.ones_like(at[:1])]), 0, -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays[..., 2] * 3
    inside = along**2 - 9 + 0.25
    disc = inside > 0
    normals = ((along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays - [0, 0, 3.0]) / 0.5
    lit = np.where(disc, 60 * np.exp(0.5 * normals[..., 0]), 255)
    pictures = [np.repeat(np.rint(lit * np.where(disc, np.exp(g), 1))[..., None], 3, 2).astype(np.uint8) for g in gains]
    clip = SimpleNamespace(
        names=[str(i) for i in range(count)],
        body_model=SimpleNamespace(faces=np.concatenate([faces, faces + len(points)])),
        viewmats=np.tile(np.eye(4), (count, 1, 1)),
        Ks=np.tile([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]], (count, 1, 1)),
        width=side,
        height=side,
        mask=lambda i: (disc & (np.arange(side) < 90)).astype(np.uint8) * 255,
        images=pictures.__getitem__,
        body=SimpleNamespace(confidence=np.array(confidence)),
    )
    return SimpleNamespace(clip=clip, sampled=list(range(count)), bodies=bodies, gains=np.array(gains)), len(points)


def test_light_is_read_where_a_place_is_seen_and_faces_the_camera_gains_taken_off():
    gains, confidence = [0.0, 0.4, -0.4, 0.2, -0.2, 0.3], [1.0, 1, 1, 0, 1, 1]
    evidence, near = ball_in_light(gains, confidence)
    logs, normals = shading._places(evidence)
    seen, own = np.isfinite(logs), (np.arange(0, 2 * near, shading.EVERY) < near)[None].repeat(6, 0)
    rays = evidence.bodies[:, :: shading.EVERY]
    facing = -(normals * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
    column = rays[..., 0] / rays[..., 2] * 150 + 80
    assert not seen[3].any() and not seen[~own].any(), "a pose that is none, and what is behind"
    assert not seen[facing < shading.FACING].any() and not seen[column > 88].any(), "nor what the mask ends at"
    there = own & (facing > 0.5) & (column < 86) & (np.arange(6) != 3)[:, None]
    assert there.sum() > 100 and seen[there].all()
    off = logs - np.log(60) - 0.5 * normals[..., 0]
    assert np.abs(off[there & (facing > 0.75)]).max() < 0.08, "gains are taken off"


def test_half_of_the_frames_tell_the_light_and_the_others_are_asked(monkeypatch):
    evidence, _ = ball_in_light(np.zeros(32), np.ones(32))
    found, told, asked = shading.detect(evidence), [], []
    assert found.called_for and found.value > 2 * shading.CHANGE
    keep_light, keep_likeness = shading.light_of, shading._likeness
    monkeypatch.setattr(shading, "light_of", lambda logs, basis: told.append(logs) or keep_light(logs, basis))
    monkeypatch.setattr(shading, "_likeness", lambda logs, light: asked.append(logs) or keep_likeness(logs, light))
    shading.detect(evidence)
    for one, other in zip(told[:2], asked, strict=True):
        rows = [np.nan_to_num(row).tobytes() for half in (one, other) for row in half]
        assert len(set(rows)) == len(rows) == 32


def test_patterns_that_poses_shift_pull_little_at_the_light():
    rng, turns = np.random.default_rng(0), Rotation.random(20, random_state=0).as_matrix()
    faced = np.einsum("fij,pj->fpi", turns, spread_directions(300).numpy())
    basis = sh_basis(torch.as_tensor(faced), 2)[..., 1:].numpy()
    lamp = rng.normal(0, 0.1, 8)
    logs = basis @ lamp + np.where((rng.random((20, 300)) < 0.15) & (basis[..., 1] > 0.2), 2.0, 0.0)
    plain = np.linalg.lstsq(basis.reshape(-1, 8), (logs - logs.mean(0)).ravel(), rcond=None)[0]
    assert np.abs(shading.light_of(logs, basis) - lamp).max() < 0.4 * np.abs(plain - lamp).max()


def test_sampling_counts_from_the_first_pixels_centre():
    ramp = np.add.outer(10 * np.arange(5.0), np.arange(6.0)).astype(np.float32)
    assert sample(ramp, np.array([[0.5, 0.5], [2.0, 3.5], [5.5, 4.5]])) == pytest.approx([0, 31.5, 45])


# pairs: a clip with the effect, and the same without


@pytest.fixture(scope="module")
def filmed():
    """The evidence of a small clip with the effects that are named."""
    (room, rng), (width, height, frames) = synthetic.room_of(21), (150, 200, 14)
    stage = synthetic.Renderer(read_body_model(), room, np.zeros(10), pinhole(0.95 * height, width, height))
    viewmats = synthetic.camera_path(2 * frames, 12.0, "moving", rng)[:frames]
    orient, pose = person.make_motion(frames, 7.0, rng)
    known = {}

    def film(passers=(), **strengths):
        key = (len(passers), *strengths.items())
        if key not in known:
            drawn = replace(stage, effects=ClipEffects(**strengths))
            views = drawn.views(viewmats, orient, pose, width, height, lambda n: None, passers)
            points = []
            for i, x, y in points_of(views, 600):
                z = views.depths[i, y, x]
                local = np.linalg.inv(views.Ks[i]) @ [(x + 0.5) * z, (y + 0.5) * z, z]
                points.append(views.viewmats[i, :3, :3].T @ (local - views.viewmats[i, :3, 3]))
            body = SimpleNamespace(betas=np.zeros(10), global_orient=orient, body_pose=pose, transl=views.transl,
                                   confidence=np.ones(frames), face=None)  # fmt: skip
            clip = SimpleNamespace(
                names=tuple(f"{i:06d}" for i in range(frames)), width=width, height=height, viewmats=viewmats, Ks=views.Ks,
                points=np.array(points), body=body, body_model=stage.model,
                images=lambda i: views.images[i], mask=lambda i: views.masks[i],
            )  # fmt: skip
            known[key] = ClipEvidence(clip, Sfm(verdict="moving", distortion=Distortion(max_shift_px=0.0)))
        return known[key]

    return film


@pytest.mark.slow
@pytest.mark.parametrize("name", DETECTORS)
def test_a_clip_without_effects_calls_for_none(filmed, name):
    found = DETECTORS[name](filmed())
    assert not found.called_for and found.value is not None, found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "strength"),
    [("shadow", 0.6), ("shading", 1.6), ("sky", 1.0), ("clothing", 0.1), ("view_dependence", 0.4), ("transients", 0)],
)
def test_a_clip_with_the_effect_calls_for_it(filmed, name, strength):
    passers = make_passers(2, 14, np.random.default_rng(4)) if name == "transients" else ()
    found = DETECTORS[name](filmed(passers, **{name: strength}))
    assert found.called_for and found.confidence > 0 and found.frames, found
    if name == "shadow":
        *lamp, darkness = found.start
        assert np.dot(lamp, synthetic.LIGHT) > np.cos(np.radians(12)) and darkness == found.value


@pytest.mark.slow
def test_frames_in_which_nobody_is_yet_do_not_hide_a_shadow(filmed):
    """Their bodies are filled in: held as in the first frame that shows somebody."""
    before, brush = 8, np.ones((5, 5), np.uint8)
    evidence, plain = filmed(shadow=0.6), filmed()

    def late(evidence):
        clip, room = evidence.clip, plain.clip

        def images(i):
            if i >= before:
                return clip.images(i)
            person = cv2.dilate(room.mask(i), brush) > 0
            return cv2.inpaint(room.images(i), person.astype(np.uint8), 3, cv2.INPAINT_TELEA)

        held = {name: np.array(value) for name, value in vars(clip.body).items()}
        for name in ("global_orient", "body_pose", "transl"):
            held[name][:before] = held[name][before]
        held["confidence"][:before] = 0
        more = {"images": images, "mask": lambda i: clip.mask(i) * (i >= before), "body": SimpleNamespace(**held)}
        return ClipEvidence(SimpleNamespace(**vars(clip) | more), evidence.facts)

    assert not shadow.detect(late(plain)).called_for
    found = shadow.detect(late(evidence))
    assert found.called_for and found.value > 0.7 * shadow.detect(evidence).value, found
    assert np.dot(found.start[:3], synthetic.LIGHT) > np.cos(np.radians(12))


def test_arms_3_degrees_off_call_for_refined_poses_and_true_ones_do_not_however_small_the_person(filmed):
    evidence = filmed()
    assert pose_refinement.detect(evidence).value == 0, "in 150x200 px edges alone are 3 % of the person"
    body = evidence.clip.body
    turned = body.body_pose.copy()
    turned[:, [3 * 15 + 2, 3 * 16 + 2]] += 0.05
    known = vars(evidence.clip) | {"body": SimpleNamespace(**vars(body) | {"body_pose": turned})}
    found = pose_refinement.detect(ClipEvidence(SimpleNamespace(**known), evidence.facts))
    assert found.called_for and found.value == pytest.approx(0.01, rel=0.5), found


def test_an_edge_known_to_a_pixel_is_no_error_of_a_pose():
    mask = np.zeros((40, 60), bool)
    mask[10:30, 10:50] = True
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0
    assert pose_refinement.share_apart(mask, grown) == pose_refinement.share_apart(grown, mask) == 0
    grown[10:30, 51:54] = True
    assert (
        pose_refinement.share_apart(mask, grown)
        == pose_refinement.share_apart(grown, mask)
        == pytest.approx(60 / grown.sum())
    )
    nothing = np.zeros_like(mask)
    assert pose_refinement.share_apart(nothing, nothing) == 0 and pose_refinement.share_apart(mask, nothing) == 1


def outlined(frames=10, wide=0):
    """Evidence of masks that are `wide` px wider than the body; the fit does not trust the last pose."""
    drawn = np.zeros((40, 40), bool)
    drawn[10:30, 15:25] = True
    mask = cv2.dilate(drawn.astype(np.uint8) * 255, np.ones((1, 2 * wide + 1)))
    names, still = tuple(map(str, range(frames))), np.zeros((frames, 3))
    body = SimpleNamespace(confidence=np.arange(frames)[::-1], global_orient=still, body_pose=np.zeros((frames, 69)))
    body.transl = np.arange(3.0 * frames).reshape(frames, 3)
    clip = SimpleNamespace(names=names, mask=lambda i: mask, body=body, viewmats=np.zeros((frames, 4, 4)), Ks=still)
    return SimpleNamespace(clip=clip, sampled=range(frames), outlines=[drawn] * frames)


def test_masks_that_hardly_leave_the_body_show_no_cloth_and_are_not_looked_into():
    found = clothing.detect(outlined(10))
    assert found.value == 0 and not found.called_for and len(found.frames) == 3
    assert clothing.detect(outlined(8)).value is None, "seven frames that the fit trusts are too few"


def test_cloth_is_carved_from_the_frames_whose_poses_are_trusted_where_the_body_stands():
    evidence = outlined(4, wide=3)
    joints, parents = torch.rand(24, 3, dtype=torch.float64), [-1, *range(23)]
    sights = list(clothing._sights(evidence, joints, parents))
    assert len(sights) == 3
    for sight, place in zip(sights, evidence.clip.body.transl):
        expected = np.tile(np.eye(4), (24, 1, 1))
        expected[:, :3, 3] = place
        np.testing.assert_allclose(sight.bones, expected, atol=1e-9)
        assert sight.mask.sum() > sight.body.sum()


@pytest.mark.slow
def test_poses_of_ours_that_err_look_like_no_cloth(filmed):
    evidence = filmed()
    body, rng = evidence.clip.body, np.random.default_rng(0)
    off = {"body_pose": body.body_pose + rng.normal(0, 0.06, body.body_pose.shape)}
    known = vars(evidence.clip) | {"body": SimpleNamespace(**vars(body) | off)}
    erring = clothing.detect(replace(evidence, clip=SimpleNamespace(**known)))
    assert not erring.called_for and erring.value == 0, erring


@pytest.mark.parametrize(("farthest", "verdict"), [(2.4, "one size"), (6.0, "sizes differ")])
def test_somebody_who_walks_away_from_a_camera_that_stands_still_changes_size(farthest, verdict):
    frames, rng = 12, np.random.default_rng(0)
    away = np.linspace(2.0, farthest, frames)
    room = np.stack([*rng.uniform(-2, 2, (2, 100)), np.full(100, 8.0)], 1)
    body = rng.normal(0, 0.2, (50, 3))
    clip = SimpleNamespace(
        names=[str(i) for i in range(frames)], points=room, Ks=np.tile(pinhole(150.0, 160, 120), (frames, 1, 1)),
        viewmats=np.tile(np.eye(4), (frames, 1, 1)), width=160, height=120)  # fmt: skip
    bodies = body - body.mean(0) + away[:, None, None] * [0, 0, 1]
    found = antialias.detect(SimpleNamespace(clip=clip, bodies=bodies, sampled=list(range(frames))))
    assert found.verdict == verdict and found.value == pytest.approx(farthest / 2, rel=1e-6)
    assert found.frames == ("0", "1", "2")
