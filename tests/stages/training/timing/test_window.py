"""What is seen of a training while it runs, and that looking changes nothing."""

import numpy as np
import pytest

from stages.training.timing import window as windows
from stages.training.timing.window import Window
from tests.made.training import fit_of, make_clip, run, same

clip = pytest.fixture(scope="module")(make_clip)


def looked(monkeypatch, took=0.0):
    """A window whose clock stands still but while it draws, which takes `took` s; its clock and pictures."""
    now, pictures = [100.0], []
    monkeypatch.setattr(windows.time, "perf_counter", lambda: now[0])

    def picture(strip):
        pictures.append(strip)
        now[0] += took

    return Window(picture, lambda rows: None), now, pictures


@pytest.mark.slow
def test_a_look_shows_the_clip_the_frame_and_the_person_and_leaves_no_trace(clip, monkeypatch):
    fit, other = fit_of(clip), fit_of(clip)
    window, _, pictures = looked(monkeypatch)
    run(fit, 6), run(other, 6)
    window.look(fit, [1])
    run(fit, 12), run(other, 12)
    assert same(fit, other)
    (strip,), images = pictures, clip[0].images
    height, width = images.shape[1:3]
    assert strip.shape == (height, 3 * width, 3) and strip.dtype == np.uint8
    assert (strip[:, :width] == images[1].numpy()).all()
    assert (strip[:, 2 * width :].reshape(-1, 3) == 255).all(1).mean() > 0.3, "the person stands before white"
    assert (strip[:, width : 2 * width] != strip[:, 2 * width :]).any(), "the frame has its scene"


@pytest.mark.slow
def test_looks_take_one_percent_of_the_time_and_go_from_frame_to_frame(clip, monkeypatch):
    window, now, pictures = looked(monkeypatch, took=0.2)
    fit, images = fit_of(clip), clip[0].images
    window.look(fit, [])
    assert pictures == [], "no frame is held out"
    for later in (0, 19.9, 0.2, 1, 30):
        now[0] += later
        window.look(fit, [1, 2])
    assert len(pictures) == 3
    width = images.shape[2]
    assert [(strip[:, :width] == images[i].numpy()).all() for strip, i in zip(pictures, (1, 2, 1))] == [True] * 3
