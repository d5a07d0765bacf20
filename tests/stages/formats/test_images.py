"""Pictures: exact round trips, turned as EXIF says, damaged files refused, full disks told."""

import resource
import struct

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms

from stages.contract import StageError, peak_memory
from stages.formats.images import evenly, read_image, read_mask, read_pixels, write_image, write_mask
from tests.made import icc
from tests.made.said import holds
from tests.tools.mutations import with_checksums


def picture(height=37, width=53, channels=3, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def write_raw(path, pixels, **attributes):
    out = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    for key, value in attributes.items():
        spec[key.replace("__", ":")] = value
    assert out.open(str(path), spec) and out.write_image(pixels) and out.close()


def test_round_trip_is_exact(tmp_path):
    write_image(tmp_path / "a.png", picture())
    assert np.array_equal(read_image(tmp_path / "a.png"), picture())
    write_mask(tmp_path / "m.png", picture()[..., 0])
    assert np.array_equal(read_mask(tmp_path / "m.png"), picture()[..., 0])


def test_colour_under_low_alpha_survives(tmp_path):
    rgba = picture(channels=4)
    rgba[..., 3] = np.arange(53) % 7
    write_image(tmp_path / "a.png", rgba)
    assert np.array_equal(read_pixels(tmp_path / "a.png"), rgba)
    assert np.array_equal(read_image(tmp_path / "a.png"), rgba[..., :3])


def test_grey_and_16_bit_become_8_bit_rgb(tmp_path):
    wide = picture(channels=1).astype(np.uint16) * 257
    write_raw(tmp_path / "g.png", wide)
    assert np.array_equal(read_image(tmp_path / "g.png"), np.repeat(picture(channels=1), 3, 2))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path, orientation):
    """As OpenCV applies it, mirrored ones too: selfies."""
    flat = np.zeros((40, 64, 3), np.uint8)
    flat[:16, :16, 0] = 255
    flat[:16, 16:32, 1] = 255
    write_raw(tmp_path / "a.jpg", flat, Orientation=orientation, Compression="jpeg:100")
    got, want = read_image(tmp_path / "a.jpg"), cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1]
    assert got.shape == want.shape and np.abs(got.astype(int) - want).mean() < 4


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_i15_a_file_cut_short_is_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    write_image(path, picture(200, 200))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(StageError, match="damaged or cut short"):
        read_image(path)


def test_g13_pixels_that_are_not_finite_are_refused_by_file_and_count(tmp_path):
    light = picture().astype(np.float32) / 255
    write_raw(tmp_path / "good.exr", light)
    assert np.abs(read_image(tmp_path / "good.exr").astype(int) - picture()).max() <= 1
    light[3, 4, 1], light[3, 4, 2], light[9, 9] = np.nan, np.nan, np.inf
    write_raw(tmp_path / "bad.exr", light)
    with pytest.raises(StageError, match=r"bad\.exr .*not finite") as error:
        read_image(tmp_path / "bad.exr")
    assert error.value.facts == ("2 of 1961 pixels",)


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(StageError, match="no picture"):
        read_image(tmp_path / "no.png")
    (tmp_path / "t.png").write_text("hello")
    with pytest.raises(StageError, match="not a picture"):
        read_image(tmp_path / "t.png")
    write_image(tmp_path / "c.png", picture())
    with pytest.raises(StageError, match="8-bit grey"):
        read_mask(tmp_path / "c.png")


def test_l12_writing_fails_loudly(tmp_path):
    with pytest.raises(StageError, match="cannot write"):
        write_image(tmp_path / "nowhere" / "a.png", picture())
    with pytest.raises(ValueError, match="uint8"):
        write_image(tmp_path / "a.png", picture().astype(np.float32))
    with pytest.raises(ValueError, match="uint8"):
        write_mask(tmp_path / "a.png", picture())


def test_a_full_disk_is_told_and_leaves_no_picture_that_looks_whole(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(StageError, match="cannot write") as error:
            write_image(tmp_path / "a.png", noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "large" in error.value.facts[0]
    with pytest.raises(StageError, match="cut short"):
        read_image(tmp_path / "a.png")


def one_bit(path, side):
    """The first rows of a black PNG of 1 bit a pixel that says it is side x side px."""
    write_mask(path, np.zeros((8, 8), np.uint8))
    png = bytearray(path.read_bytes())
    png[16:25] = struct.pack(">IIB", side, side, 1)
    path.write_bytes(with_checksums(bytes(png)))
    return path


def test_a_small_file_of_an_enormous_picture_is_refused_before_it_is_unpacked(tmp_path):
    before = peak_memory()
    with pytest.raises(StageError, match="too much memory") as error:
        read_image(one_bit(tmp_path / "a.png", 20_000))
    assert holds(error.value.facts[0], "20000x20000 px", 1, "1.20 GB")
    assert peak_memory() - before < 1 << 28
    with pytest.raises(StageError, match="cut short"):
        read_image(one_bit(tmp_path / "a.png", 64))


@pytest.mark.parametrize(
    ("name", "suffix"),
    [*((name, "png") for name in icc.SPACES), *(("Display P3", one) for one in ("jpg", "tif", "webp"))],
)
def test_colours_of_a_profile_become_srgb(tmp_path, name, suffix):
    """A phone writes Display P3: taken for sRGB, a red is off by 16 of 255."""
    corners = np.array([[[200, 80, 60], [90, 140, 100]], [[120, 110, 100], [60, 70, 150]]], np.uint8)
    patches = np.kron(corners, np.ones((16, 16, 1), np.uint8))
    more = {"png": {}, "tif": {}, "jpg": {"quality": 100, "subsampling": 0}, "webp": {"lossless": True}}[suffix]
    Image.fromarray(patches).save(tmp_path / f"a.{suffix}", icc_profile=icc.profile(name), **more)
    off = np.abs(read_image(tmp_path / f"a.{suffix}") - icc.in_srgb(name, patches))
    assert off.max() < 4 and np.abs(icc.in_srgb(name, patches) - patches).max() > 12


def test_a_profile_of_srgb_changes_no_pixel_and_one_of_grey_is_not_of_colours(tmp_path):
    same = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    grey = icc.profile("Display P3").replace(b"RGB ", b"GRAY", 1)
    for packed in (same, grey):
        Image.fromarray(picture()).save(tmp_path / "a.png", icc_profile=packed)
        assert np.array_equal(read_image(tmp_path / "a.png"), picture())


def test_a_profile_that_cannot_be_read_is_refused_and_pixels_as_stored_are_not_converted(tmp_path):
    Image.fromarray(picture()).save(tmp_path / "a.png", icc_profile=icc.profile("Display P3")[:-40] + bytes(40))
    with pytest.raises(StageError, match="colour profile"):
        read_image(tmp_path / "a.png")
    assert np.array_equal(read_pixels(tmp_path / "a.png"), picture())


def test_rows_are_spread_from_the_first_to_the_last():
    assert evenly(0, 3) == [] and evenly(3, 5) == [0, 1, 2] and evenly(100, 4) == [0, 33, 66, 99]
