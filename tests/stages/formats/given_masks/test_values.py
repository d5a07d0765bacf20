"""Masks that the user gives: every encoding reads as the same mask, bad files are refused."""

import numpy as np
import OpenImageIO as oiio
import pytest

from stages.contract import StageError
from stages.formats.frame_names import number, stem
from stages.formats.given_masks import values as values_module
from stages.formats.given_masks.mask_set import MaskSet
from stages.formats.given_masks.objects import is_number, objects_of
from stages.formats.given_masks.values import Levels, levels_of, mask_files, read_values
from stages.formats.images import write_image


def disc(height=60, width=80):
    y, x = np.mgrid[:height, :width]
    return (x - 40) ** 2 + (y - 30) ** 2 < 15**2


def write_raw(path, pixels, **attributes):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    for key, value in attributes.items():
        spec[key] = value
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(pixels) and out.close()


def encoded(kind, folder):
    """One file of the disc, in one of the encodings people use."""
    mask = disc()
    as_u8 = mask.astype(np.uint8)[..., None]
    path = folder / ("m.npy" if kind.startswith("npy") else "m.jpg" if kind == "jpeg" else "m.png")
    if kind == "npy bool":
        np.save(path, mask)
    elif kind == "npy float 0..1":
        np.save(path, np.where(mask, 0.97, 0.02).astype(">f4"))
    elif kind == "npy float 0..255":
        np.save(path, np.where(mask, 255.0, 1.5) + np.linspace(0, 1, 80))
    elif kind == "npy int64 [1,H,W]":
        np.save(path, mask.astype(np.int64)[None])
    elif kind == "rgba cut-out":
        colour = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        write_image(path, np.concatenate([colour, as_u8 * 255], 2))
    elif kind == "rgba without alpha":
        write_image(path, np.concatenate([as_u8.repeat(3, 2) * 255, np.full_like(as_u8, 255)], 2))
    elif kind == "palette colour":
        write_image(path, as_u8 * np.array([128, 0, 0], np.uint8))
    elif kind == "jpeg":
        write_raw(path, as_u8 * 255, Compression="jpeg:80")
    else:
        top = {"0/1": 1, "0/255": 255, "0/128": 128, "16 bit": 65535, "labels 0..3": 1}[kind]
        pixels = as_u8.astype(np.uint16 if kind == "16 bit" else np.uint8) * top
        if kind == "labels 0..3":
            pixels[25:35, 35:45] = 3
        write_raw(path, pixels)
    return path


def read_all(*paths):
    """The masks of files that belong together, uint8 [H,W]."""
    levels = levels_of(paths, read_values)
    return [levels[path].marked(read_values(path)[0]) for path in paths]


KINDS = [
    *("0/1", "0/255", "0/128", "16 bit", "labels 0..3", "jpeg", "rgba cut-out", "rgba without alpha", "palette colour"),
    *("npy bool", "npy float 0..1", "npy float 0..255", "npy int64 [1,H,W]"),
]


@pytest.mark.parametrize("kind", KINDS)
def test_g15_k05_every_encoding_gives_the_same_mask(tmp_path, kind):
    path = encoded(kind, tmp_path)
    (mask,) = read_all(path)
    assert mask.dtype == np.uint8 and np.array_equal(mask > 127, disc())
    assert levels_of([path], read_values)[path].files == 1


def test_soft_masks_stay_soft(tmp_path):
    ramp = np.tile(np.arange(256, dtype=np.uint8), (10, 1))
    write_raw(tmp_path / "m.png", ramp[..., None])
    assert np.array_equal(*read_all(tmp_path / "m.png"), ramp)
    np.save(tmp_path / "m.npy", ramp / 255)
    assert np.array_equal(*read_all(tmp_path / "m.npy"), ramp)


@pytest.mark.parametrize("ids", [(1, 2), (3, 40), (7, 104)])
def test_ids_of_8_bits_may_be_any_that_a_tracker_counts_to(ids):
    pixels = np.zeros((40, 40), np.uint8)
    pixels[5:20, 5:15], pixels[5:30, 25:35] = ids
    second, first = objects_of(MaskSet("", None, ("",), lambda _, i: (pixels, "png uint8")), [0])
    assert [second.id, first.id] == [str(ids[1]), str(ids[0])]
    assert (first.read(0) == 255).sum() == 150 and first.read(1) is None


def test_what_a_value_means_is_decided_over_all_files(tmp_path):
    """A frame without a person, with faint noise, must not become a label mask that marks the noise."""
    noise = np.random.default_rng(0).integers(0, 9, (60, 80, 1), dtype=np.uint8)
    write_raw(tmp_path / "a.png", noise)
    write_raw(tmp_path / "b.png", noise + disc()[..., None].astype(np.uint8) * 240)
    faint, shown = read_all(tmp_path / "a.png", tmp_path / "b.png")
    assert faint.max() < 16 and np.array_equal(shown > 127, disc())


def test_g15_all_marked_and_none_marked(tmp_path):
    for name, value in (("a", 1), ("b", 0)):
        write_raw(tmp_path / f"{name}.png", np.full((8, 8, 1), value, np.uint8))
    full, none = read_all(tmp_path / "a.png", tmp_path / "b.png")
    assert full.min() == 255 and none.max() == 0


def test_k02_k06_bad_arrays_are_refused(tmp_path):
    bad = {
        "nan": (np.full((4, 4), np.nan), "not finite"),
        "box": (np.zeros((2, 4, 4)), r"not a mask \[H,W\]"),
        "object": (np.array([[None, 1]], dtype=object), "not a plain .npy"),
        "text": (np.array([["a", "b"]]), r"not a mask \[H,W\]"),
    }
    for name, (array, message) in bad.items():
        np.save(tmp_path / f"{name}.npy", array, allow_pickle=True)
        with pytest.raises(StageError, match=message):
            read_values(tmp_path / f"{name}.npy")


def test_names():
    from pathlib import Path

    assert stem(Path("a/IMG_0012.jpg.png")) == "IMG_0012" and stem(Path("000012.npy")) == "000012"
    assert number("frame_0012") == 12 and number("mask") is None and number("v2_mask_007") == 7


def test_folders_without_masks_are_refused(tmp_path):
    with pytest.raises(StageError, match="no folder"):
        mask_files(tmp_path / "no")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(StageError, match="no masks in"):
        mask_files(tmp_path)


def test_names_and_ids_of_odd_digits_are_compared_and_no_more(tmp_path):
    assert number("a" + "9" * 5000) is None and number("1700000000123456789.png") == 1700000000123456789
    assert is_number("1", "001") and not is_number("²", "2") and not is_number("10", "1")
    assert is_number("0" + "7" * 5000, "7" * 5000) and not is_number("7" * 5000, "7" * 5001) and is_number("0", "000")


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
@pytest.mark.parametrize("order", "CF")
def test_levels_are_those_that_numpy_finds(dtype, order, monkeypatch):
    monkeypatch.setattr(values_module, "PIECE", 700)
    values = np.asarray(np.random.default_rng(0).integers(0, 7, (60, 50)) * 30, dtype, order=order)
    levels = Levels("npy", values.dtype, values[:0, 0])
    levels.add(values)
    found, counts = np.unique(values, return_counts=True)
    np.testing.assert_array_equal(levels.few, found)
    assert (levels.lowest, levels.highest) == (0, 180) and levels.few.dtype == dtype
    if dtype != np.float32:
        assert levels.areas == {int(value): [count / values.size] for value, count in zip(found, counts, strict=True)}
