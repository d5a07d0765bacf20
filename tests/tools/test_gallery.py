"""Sheets of the gallery: wide pictures are cut, the best and worst frames are those of the person."""

import numpy as np

from tests.tools.gallery import GAP, HEIGHT, MOST, PLACE, WIDTH, beside, ends, panel, sheet


def test_panels_are_of_one_height_and_rows_are_padded_with_white():
    wide, tall = panel(np.zeros((360, 640, 3), np.uint8)), panel(np.zeros((864, 480, 3), np.uint8))
    assert wide.shape == (HEIGHT, WIDTH, 3) and tall.shape == (HEIGHT, round(480 * HEIGHT / 864), 3)
    drawn = sheet([beside([wide, tall]), beside([tall])])
    assert drawn.shape == (2 * HEIGHT + GAP, WIDTH + GAP + tall.shape[1], 3)
    assert (drawn[HEIGHT + GAP :, tall.shape[1] :] == 255).all() and not drawn[:HEIGHT, :WIDTH].any()


def test_best_and_worst_are_of_the_frames_that_are_shown():
    rows = [{"name": name, "person_crop": {"lpips": lpips}} for name, lpips in zip("abcd", (0.3, 0.1, 0.2, None))]
    metrics = {"heldout": {"person_crop": {"lpips": 0.2}}, "per_frame": {"heldout": rows}}
    assert ends(metrics, set("acd")) == [("c", 0.2), ("a", 0.3)]


def test_the_gallery_is_small():
    assert sum(path.stat().st_size for path in PLACE.glob("*.webp")) < MOST
