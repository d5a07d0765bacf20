"""COLMAP's text model as other programs write it: with lines of features, empty ones, or none."""

import pytest

from stages.contract import StageError
from stages.formats.given_cameras.colmap_text import picture_rows

NAMES = ["a.png", "000001", "12", "my pic.png", "a b c.png"]


@pytest.mark.parametrize("features", [None, "", "10.5 20.5 -1", "1 2 3 4 5 6 7 8 9", "1 2 3 " * 4])
def test_a_model_with_or_without_lines_of_features_is_read(tmp_path, features):
    lines = ["# Image list"]
    for i, name in enumerate(NAMES):
        lines += [f"{i + 1} 1 0 0 0 0 0 {i} 1 {name}", *([] if features is None else [features])]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    found = list(picture_rows(tmp_path / "images.txt"))
    assert [name for *_, name in found] == NAMES and [pose[6] for _, pose, *_ in found] == list(range(len(NAMES)))


def test_a_line_that_is_neither_is_refused(tmp_path):
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n1 2 3\n1 2 3\n")
    with pytest.raises(StageError, match=r"\bline 3\b.*images\.txt"):
        list(picture_rows(tmp_path / "images.txt"))
