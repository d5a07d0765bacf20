"""The person's outline from crops: pasted, moved along the body, cleaned and weighted."""

import cv2
import numpy as np

from stages.estimators.person.crops import Roi
from stages.estimators.person.outline import coverage, near_edge, outline, paste, rim_fade, without_islands


def test_a_crop_is_pasted_where_it_was_cut():
    roi = Roi(120, 90, 80, 0.5)
    disc = np.zeros((256, 256), np.float32)
    cv2.circle(disc, (128 + 64, 128), 20, 1, -1)
    whole = paste(disc, roi, (200, 300))
    y, x = np.argwhere(whole > 0.5).mean(0)
    assert np.allclose([x, y], [119.5 + 20 * np.cos(0.5), 89.5 + 20 * np.sin(0.5)], atol=0.5)
    assert abs(whole.sum() - disc.sum() * (80 / 256) ** 2) < 0.03 * whole.sum()


def test_moving_along_the_body_follows_its_turn():
    down = Roi(100, 100, 50, np.pi / 2).reframe(0.5, 0, 0.2)  # up points right, so down is left
    assert np.allclose([down.x, down.y, down.side], [90, 100, 25])


def test_islands_go_and_large_parts_stay():
    mask = np.zeros((100, 100), np.float32)
    mask[10:60, 10:40] = 0.9
    mask[70:90, 60:80] = 0.8  # a foot seen apart
    mask[5:7, 90:92] = 1.0
    kept = without_islands(mask)
    assert kept[80, 70] > 0 and kept[30, 20] > 0 and kept[5:7, 90:92].max() == 0
    assert without_islands(np.zeros((5, 5), np.float32)).max() == 0


def test_doubts_deep_inside_and_haze_far_outside_cover_all_or_nothing():
    mask = np.zeros((200, 160), np.uint8)
    mask[20:180, 50:110] = 255
    mask[60:120, 70:90] = 176  # 70 % sure of the chest
    mask[60:120, 130:150] = 76  # 30 % sure of the wall
    share = coverage(mask)
    assert (share[20:180, 50:110] == 255).all() and (share[:, 111:] == 0).all()
    hole = mask.copy()
    hole[100:110, 75:85] = 20  # between arm and trunk
    assert coverage(hole)[105, 80] == 0


def test_coverage_keeps_the_outline_where_it_is_and_makes_it_steeper():
    ramp = cv2.GaussianBlur(np.pad(np.full((120, 60), 255, np.uint8), 40), (0, 0), 3)
    share = coverage(ramp)
    assert ((share > 127) == (ramp > 127)).all()
    widths = [int(((one[100] > 12) & (one[100] < 243)).sum()) for one in (ramp, share)]
    assert widths[1] < 0.7 * widths[0]
    assert (np.diff(share[100, :70].astype(int)) >= 0).all(), "no step back into the person"


def test_nobody_covers_nothing():
    for faint in (np.zeros((9, 9), np.uint8), np.full((9, 9), 100, np.uint8)):
        assert coverage(faint).max() == 0


def test_weights_are_one_inside_and_zero_outside():
    mask = np.zeros((60, 60), np.float32)
    mask[20:40, 20:40] = 1
    edge = near_edge(mask, 6)
    assert edge[20, 30] == 1 and edge[30, 30] == 0 and edge[10, 30] == 0
    fade = rim_fade()
    assert fade[128, 128] == 1 and fade[0].max() < 0.02 and fade.min() > 0


def test_the_kitchen_man_hides_the_right_pixels(blazepose, kitchen):
    """Points read off the picture by eye: head, chest, hands and shoes are his, what is between is not."""
    image = kitchen[0]
    mask = outline(blazepose, image, blazepose.track([image])[0].next_roi)
    assert mask.shape == image.shape[:2] and mask.dtype == np.float32 and mask.min() >= 0 and mask.max() <= 1
    for x, y in ((240, 125), (235, 260), (192, 440), (288, 430), (206, 650), (281, 650), (205, 540), (275, 540)):
        assert mask[y, x] > 0.9, (x, y)
    for x, y in ((240, 560), (150, 130), (330, 200), (120, 500), (240, 660), (340, 600), (175, 660)):
        assert mask[y, x] < 0.1, (x, y)
