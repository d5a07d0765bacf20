"""A frame as a cast draws it: who is before whom, whose shadow falls where, how each moves, and one antialiasing for all."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from stages.avatar.drawing import cast as cast_module
from stages.avatar.drawing.avatar import PosedAvatar
from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import Shadow
from stages.avatar.effects.speeds import Speeds
from stages.avatar.rasterize import Camera
from stages.filming.cameras import cameras_of
from stages.filming.cast import cast
from stages.filming.setting import load_setting
from stages.filming.spec import Film, Person
from tests.made.tiny import HEIGHT, WIDTH, colour_of

NEAR, FAR = 0.8, -1.0  # m ahead of where the person stood, who is 1.5 m before the wall


@pytest.fixture(scope="module")
def stage(tiny):
    run = tiny["train"].parent
    film = Film(
        scene=run, people=[Person(avatar=run, motion="wave", at=(0, z), turn=180 * (z < 0)) for z in (FAR, NEAR)]
    )
    setting = load_setting(film, "cpu")
    people = [cast(person, "a", setting.ground, 30.0, "cpu") for person in film.people]
    return setting, people, cameras_of("still", 1, 30.0, None, setting, people)[0]


def at(scene, shadow, people, shading=None):
    with torch.no_grad():
        return Cast(people, scene, FrameEffects(shadow, shading=shading), mutual=True).at(0)


def picture(setting, people, camera, shadow=None):
    image, _ = at(setting.splats, shadow, people).picture(camera)
    return np.rint(image.clip(0, 1) * 255)


def lamp(*way):
    """A light from the direction `way` [3], of 0.6 of all."""
    return Shadow(torch.tensor(way), 0.6, 0.05, 1.0, 1.0).requires_grad_(False)


def test_who_is_nearer_is_before_the_other_in_whatever_order_they_are_named(stage):
    """The far one shows their back, blue; the near one their front, red, and is the larger."""
    setting, (far, near), camera = stage
    both = picture(setting, [far, near], camera)
    np.testing.assert_allclose(picture(setting, [near, far], camera), both, atol=1)
    alone = picture(setting, [near], camera)
    covered = colour_of(alone) >= 0
    assert (np.abs(both - alone).max(-1)[covered] <= 2).mean() > 0.93, "but for the outline"
    assert (colour_of(picture(setting, [far], camera)) == 1).sum() > 100


def test_a_person_behind_the_wall_is_not_seen(tiny, stage):
    setting, _, camera = stage
    run = tiny["train"].parent
    hidden = cast(Person(avatar=run, motion="wave", at=(0, -2.5)), "a", setting.ground, 30.0, "cpu")
    empty, _ = at(setting.splats, None, [hidden]).picture(camera)
    assert (colour_of(np.rint(empty.clip(0, 1) * 255)) >= 0).sum() == 0 and empty.shape == (HEIGHT, WIDTH, 3)


def test_each_casts_a_shadow_and_two_are_darker_than_one_but_never_darker_than_the_light_is_strong(stage):
    setting, (far, near), _ = stage
    shadow = lamp(0.0, 0.0, -1.0)
    plain = setting.splats.sh[:, 0] * 0.2820948 + 0.5

    def light(people):
        lit = shadow(setting.splats, [one.casters(0) for one in people]).sh[:, 0] * 0.2820948 + 0.5
        return (lit / plain).mean(1)

    one, other, both = light([far]), light([near]), light([far, near])
    assert one.min() < 0.8 and other.min() < 0.8 and one.max() == 1
    assert (both <= torch.minimum(one, other) + 1e-5).all() and both.min() >= 0.4 - 1e-5
    depth = [-torch.log(1 - (1 - share) / 0.6 + 1e-9) for share in (one, other, both)]
    thin = both > 0.45
    torch.testing.assert_close(depth[2][thin], (depth[0] + depth[1])[thin], atol=2e-3, rtol=1e-3)
    assert shadow(setting.splats, []) is setting.splats


def test_a_person_darkens_whoever_is_behind_them_and_not_themselves(stage):
    """The lamp is ahead, where the near one stands; z of the world falls that way."""
    setting, (far, near), _ = stage
    plain = [one.sh for one in at(setting.splats, None, [far, near]).sets]
    lit = [one.sh for one in at(setting.splats, lamp(0.0, 0.0, -1.0), [far, near]).sets]
    falls = [((new - old) * 0.2820948)[:, 0].mean(1) for old, new in zip(plain, lit, strict=True)]
    assert falls[0].min() < -0.2 and falls[0].max() < 1e-6, "behind"
    assert falls[1].abs().max() < 0.02 and falls[2].min() < -0.2
    (alone, _) = at(setting.splats, lamp(0.0, 0.0, -1.0), [far]).sets
    assert alone.sh is far.baked.resting.sh, "off changes no bit"


def test_people_stand_in_the_light_of_the_film_and_the_scene_keeps_its_own(stage):
    setting, people, _ = stage
    shading = Shading(torch.linspace(-0.6, 0.6, 24).view(8, 3)).requires_grad_(False)
    plain, lit = (at(setting.splats, None, people, light).sets for light in (None, shading))
    for before, after in zip(plain[:-1], lit[:-1], strict=True):
        wanted = shading.light(normalize(before.normals, dim=1)) * (0.5 + 0.2820948 * before.sh[:, 0])
        torch.testing.assert_close(0.5 + 0.2820948 * after.sh[:, 0], wanted)
        assert (wanted - 0.5 - 0.2820948 * before.sh[:, 0]).abs().max() > 0.05
    assert lit[-1].sh is plain[-1].sh


@pytest.mark.parametrize("flag", [True, False])
def test_antialiasing_is_the_scenes_for_all(stage, flag):
    setting, people, camera = stage
    pictures = []
    for own in (True, False):
        mine = [replace(one, baked=one.baked._replace(antialias=own)) for one in people]
        pictures.append(at(setting.splats._replace(antialias=flag), None, mine).picture(camera)[0])
    assert np.array_equal(*pictures)


def test_there_is_no_first_person(stage):
    """Swapped, the same picture, and the gradient of each person's colours."""
    setting, people, camera = stage
    found = []
    for order in ((0, 1), (1, 0)):
        moment = at(setting.splats, lamp(0.0, 0.0, -1.0), [people[k] for k in order])
        leaves = [one.sh.clone().requires_grad_() for one in moment.people]
        lit = [one._replace(sh=sh) for one, sh in zip(moment.people, leaves, strict=True)]
        image = moment._replace(people=lit).draw(camera)[0].image
        image.square().mean().backward()
        found.append([image.detach(), *(leaves[order.index(k)].grad for k in (0, 1))])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)
    assert found[0][1].abs().max() > 1e-6 < found[0][2].abs().max()


