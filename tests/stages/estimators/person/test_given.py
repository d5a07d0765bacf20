"""Masks of other programs: layouts made from the synthetic clip's truth come back, wrong ones are refused by name."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages import masks
from stages.contract import Job, StageError
from stages.formats.body_model import read_body_model
from stages.formats.given_masks.coco import decode, polygons
from stages.formats.images import read_mask, write_image, write_mask
from tests.made import mask_files as files
from tests.made.said import any_holds, holds
from tests.made.synthetic.clip import make_clip

TOTAL, PICKED = 10, (0, 2, 3, 5, 9)


@pytest.fixture(scope="module")
def truth():
    """The person bool [N,H,W], and somebody smaller in a corner who leaves after half of the clip."""
    clip = make_clip(read_body_model(), width=96, height=128, frames=TOTAL, novel=1).frames
    person = clip.masks > 127
    other = np.zeros_like(person)
    small = np.stack([cv2.resize(mask, (24, 32), interpolation=cv2.INTER_AREA) > 127 for mask in clip.masks])
    other[:6, 2:34, 1:25] = small[:6]
    assert other.any() and not (other[:, :, :] & person).any()
    return person, other


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    out = tmp_path_factory.mktemp("frames")
    rows = [{"name": f"{i:06d}", "index": i, "time_s": i / 12} for i in PICKED]
    facts = {"video": {"path": "clip.mp4", "frames": TOTAL}, "width": 96, "height": 128, "frames": rows}
    (out / "frames.json").write_text(json.dumps(facts))
    return out


def run(out: Path, frames: Path, path: Path, **params):
    """masks.json, the masks, what was said."""
    out.mkdir(parents=True)
    said: list[str] = []
    job = Job(out, emit=lambda event: said.append(event.get("text", "")))
    masks.run(job, masks.Params(**params), frames=frames, mask_files=path)
    made = [read_mask(out / "masks" / f"{i:06d}.png") for i in PICKED]
    return json.loads((out / "masks.json").read_text()), np.stack(made) > 127, said


def numpy_names(path: Path, person, other) -> Path:
    np.savez_compressed(path, masks=files.ids(person, other)[3:], names=[f"frame_{i:04d}.jpg" for i in range(3, TOTAL)])
    return path


def numpy_frames(path: Path, person, other) -> Path:
    np.savez(path, **{f"{i:05d}": mask[None] for i, mask in enumerate(person)})
    return path


def saved(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def stack(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


def colours(folder: Path, person, other) -> Path:
    """One colour an object, without a palette."""
    folder.mkdir()
    for i in range(TOTAL):
        picture = person[i][..., None] * np.uint8([0, 200, 40]) + other[i][..., None] * np.uint8([200, 0, 0])
        write_image(folder / f"{i}.png", picture)
    return folder


def colmap_masks(folder: Path, person, other) -> Path:
    """COLMAP's: NAME.png.png, 0 where features are ignored."""
    folder.mkdir()
    for i in range(TOTAL):
        write_mask(folder / f"{i:06d}.png.png", np.where(person[i], 0, 255).astype(np.uint8))
    return folder


