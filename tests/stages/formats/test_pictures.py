"""What lies in folders of pictures: which files are the clip, in what order, what is left out and said."""

import pytest

from stages.contract import StageError
from stages.formats.pictures import pictures_in
from tests.made.said import holds

TEN = [f"IMG_{i:04d}.jpg" for i in range(1, 11)]


def found(folder, names):
    """Empty files of these names, and what is taken of them."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return pictures_in(folder)


BESIDE = {
    "masks": [name.replace(".jpg", "_mask.png") for name in TEN],
    "masks of COLMAP": [f"{name}.png" for name in TEN],
    "depths": [name.replace(".jpg", "-depth.tiff") for name in TEN],
    "thumbnails": [f"thumb_{name}" for name in TEN],
    "small ones": [name.replace(".jpg", ".small.webp") for name in TEN],
    "copies of some": ["IMG_0003 (1).jpg", "IMG_0004 copy.jpg"],
    "PNG of some": ["IMG_0002.png", "IMG_0005.PNG"],
    "PNG of all": [name.replace(".jpg", ".png") for name in TEN],
    "HEIC": [name.replace(".jpg", ".HEIC") for name in TEN],
    "raw and notes": ["IMG_0001.dng", "notes.txt", "IMG_0002.xmp"],
    "a poster": ["poster.jpg"],
    "edited ones": ["IMG_E0004.jpg"],
}


@pytest.mark.parametrize("what", BESIDE)
def test_what_is_no_picture_of_the_clip_is_left_out_and_said(tmp_path, what):
    taken = found(tmp_path, [*TEN, *BESIDE[what]])
    assert [path.name for path in taken.files] == TEN and taken.steps.tolist() == list(range(10))
    assert sum(f"left out {len(BESIDE[what])} files" in note for note in taken.notes) == 1 == len(taken.notes)


@pytest.mark.parametrize(
    "names",
    [
        TEN,
        [f"{i}.png" for i in range(10)],
        [f"VID_20260101_120{i:03d}.jpg" for i in range(0, 50, 5)],
        ["front.jpg", "left.jpg", "back.jpg", "right.jpg"],
        ["shot.png", "shot_b.png", "shot_c.png", "shot_d.png"],
        [f"{side}_{i:03d}.jpg" for i in range(5) for side in ("left", "right")],
        [f"IMG-202601{i // 6 + 1:02d}-WA{i:04d}.jpg" for i in range(10)],
        [f"frame_{i}_of_10.png" for i in range(10)],
    ],
)
def test_clips_of_many_kinds_of_names_are_whole(tmp_path, names):
    taken = found(tmp_path, names)
    assert sorted(path.name for path in taken.files) == sorted(names) and not taken.notes and not taken.doubts
    assert taken.steps.tolist() == list(range(len(names)))


ROLLED = {
    "four digits": [f"IMG_{i:04d}.jpg" for i in (*range(9995, 10000), *range(1, 6))],
    "from 0": [f"P{i:04d}.jpg" for i in (*range(9995, 10000), *range(6))],
    "five digits": [f"DSC{i:05d}.jpg" for i in (*range(9990, 10000), 1, 2, 3)],
    "three digits": [f"a{i:03d}.jpg" for i in (*range(995, 1000), *range(1, 6))],
    "some lack": [f"IMG_{i:04d}.jpg" for i in (*range(9985, 9998), *range(3, 16))],
}


@pytest.mark.parametrize("kind", ROLLED)
def test_a_camera_that_begins_to_count_again(tmp_path, kind):
    names = ROLLED[kind]
    taken = found(tmp_path, names)
    assert [path.name for path in taken.files] == names and holds(taken.doubts[0], names[0], "first")
    assert (taken.steps[1:] > taken.steps[:-1]).all() or kind == "from 0"
    assert len(taken.doubts) == 1 + (kind == "some lack")


def test_long_clips_are_not_taken_for_rolled_ones(tmp_path):
    for i in (*range(1, 9), *range(9000, 9009)):
        (tmp_path / f"IMG_{i:04d}.jpg").touch()
    taken = pictures_in(tmp_path)
    assert taken.files[0].name == "IMG_0001.jpg" and holds(taken.doubts[0], "9 to 8999")


@pytest.mark.parametrize(
    ("numbers", "steps", "lack"),
    [
        ([0, 1, 2, 3, 4, 7, 8, 9, 10, 11], [0, 1, 2, 3, 4, 7, 8, 9, 10, 11], "5 to 6"),
        ([0, 5, 10, 15, 20, 30, 35, 40, 45], [0, 1, 2, 3, 4, 6, 7, 8, 9], "25"),
        ([1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14], [0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13], "3, 13"),
        ([3, 8, 9, 20, 22, 40], range(6), ""),  # photos that somebody chose
    ],
)
def test_numbers_are_time_and_those_that_lack_are_said(tmp_path, numbers, steps, lack):
    taken = found(tmp_path, [f"{i:04d}.png" for i in numbers])
    assert taken.steps.tolist() == list(steps)
    assert [doubt.startswith(f"pictures lack: {lack};") for doubt in taken.doubts] == [True] * bool(lack)


@pytest.mark.parametrize("inner", ["images", "a/b/c", "DCIM/100APPLE"])
def test_the_folder_inside_that_has_the_pictures_is_named(tmp_path, inner):
    for name in TEN:
        (tmp_path / inner).mkdir(parents=True, exist_ok=True)
        (tmp_path / inner / name).touch()
    with pytest.raises(StageError, match="no pictures in") as error:
        pictures_in(tmp_path)
    assert error.value.hint == f"`hugs run {tmp_path / inner}`" and error.value.facts == (f"{tmp_path / inner} has 10",)
