"""Focal lengths that files tell: EXIF of pictures, QuickTime keys of a video."""

import math

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from stages.formats.told_focal import PICTURE_SPREAD, VIDEO_SPREAD, told_focal
from tests.made.said import holds

WIDTH, HEIGHT = 64, 48
TO_SHARE = math.hypot(WIDTH, HEIGHT) / WIDTH / math.hypot(36, 24)


def picture(path, **tags) -> None:
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, "uint8")
    for name, value in tags.items():
        spec[f"Exif:{name}"] = value
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), spec)
    out.write_image(np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    out.close()


def video(path, **tags) -> None:
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as out:
        out.metadata.update({f"com.apple.quicktime.{key}": value for key, value in tags.items()})
        stream = out.add_stream("h264", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for _ in range(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8))))
        out.mux(stream.encode())


def test_pictures_tell_the_equivalent_by_the_diagonal(tmp_path):
    for i in range(3):
        picture(tmp_path / f"{i}.jpg", FocalLengthIn35mmFilm=26, FocalLength=4.25)
    found = told_focal(tmp_path, WIDTH, HEIGHT)
    assert found.share == pytest.approx(26 * TO_SHARE) and found.spread == PICTURE_SPREAD
    assert found.words == "EXIF, 26 mm equivalent"
    upright = told_focal(tmp_path, HEIGHT, WIDTH)
    assert upright.share == found.share


def test_a_sensor_of_known_size_does_too(tmp_path):
    """1000 px to the inch on the sensor, 64 px wide: 1.6256 mm; 4 mm of focal length are 2.46 times that."""
    picture(tmp_path / "a.jpg", FocalLength=4.0, FocalPlaneXResolution=1000.0, FocalPlaneResolutionUnit=2)
    found = told_focal(tmp_path, WIDTH, HEIGHT)
    assert found.share == pytest.approx(4.0 * 1000 / 25.4 / WIDTH, rel=1e-3) and holds(found.words, "EXIF", "4 mm")


@pytest.mark.parametrize("tags", [
    {}, {"FocalLengthIn35mmFilm": 0}, {"FocalLengthIn35mmFilm": 9000}, {"FocalLength": 4.25},
    {"FocalLength": 4.0, "FocalPlaneXResolution": 1e9},
])  # fmt: skip
def test_what_cannot_be_or_is_not_enough_is_no_focal_length(tmp_path, tags):
    picture(tmp_path / "a.jpg", **tags)
    assert told_focal(tmp_path, WIDTH, HEIGHT) is None


def test_pictures_that_differ_tell_none(tmp_path):
    for i, mm in enumerate((26, 26, 52)):
        picture(tmp_path / f"{i}.jpg", FocalLengthIn35mmFilm=mm)
    assert told_focal(tmp_path, WIDTH, HEIGHT) is None


def test_a_film_tells_apples_key(tmp_path):
    video(tmp_path / "a.mov", **{"camera.focal_length.35mm_equivalent": "28", "model": "a phone"})
    found = told_focal(tmp_path / "a.mov", WIDTH, HEIGHT)
    assert found.share == pytest.approx(28 * TO_SHARE) and found.spread == VIDEO_SPREAD
    assert found.words == "QuickTime, 28 mm equivalent"


@pytest.mark.parametrize("tags", [{}, {"model": "a phone"}, {"camera.focal_length.35mm_equivalent": "wide"}])
def test_a_film_without_a_number_tells_none(tmp_path, tags):
    video(tmp_path / "a.mov", **tags)
    assert told_focal(tmp_path / "a.mov", WIDTH, HEIGHT) is None
