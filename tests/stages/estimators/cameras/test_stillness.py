"""A camera that stands still before a crowd, and those that do not."""

import numpy as np
import pytest

from stages.estimators.cameras.stillness import Stillness, measure_stillness
from stages.formats.images import write_image, write_mask
from tests.made.rooms import HEIGHT, WIDTH, photograph, texture, walk


def spectators(image: np.ndarray, share: float, frame: int) -> None:
    """Cover the upper `share` of a picture with patches that sway, each in its own way."""
    cloth, size = texture(5), 20
    rng = np.random.default_rng(0)
    for y in range(0, round(share * HEIGHT), size):
        for x in range(0, WIDTH, size):
            u, v, fast, phase = rng.uniform(0.5, 2.5, 4)
            sway = 9 * np.sin(fast * frame + 2 * phase), 7 * np.sin(v * frame + u)
            left, top = (int(300 * phase + sway[0]), int(300 * u + sway[1]))
            below = min(size, HEIGHT - y)
            image[y : y + below, x : x + size] = cloth[top : top + below, left : left + size]


def measured(folder, views, share: float = 0.0) -> Stillness | None:
    for kind in ("images", "ignored"):
        (folder / kind).mkdir()
    files = [f"{i:02d}.png" for i in range(len(views))]
    drawn: dict[bytes, np.ndarray] = {}
    for i, (file, view) in enumerate(zip(files, views)):
        if view.tobytes() not in drawn:
            drawn[view.tobytes()] = photograph(view)
        image = drawn[view.tobytes()].copy()
        spectators(image, share, i)
        write_image(folder / "images" / file, image)
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[100:, 140:190] = 0
        write_mask(folder / "ignored" / file, mask)
    return measure_stillness(folder / "images", folder / "ignored", files)


FRAMES = 8
STANDING = np.tile(np.eye(4), (FRAMES, 1, 1))


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_a_standing_camera_stands_whatever_sways_behind_the_person(tmp_path, share):
    found = measured(tmp_path, STANDING, share)
    assert found.still and found.drift_px < 0.3 and found.stays < 1.05 - share


@pytest.mark.slow
@pytest.mark.parametrize(("views", "share"), [
    (walk(FRAMES, 0.2), 0.5), (walk(FRAMES, 0.0, turn=2.0), 0.0), (walk(FRAMES, 0.1, turn=0.0), 0.0),
])  # fmt: skip
def test_a_camera_that_travels_or_turns_does_not(tmp_path, views, share):
    assert not measured(tmp_path, views, share).still


def test_what_stays_far_away_while_the_rest_slides_past_is_a_moving_camera():
    assert not Stillness(stays=0.4, cells=0.5, one_way=0.95, drift_px=0.1).still
    assert Stillness(stays=0.4, cells=0.5, one_way=0.2, drift_px=0.1).still
    assert not Stillness(stays=0.12, cells=0.06, one_way=0.0, drift_px=0.0).still, "a sign burnt into the picture"


def test_blank_frames_say_nothing(tmp_path):
    for kind in ("images", "ignored"):
        (tmp_path / kind).mkdir()
    for file in ("a.png", "b.png"):
        write_image(tmp_path / "images" / file, np.full((60, 80, 3), 90, np.uint8))
        write_mask(tmp_path / "ignored" / file, np.full((60, 80), 255, np.uint8))
    assert measure_stillness(tmp_path / "images", tmp_path / "ignored", ["a.png", "b.png"]) is None
