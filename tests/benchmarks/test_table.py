"""The table of the benchmarks: rows of two commits never meet, and documents say what it says."""

import copy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.benchmarks import page, table
from tests.made.held_out import Shot, Stance, before_standing_camera

SCORES = {"psnr": 29.2046, "ssim": 0.93381, "lpips": 0.07965}
NOTHING = dict.fromkeys(SCORES)
ROW = {
    "minutes": 17.55,
    "gib": 1.447,
    "heldout": {"full": SCORES, "person_crop": SCORES | {"psnr": 26.79}, "person_white": SCORES},
}
STANDS = ROW | {
    "heldout": {"full": NOTHING, "person_crop": NOTHING, "person_white": SCORES},
    "held_back": {"poses": {"person_white": SCORES | {"psnr": 19.24}}},
}
ABOUT = {
    "commit": "abc",
    "machine": {"cores": 2, "processor": "P", "python": "3", "torch": "2", "numba": "1", "numpy": "2"},
    "seed": 0,
}
MADE = ABOUT | {"rows": {"kitchen": {"preview": ROW | {"minutes": 2.0}, "default": ROW}, "spin": {"default": STANDS}}}
ALL = [("kitchen", "preview"), ("kitchen", "default"), ("spin", "default")]


def test_a_table_is_added_to_at_its_commit_and_replaced_at_another_only_as_a_whole():
    assert table.begun(None, ABOUT, []) == ABOUT | {"rows": {}}
    assert table.begun(MADE, ABOUT, [("spin", "default")]) is MADE
    for other in ({"commit": "def"}, {"seed": 1}, {"machine": {}}):
        assert table.begun(MADE, ABOUT | other, ALL) == ABOUT | other | {"rows": {}}
        with pytest.raises(SystemExit, match=r"spin default.*table\.json"):
            table.begun(MADE, ABOUT | other, ALL[:2])


def test_the_page_has_what_was_measured_and_a_dash_where_nothing_was():
    lines = page.as_table(MADE).splitlines()
    assert len(lines) == 2 + 3 and {line.count("|") for line in lines} == {10}
    assert (
        "| kitchen | `default` | 17m 33s | 1.4 GiB | 29.2 / 0.934 / 0.080 | 26.8 / 0.934 / 0.080 | – | – | – |" in lines
    )
    assert lines[-1].endswith("| – | 29.2 / 0.934 / 0.080 | – | 19.2 / 0.934 / 0.080 | – |")
    far = {"heldout_far": {"full": SCORES, "person_crop": SCORES | {"psnr": 25.31}}}
    assert page.line("kitchen", "default", ROW | far).endswith("| farthest: 25.3 / 0.934 / 0.080 | – |")
    assert page.line("spin", "default", STANDS | far) == lines[-1], "there is a truth"
    assert page.line("kitchen", "default", ROW | {"heldout_far": {"full": NOTHING}}) in lines
    failed = copy.deepcopy(MADE)
    failed["rows"]["spin"]["default"] = {"failed": "error: no"}
    assert "fails: error: no" in page.as_table(failed)


@pytest.mark.slow
def test_the_plot_has_a_name_for_each_clip_and_the_commit():
    drawn = page.drawn(MADE)
    assert "abc" in drawn and "spin" in drawn and "preview" in drawn


def test_marked_numbers_keep_their_decimals_and_a_mark_that_leads_nowhere_is_noticed():
    mark = "<!-- kitchen.default.heldout.full.psnr -->"
    assert page.fill(f"1,000.5{mark} dB, 3{mark}", MADE) == f"29.2{mark} dB, 29{mark}"
    assert "| `default` | 17m 33s | 1.4 GiB | 29.2 / 26.8 dB |" in page.phone(MADE)
    assert page.fill("<!-- about -->\nold\n<!-- end -->", MADE).count("abc") == 1
    with pytest.raises(KeyError, match="paper"):
        page.fill("1<!-- kitchen.paper.minutes -->", MADE)


def test_before_a_camera_that_stands_people_are_seen_where_the_true_camera_sees_them():
    """A run whose world is turned, 0.8 times as deep and whose focal length is 1.1 times the true one."""
    turn = Rotation.from_rotvec([0.1, 2.0, -0.3])
    view, true = np.eye(4), np.eye(4)
    view[:3, :3], view[:3, 3], true[:3, 3] = turn.as_matrix(), [0.2, -1, 2.0], [0, 0, 4.0]
    stance = Stance(np.array([0.0, 0.4, 0]), np.zeros(69), np.array([0.5, -0.2, 1.0]))
    K, own_K = np.diag([500.0, 500, 1]), np.diag([1100.0, 1100, 1])  # of 240 px, of 480 px
    seen = true[:3] @ [*stance.pelvis, 1]
    where = np.array([seen[0] / 1.1, seen[1] / 1.1, seen[2]]) * 0.8

    class Run:
        class cameras:
            viewmats, Ks, width = view[None], own_K[None], 480

        class poses:
            world_from_sfm = 1.0

        stances = {3: Stance(np.zeros(3), np.zeros(69), turn.inv().apply(where - view[:3, 3]))}  # noqa: RUF012

    class truth:
        views, stances = {3: true}, {3: stance}

    drawn_view, _, moved = before_standing_camera(Run, truth, K, 240)(Shot(true, K, stance, None, None))
    x, y, z = drawn_view[:3] @ [*moved.pelvis, 1]
    np.testing.assert_allclose([1100 * x / z, 1100 * y / z], 2 * 500 * seen[:2] / seen[2])
    np.testing.assert_allclose(z, 0.8 * seen[2])
    facing = view[:3, :3] @ Rotation.from_rotvec(moved.global_orient).as_matrix()
    np.testing.assert_allclose(facing, Rotation.from_rotvec(stance.global_orient).as_matrix(), atol=1e-12)
