"""What is kept between two runs of a film, and when it counts."""

import json

import numpy as np
import pytest
import torch

from stages.filming.parts import MADE, Parts, mark, spans


def test_a_mark_tells_all_that_matters_apart_and_nothing_else():
    array = np.arange(6.0)
    same = [mark([array, "a", None, 1]), mark([torch.arange(6.0, dtype=torch.float64), "a", None, 1])]
    assert same[0] == same[1]
    others = [array + 1e-12, array.reshape(2, 3), array.astype(np.float32), array[:5]]
    marks = {mark([other, "a", None, 1]) for other in others}
    marks |= {
        mark([array, "b", None, 1]),
        mark([array, "a", 0, 1]),
        mark([array, "a", None, 1.0]),
        mark([array, "a"], None, 1),
    }
    assert len(marks | set(same)) == 9
    with pytest.raises(TypeError, match="dict"):
        mark({})


def test_pieces_cover_the_film():
    assert [list(piece) for piece in spans(7, 3)] == [[0, 1, 2], [3, 4, 5], [6]]


def test_a_file_is_made_once_and_again_when_it_or_its_stuff_has_changed(tmp_path):
    out, count = tmp_path / "new" / "film.mp4", []

    def run(*stuff, code="1"):
        return Parts(tmp_path / "kept", code).bring(
            out, lambda part: (count.append(1), part.write_text(f"film {len(count)}")), *stuff
        )

    assert run("a") and not run("a") and run("b") and run("b", code="2") and not run("b", code="2")
    out.write_text("somebody's")
    assert run("b", code="2") and out.read_text() == "film 4"
    (tmp_path / "kept" / MADE).write_text("[1")
    assert run("b", code="2"), "a note that cannot be read is none"
    (tmp_path / "kept" / MADE).write_text(json.dumps([1]))
    assert run("b", code="2")


def test_a_file_that_could_not_be_made_is_not_remembered(tmp_path):
    parts, out = Parts(tmp_path / "kept", ""), tmp_path / "film.mp4"

    def fail(part):
        part.write_text("fi")
        raise OSError("full")

    with pytest.raises(OSError):
        parts.bring(out, fail, 1)
    assert not out.exists() and not list(tmp_path.glob(".*"))
    assert parts.bring(out, lambda part: part.write_text("film"), 1)


def test_pieces_that_a_run_had_no_use_for_are_removed(tmp_path):
    parts = Parts(tmp_path, "1")
    used, old = parts.piece(".mp4", 1), parts.piece(".mp4", 2)
    for path in (used, old):
        path.write_text("piece")
    again = Parts(tmp_path, "1")
    assert again.piece(".mp4", 1) == used and again.piece(".mp4", 3) not in (used, old)
    assert Parts(tmp_path, "2").piece(".mp4", 1) != used
    again.tidy()
    assert used.exists() and not old.exists()


def test_nothing_else_is_removed_and_no_file_is_written_through_a_link(tmp_path):
    """The folder of pieces may be a link to one that holds other things."""
    (tmp_path / "documents").mkdir()
    (tmp_path / "kept").symlink_to("documents")
    theirs = ["letter.txt", "0123456789abcdef01234567", "film.mp4", ".lock", "A" * 24 + ".mp4"]
    ours = ["0123456789abcdef01234567.mp4", ".hugs-0123456789ab.mov"]
    for name in (*theirs, *ours):
        (tmp_path / "kept" / name).write_text("kept")
    parts = Parts(tmp_path / "kept", "")
    (tmp_path / "000.000.png").symlink_to("documents/letter.txt")
    assert parts.bring(tmp_path / "000.000.png", lambda part: part.write_text("drawn"), 1)
    parts.tidy()
    assert (tmp_path / "documents/letter.txt").read_text() == "kept"
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {*theirs, MADE}
    assert not Parts(tmp_path / "kept", "").bring(tmp_path / "000.000.png", pytest.fail, 1)
