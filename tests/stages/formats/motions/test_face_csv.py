import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.motions.face_csv import read_face
from stages.gestures import FACE_NAMES
from tests.made.said import holds

JAW = FACE_NAMES.index("jawOpen")


def written(path, header, rows):
    path.write_text("\n".join([",".join(header), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_what_a_phone_writes_is_read_with_its_time_codes(tmp_path):
    """Names with capitals, the head's turns beside, 60 frames a second in hours, minutes, seconds, frames."""
    names = [name[0].upper() + name[1:] for name in FACE_NAMES]
    codes = [f"10:59:59:{i:02d}.250" if i < 60 else f"11:00:00:{i - 60:02d}.250" for i in range(90)]
    rows = [[code, 61, *[i / 100] * 52, -0.4] for i, code in enumerate(codes)]
    take = read_face(written(tmp_path / "take.csv", ["Timecode", "BlendShapeCount", *names, "HeadYaw"], rows))
    assert take.face.shape == (90, 52) and holds(take.notes[1], "60")
    np.testing.assert_allclose(take.times, np.arange(90) / 60, atol=1e-9)
    np.testing.assert_allclose(take.face[:, JAW], np.arange(90) / 100)


@pytest.mark.parametrize(("key", "unit"), [("time", 1.0), ("timestamp_ms", 1000.0)])
def test_seconds_and_some_of_the_shapes_are_enough(tmp_path, key, unit):
    take = read_face(
        written(tmp_path / "t.csv", ["jawOpen", key], [[0.1, 5 * unit], [1.2, 5.5 * unit], [-0.1, 7 * unit]])
    )
    np.testing.assert_allclose(take.times, [0, 0.5, 2])
    assert take.face[:, JAW].tolist() == [0.1, 1.0, 0.0] and take.face.sum() == 1.1
    assert holds(take.notes[0], "1", "52") and holds(take.notes[1], "2")


@pytest.mark.parametrize(
    ("header", "rows", "named"),
    [
        (["time", "smile"], [[0, 1]], "no face capture"),
        (["time", "jawOpen"], [], "no face capture"),
        (["time", "jawOpen"], [[0, 0.5], [1, "open"]], "row 3"),
        (["time", "jawOpen"], [[0, 0.5], [0.1, "nan"]], "row 3"),
        (["time", "jawOpen"], [[0, 0.5], [0, 0.5]], "do not rise"),
        (["time", "jawOpen"], [[0, 50], [1, 0.5]], "0 to 1"),
    ],
)
def test_what_is_no_capture_is_refused_by_row(tmp_path, header, rows, named):
    with pytest.raises(StageError, match=named):
        read_face(written(tmp_path / "t.csv", header, rows))