def test_people_move_each_at_their_own_speed_and_who_is_not_known_stands(stage):
    setting, people, _ = stage
    views = np.tile(np.eye(4), (3, 1, 1))
    speeds = Speeds(views, torch.eye(3).expand(3, 3, 3), 9, np.arange(3))
    moment = Cast(people, setting.splats, FrameEffects(shutter=0.5), speeds).at(1)
    assert moment.speeds == [None, None] and moment.motion.height == 9
    walks = PosedAvatar.of(people[0].baked, np.zeros((3, 3)), np.zeros((3, 69)), np.arange(9.0).reshape(3, 3))
    moment = Cast([people[0], walks], setting.splats, FrameEffects(shutter=0.5), speeds).at(1)
    torch.testing.assert_close(moment.speeds[1], torch.full_like(moment.people[1].means, 3.0))
    blurred = moment.draw(Camera(torch.eye(4), 50 * torch.eye(3), 9, 9))
    assert blurred[0].image.isfinite().all()


def test_a_frame_is_drawn_in_one_place():
    """Outside `rasterize/` one function calls it, and `Moment.draw` alone is what others call; in stages and `hugs/` alike."""
    calls: dict[str, set[str]] = {}
    root = Path(cast_module.__file__).parents[3]
    for path in sorted([*(root / "stages").rglob("*.py"), *(root / "hugs").rglob("*.py")]):
        if "rasterize" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
                if name in ("rasterize", "draw_together") or (name == "draw" and owner.endswith("effects")):
                    calls.setdefault(name, set()).add(str(path.relative_to(root)))
    assert calls == {
        "rasterize": {"stages/avatar/splats/compose.py"},
        "draw_together": {"stages/avatar/effects/frames.py"},
        "draw": {"stages/avatar/drawing/cast.py"},
    }