LAYOUTS = {
    "SAM 2, palette": (lambda d, p, o: files.sam2_palette(d / "out", p, o), "2"),
    "SAM 2, a folder an object": (lambda d, p, o: files.sam2_objects(d / "out", p, o), "002"),
    "16-bit ids": (lambda d, p, o: files.ids_16_bit(d / "out", p, o), "24001"),
    "colours": (lambda d, p, o: colours(d / "out", p, o), str(200 << 8 | 40)),
    "COCO, compressed": (lambda d, p, o: files.coco(d / "a.json", p, o), "9"),
    "COCO, counts": (lambda d, p, o: files.coco(d / "a.json", p, o, "list", "instance_id"), "9"),
    "COCO, polygons": (lambda d, p, o: files.coco(d / "a.json", p, o, "polygons"), "9"),
    "COCO, without tracks": (lambda d, p, o: files.coco(d / "a.json", p, o, track=None), "1"),
    "npy stack": (lambda d, p, o: saved(d / "a.npy", p), ""),
    "npy ids": (lambda d, p, o: saved(d / "a.npy", files.ids(p, o, np.int64)[:, None]), "2"),
    "npz stack": (lambda d, p, o: stack(d / "a.npz", arr_0=p[..., None]), ""),
    "npz logits": (lambda d, p, o: stack(d / "a.npz", logits=np.where(p, 6.5, -9.25).astype(np.float32)
                                         + np.linspace(0, 1, 96, dtype=np.float32)), ""),
    "npz with an array a frame": (lambda d, p, o: numpy_frames(d / "a.npz", p, o), ""),
    "video": (lambda d, p, o: files.film(d / "a.mkv", p), ""),
    "COLMAP": (lambda d, p, o: colmap_masks(d / "out", p, o), ""),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_masks_in_every_layout_come_back_exactly(tmp_path, truth, frames, layout):
    write, person = LAYOUTS[layout]
    facts, made, said = run(tmp_path / "stage", frames, write(tmp_path, *truth))
    np.testing.assert_array_equal(made, truth[0][list(PICKED)])
    assert facts["person"] == person and facts["inverted"] == (layout == "COLMAP")
    told = [text for text in said if holds(text, "2 objects")]
    assert bool(told) == bool(person), "who is followed is said where there are several"
    assert not told or re.search(r"[0-9.]+% .*\b5 pictures; .*\b4 pictures", told[0])


@pytest.mark.parametrize(("layout", "asked"), [("SAM 2, palette", 1), ("SAM 2, a folder an object", 1), ("16-bit ids", "26002"),
                                               ("COCO, compressed", 7), ("COCO, without tracks", "2")])  # fmt: skip
def test_another_person_is_picked_by_id(tmp_path, truth, frames, layout, asked):
    path = LAYOUTS[layout][0](tmp_path, *truth)
    facts, made, _ = run(tmp_path / "stage", frames, path, person=asked)
    np.testing.assert_array_equal(made, truth[1][list(PICKED)])
    assert facts["no_person"] == ["000009"], "who has left is not there"
    with pytest.raises(StageError, match="no person 77") as error:
        run(tmp_path / "again", frames, path, person=77)
    assert holds(error.value.facts[0], "4 pictures")


def test_a_stack_with_names_may_lack_other_frames(tmp_path, truth, frames):
    path = numpy_names(tmp_path / "a.npz", *truth)
    with pytest.raises(StageError, match=r"\b2 of 5 frames") as error:
        run(tmp_path / "stage", frames, path)
    assert "000000, 000002" in error.value.facts[0] and "frame_0003" in error.value.facts[1]


def test_labels_that_touch_are_parts_of_one_person(tmp_path, truth, frames):
    """Clothes of one person, as human parsing gives them, and a second person apart."""
    person, other = truth
    below = np.arange(128)[:, None] > 64
    saved(tmp_path / "a.npy", np.where(person & below, 3, files.ids(person, other)))
    facts, made, said = run(tmp_path / "stage", frames, tmp_path / "a.npy")
    np.testing.assert_array_equal(made, person[list(PICKED)])
    assert facts["person"] == "2" and any_holds(said, 2, "labels 2, 3")


def test_a_compressed_video_of_masks_is_nearly_exact(tmp_path, truth, frames):
    _, made, _ = run(tmp_path / "stage", frames, files.film(tmp_path / "a.mp4", truth[0], "libx264", "yuv420p"))
    true = truth[0][list(PICKED)]
    assert (made & true).sum() / (made | true).sum() > 0.97


def test_larger_masks_of_the_same_shape_are_taken(tmp_path, truth, frames):
    big = [np.kron(masks, np.ones((1, 3, 3), bool)) for masks in truth]
    _, made, _ = run(tmp_path / "stage", frames, files.sam2_palette(tmp_path / "out", *big))
    np.testing.assert_array_equal(made, truth[0][list(PICKED)])


def test_two_people_in_one_mask_are_said(tmp_path, truth, frames):
    person, _ = truth
    both = np.concatenate([person[:, :, ::2], person[:, :, 1::2]], axis=2)
    _, _, said = run(tmp_path / "stage", frames, saved(tmp_path / "a.npy", both))
    assert any_holds(said, "second", "part", "5 of 5 frames")


def test_overlapping_objects_stay_whole(tmp_path, truth, frames):
    """In a folder for each object they may overlap; in one picture with ids they cannot."""
    person, _ = truth
    small = person & (np.arange(128)[:, None] < 60)
    _, made, _ = run(tmp_path / "stage", frames, files.sam2_objects(tmp_path / "out", person, small))
    np.testing.assert_array_equal(made, person[list(PICKED)])


def test_pixels_belong_to_a_polygon_if_their_centre_does():
    triangle = polygons([[1.2, 0.7, 8.9, 2.1, 3.3, 7.6]], 9, 10, "x")
    y, x = np.mgrid[:9, :10] + 0.5
    corners = np.array([[1.2, 0.7], [8.9, 2.1], [3.3, 7.6]])
    sides = []
    for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
        sides.append((b - a)[0] * (y - a[1]) - (b - a)[1] * (x - a[0]))
    np.testing.assert_array_equal(triangle, np.all(np.array(sides) > 0, axis=0))
    outside = polygons([[-5, -5, 50, -5, 50, 50, -5, 50]], 9, 10, "x")
    assert outside.all(), "corners outside the picture are cut off"


def test_run_lengths_of_any_mask_come_back():
    rng = np.random.default_rng(0)
    for share in (0.0, 0.02, 0.5, 0.98, 1.0):
        mask = rng.random((37, 53)) < share
        for how in ("text", "list"):
            np.testing.assert_array_equal(decode(files.ENCODE[how](mask), 37, 53, "x"), mask)
    known = {"size": [4, 5], "counts": [3, 2, 4, 1, 10]}  # by hand: down the columns
    want = np.zeros(20, bool)
    want[[3, 4, 9]] = True
    np.testing.assert_array_equal(decode(known, 4, 5, "x"), want.reshape(5, 4).T)


def changed(part: str = "person", **values):
    """A change of the first annotation of a person, of the first image, or of the whole COCO file."""

    def write(folder: Path, person, other) -> Path:
        path = files.coco(folder / "a.json", person, other)
        content = json.loads(path.read_text())
        entry = {"file": content, "image": content["images"][0], "person": content["annotations"][1]}[part]
        for key, value in values.items():
            entry[key] = value(entry[key]) if callable(value) else value
        content = json.loads(
            json.dumps(content), object_hook=lambda one: {k: v for k, v in one.items() if v is not None}
        )
        path.write_text(json.dumps(content))
        return path

    return write


def rle(**values):
    """A change of that annotation's run lengths."""
    return changed(segmentation=lambda old: {**old, **values})


MALFORMED = {
    "no JSON": (lambda d, p, o: text(d / "a.json", "{"), "cannot read", "EOF|JSON"),
    "JSON of something else": (lambda d, p, o: text(d / "a.json", '{"shapes": []}'), "is not as its program", "it has no images"),
    "no annotations": (changed("file", annotations=[]), "is not as its", r"annotations is \[\], not a list with something"),
    "image without name": (changed("image", file_name=None), "is not as its", r"images\[0\] has no file_name"),
    "image without size": (changed("image", height=0), "is not as its", r"images\[0\].height is 0"),
    "no segmentation": (changed(segmentation=None), "is not as its", r"annotations\[1\] has no segmentation"),
    "image id of a list": (changed("image", id=[1]), "is not as its", r"images\[0\].id.* is \[1\]"),
    "category of a list": (changed(category_id=[1]), "is not as its", r"annotations\[1\].category_id.* is \[1\]"),
    "size of a number": (rle(size=96), "size .*image", "found 96"),
    "counts of a number": (rle(counts=7), "not run lengths", "found 7"),
    "unknown image": (changed(image_id=5), "belongs to no image", "image_id is 5, 10 images"),
    "size swapped": (rle(size=[96, 128]), "size .*image", r"\[96, 128\], wanted \[128, 96\]"),
    "counts too short": (rle(counts=[5, 7]), "fill .*image", "12 pixels, .*12288"),
    "counts negative": (rle(counts=[12290, -2]), "not run lengths", "-2"),
    "counts of another alphabet": (rle(counts="5!7"), "not COCO's text", "letter 1 is '!'"),
    "counts cut short": (rle(counts="P"), "cut short", "1 letters"),
    "no counts": (changed(segmentation={"size": [128, 96]}), "has no counts", "size"),
    "polygon of two corners": (changed(segmentation=[[1, 2, 3, 4]]), "has an invalid polygon", "2 corners"),
    "polygon of words": (changed(segmentation=[["a", "b"]]), "polygon", "could not convert"),
    "polygon NaN": (changed(segmentation=[[1, 2, 3, float("nan"), 5, 6]]), "an invalid polygon", "nan"),
    "stack too short": (lambda d, p, o: saved(d / "a.npy", p[:7]), "a mask for each frame", "7 masks, 10 fr"),
    "stack of one object": (lambda d, p, o: saved(d / "a.npy", np.stack([p, o])), "no single stack",
                            r"bool \(2, 10, 128, 96\)"),
    "stack NaN": (lambda d, p, o: saved(d / "a.npy", np.where(p, 1.0, np.nan)), "not finite", r"first at \(0, 0\)"),
    "stack of words": (lambda d, p, o: saved(d / "a.npy", np.full((10, 4, 3), "x")), r"not a mask \[H,W\]", "<U1"),
    "pickled stack": (lambda d, p, o: saved(d / "a.npy", np.array([None, {}], object)), "not a plain .npy", "Python objects"),
    "npy cut short": (lambda d, p, o: cut(saved(d / "a.npy", p), 500), "plain .npy", ""),
    "npz cut short": (lambda d, p, o: cut(stack(d / "a.npz", masks=p), 500), "cannot read", "zip"),
    "npz of something else": (lambda d, p, o: stack(d / "a.npz", poses=np.zeros((10, 72))), "5 of 5 frames",
                              "poses|given"),
    "names too few": (lambda d, p, o: stack(d / "a.npz", masks=p, names=np.array(["1", "2"])), "name .*rows",
                      r"\(2,\), wanted 10"),
    "two names alike": (lambda d, p, o: stack(d / "a.npz", masks=p, names=np.array(["000000"] * 10)), "two masks",
                        "000000"),
    "masks of another video": (lambda d, p, o: saved(d / "a.npy", p[:, :, :64]), "frame 000000",
                               "mask 64x128, frames 96x128"),
    "video too long": (lambda d, p, o: files.film(d / "a.mkv", np.concatenate([p, p[:3]])), "a mask for each frame",
                       "13 masks, 10 frames"),
    "no video": (lambda d, p, o: text(d / "a.mp4", "no video"), "video|cut short", "8 bytes"),
    "one mask": (lambda d, p, o: files.png(d / "a.png", p[0].astype(np.uint8)), "is one mask", ".png"),
    "an empty folder": (lambda d, p, o: made(d / "out"), "no masks in", "nothing"),
    "pictures": (lambda d, p, o: photographs(d / "out"), "picture", "colours"),
    "two masks of one frame": (lambda d, p, o: twice(d / "out", p), "two masks", "000002"),
    "a damaged mask": (lambda d, p, o: damaged(d / "out", p), "damaged or cut short", ""),
}  # fmt: skip


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def cut(path: Path, size: int) -> Path:
    path.write_bytes(path.read_bytes()[:size])
    return path


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def photographs(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    for i in range(TOTAL):
        write_image(
            made(folder) / f"{i}.png" if i == 0 else folder / f"{i}.png", rng.integers(0, 256, (128, 96, 3), np.uint8)
        )
    return folder


def twice(folder: Path, person) -> Path:
    for i in range(TOTAL):
        files.png(folder / f"{i:06d}.png", person[i].astype(np.uint8))
    np.save(folder / "000002.npy", person[2])
    return folder


def damaged(folder: Path, person) -> Path:
    for i in range(TOTAL):
        files.png(folder / f"{i:06d}.png", person[i].astype(np.uint8))
    cut(folder / "000003.png", 90)
    return folder


@pytest.mark.parametrize("kind", MALFORMED)
def test_malformed_masks_are_refused_by_name(tmp_path, truth, frames, kind):
    write, problem, fact = MALFORMED[kind]
    with pytest.raises(StageError, match=problem) as error:
        run(tmp_path / "stage", frames, write(tmp_path, *truth))
    assert error.value.hint and error.value.facts and not error.value.problem.endswith(".")
    assert re.search(fact, "\n".join(error.value.facts)), error.value.facts


def test_masks_that_lie_beside_the_pictures_are_those_of_the_folder(tmp_path, truth):
    folder, rows = tmp_path / "clip", []
    folder.mkdir()
    for i, mask in enumerate(truth[0]):
        write_image(folder / f"f_{i:02d}.jpg", np.random.default_rng(i).integers(0, 255, (*mask.shape, 3), np.uint8))
        write_mask(folder / f"f_{i:02d}_mask.png", np.where(mask, 255, 0).astype(np.uint8))
        rows.append({"name": f"{i:06d}", "index": i, "time_s": i / 10, "source": f"f_{i:02d}"})
    facts = {"video": {"path": "clip", "frames": TOTAL}, "width": 96, "height": 128, "frames": rows}
    (tmp_path / "images").symlink_to(folder)
    (tmp_path / "frames.json").write_text(json.dumps(facts))
    for i in range(TOTAL):
        write_image(folder / f"{i:06d}.png", np.zeros((128, 96, 3), np.uint8))
    _, made, _ = run(tmp_path / "stage", tmp_path, folder)
    np.testing.assert_array_equal(made, truth[0][list(PICKED)])
