"""Files of the tools with one thing wrong: each is refused with the file, the key and the numbers, never a traceback."""

from __future__ import annotations

import copy
import os
import pickle

import numpy as np
import pytest
import torch

from stages.contract import StageError
from stages.estimators.bodyfit.frames import join_frames
from stages.formats.given_fits.recognize import read_smpl_fit
from tests.made import fits
from tests.made.said import holds


@pytest.fixture(scope="module")
def truth():
    return fits.make_truth(frames=4, width=48, height=64)


@pytest.fixture(scope="module")
def whole(truth):
    return {tool: fits.contents(tool, truth) for tool in fits.FILES}


def within(*keys):
    """Spoils what stands at that place: `within(0, "a")(f)` puts f(value) for content[first key]["a"]; whole numbers
    count the entries of dictionaries too."""

    def spoil(change):
        def run(content):
            spot = content
            for key in keys[:-1]:
                spot = spot[at(spot, key)]
            last = at(spot, keys[-1])
            changed = change(spot[last])
            if changed is GONE:
                del spot[last]
            else:
                spot[last] = changed
            return content

        return run

    return spoil


def at(spot, key):
    return list(spot)[key] if isinstance(spot, dict) and isinstance(key, int) else key


GONE = object()
gone = lambda value: GONE  # noqa: E731


def put(value):
    return lambda old: value


def part(*index):
    return lambda value: value[index]


def with_number(number, *index):
    """The array or tensor with `number` at `index`."""

    def run(value):
        value = copy.deepcopy(value)
        value[index] = number
        return value

    return run


nan = with_number(np.nan, 0, 1)
PERSON, WHAM, INCAM, TRAM = (0, "smpl", 1), (1,), ("smpl_params_incam",), ("tracks", 1)
MALFORMED = []
for tool, spoil, words in (
    # 4D-Humans
    ("PHALP", within(0, "smpl")(gone), ["000001.jpg", "no smpl", "tracked_time"]),
    ("PHALP", within(0, "time")(put("a")), ["000001.jpg", "time", "a str"]),
    ("PHALP", within(0, "camera")(lambda v: v[:1]), ["000001.jpg", "different lengths", "camera 1", "tid 2"]),
    ("PHALP", within(0, "tid")(put(3)), ["000001.jpg", "different lengths", "tid None"]),
    ("PHALP", within(*PERSON, "betas")(with_number(np.inf, 2)), ["person 7", "betas", "[0, 2]", "inf"]),
    ("PHALP", within(*PERSON, "body_pose")(part(slice(21))), ["person 7", "body_pose", "1x21x3x3"]),
    ("PHALP", within(*PERSON, "body_pose")(lambda v: 1.2 * v), ["person 7", "body_pose", "not rotations"]),
    ("PHALP", within(*PERSON, "global_orient")(gone), ["person 7", "no global_orient"]),
    ("PHALP", within(0, "camera", 1)(put(np.zeros(2))), ["person 7", "camera", "found 2, wanted 3"]),
    ("PHALP", within(0, "tracked_time", 1)(put(np.zeros(3))), ["person 7", "tracked_time", "wanted a single number"]),
    ("PHALP", within(0, "size", 1)(put([96, 128])), ["another shape", "128x96", "48x64"]),
    ("PHALP", within(0, "size", 1)(put([0, 0])), ["without a size"]),
    ("PHALP", within(0, "2d_joints", 1)(put(np.zeros(80))), ["person 7", "2d_joints", "found 80, wanted 90"]),
    ("PHALP", within(1)(put([1, 2])), ["000004.jpg", "holds no named values", "a list"]),
    ("PHALP", lambda c: {k: {**v, "tracked_time": [1] * len(v["tid"])} for k, v in c.items()}, ["holds no poses"]),
    # ROMP
    ("ROMP v1 video", within(0, 0, "cam")(gone), ["00000000.jpg", "no cam", "betas"]),
    ("ROMP v1 video", within(0, 0, "poses")(part(slice(66))), ["00000000.jpg", "poses", "1x66", "1x72"]),
    ("ROMP v1 video", within(0, 0, "poses")(lambda v: v + 60), ["00000000.jpg", "poses", "degrees"]),
    ("ROMP v1 video", within(0, 0, "cam")(with_number(-1, 0)), ["00000000.jpg", "cam", "not positive", "-1"]),
    ("ROMP v1 video", within(0, 0)(put(3)), ["00000000.jpg", "no named values", "a int"]),
    ("ROMP v1 video", put({}), ["holds no poses"]),
    ("ROMP v1 tracks", within(0, 0, "betas")(put("x")), ["00000000", "betas", "a str"]),
    ("ROMP v1 pictures", within(0, 0, "betas")(part(slice(3))), ["betas", "1x3", "1x10"]),
    ("simple-romp pictures", within(0, "smpl_thetas")(part(slice(1))), ["different lengths", "smpl_thetas", "cam 2"]),
    ("simple-romp pictures", within(0, "smpl_betas")(gone), ["no smpl_betas"]),
    (
        "simple-romp video",
        within("sequence_results", 0, "frame_id", 0)(put(99)),
        ["track 0", "frame_id 99", "4 pictures"],
    ),
    ("simple-romp video", within("sequence_results", 0, "cam")(lambda v: v[:1]), ["track 0", "lengths", "cam"]),
    ("simple-romp video", within("sequence_results", 0, "frame_id")(put(None)), ["track 0", "lengths"]),
    # WHAM
    ("WHAM", within(*WHAM, "pose")(lambda v: v[:, :69]), ["track 1", "pose", "4x69", "4x72"]),
    ("WHAM", within(*WHAM, "trans")(lambda v: v[:3]), ["track 1", "trans", "3x3", "4x3"]),
    ("WHAM", within(*WHAM, "betas")(lambda v: v[:2]), ["track 1", "betas", "2x10", "1x10"]),
    ("WHAM", within(*WHAM, "frame_ids")(lambda v: v[:3]), ["track 1", "frame_ids", "found 3, wanted 4"]),
    ("WHAM", within(*WHAM, "frame_ids")(lambda v: v + 0.5), ["track 1", "frame_ids", "row 0 has 0.5"]),
    ("WHAM", within(*WHAM, "frame_ids")(lambda v: v - 1), ["track 1", "frame_ids", "row 0 has -1"]),
    ("WHAM", within(*WHAM)(put(None)), ["track 1", "no named values", "NoneType"]),
    ("WHAM", within(*WHAM, "pose")(put(np.zeros((0, 72)))), ["track 1", "pose", "no rows"]),
    # GVHMR
    ("GVHMR", within(*INCAM, "transl")(gone), ["smpl_params_incam", "no transl", "body_pose"]),
    ("GVHMR", within(*INCAM, "body_pose")(lambda v: v[:, :60]), ["body_pose", "12x60", "12x63"]),
    ("GVHMR", within(*INCAM, "global_orient")(nan), ["global_orient", "[0, 1]", "nan"]),
    ("GVHMR", within("K_fullimg")(lambda v: v[:2]), ["K_fullimg", "2x3x3", "12x3x3"]),
    ("GVHMR", within("K_fullimg")(with_number(-5, slice(None), 0, 0)), ["focal length"]),
    ("GVHMR", within("K_fullimg")(with_number(0, slice(None), 0, 2)), ["without a size", "found 0"]),
    ("GVHMR", within("smpl_params_incam")(put(torch.zeros(3))), ["smpl_params_incam", "no named values"]),
    # TRAM
    ("TRAM", within("camera", "img_focal")(put(0.0)), ["camera.npy", "focal length"]),
    ("TRAM", within("camera", "img_center")(put(np.ones(3))), ["camera.npy", "img_center", "found 3, wanted 2"]),
    ("TRAM", within("camera", "img_center")(put(np.array([64.0, 48]))), ["another shape", "128x96"]),
    ("TRAM", within(*TRAM, "pred_rotmat")(lambda v: -v), ["hps_track_1.npy", "pred_rotmat", "determinant -1"]),
    ("TRAM", within(*TRAM, "pred_trans")(lambda v: v[:, 0]), ["hps_track_1.npy", "pred_trans", "4x3", "4x1x3"]),
    ("TRAM", within(*TRAM, "frame")(gone), ["hps_track_1.npy", "no frame"]),
    ("TRAM", within("tracks")(put([])), ["holds no poses"]),
    # EasyMocap
    ("EasyMocap", within(0, 1, "Th")(gone), ["000000.json", "no Th", "Rh"]),
    ("EasyMocap", within(0, 1, "id")(put(None)), ["000000.json", "names nobody"]),
    ("EasyMocap", within(0, 1, "poses")(lambda v: [v[0][:60]]), ["000000.json", "poses", "1x60", "1x69"]),
    ("EasyMocap", within(0, 1, "Th")(put([[1, 2], [3]])), ["000000.json", "Th", "a list"]),
    ("EasyMocap", within(0, 1, "Rh")(put([[float("nan")] * 3])), ["000000.json", "Rh", "nan"]),
    ("EasyMocap", within(0)(put("[{")), ["000000.json", "JSON"]),
    ("EasyMocap", within(0)(put({"a": 1})), ["000000.json", "a dict"]),
    # AMASS and the plain family
    ("AMASS", within("poses")(lambda v: v[:, :150]), ["poses", "4x150", "4x72"]),
    ("AMASS", within("mocap_framerate")(put(0.0)), ["mocap_framerate", "not a frame rate", "0"]),
    ("AMASS", within("betas")(gone), ["no betas", "mocap_framerate"]),
    ("AMASS", within("trans")(put(np.zeros((0, 3)))), ["holds no poses", "trans"]),
    ("AMASS SMPL-X", within("trans")(nan), ["trans", "[0, 1]", "nan"]),
    ("plain", lambda c: {**c, "names": c["names"][:2]}, ["names", "(2,)", "4"]),
    ("plain", lambda c: {k: v for k, v in c.items() if k != "names"} | {"times": np.zeros(4)}, ["times", "row 1"]),
    ("plain", within("transl")(gone), ["no transl", "body_pose"]),
):
    MALFORMED.append(pytest.param(tool, spoil, words, id=f"{tool}: {', '.join(words)}"))


@pytest.mark.parametrize("tool,spoil,words", MALFORMED)
def test_one_thing_wrong_is_named(tmp_path, truth, whole, tool, spoil, words):
    path = fits.write(tool, spoil(copy.deepcopy(whole[tool])), tmp_path)
    with pytest.raises(StageError) as caught:
        read_smpl_fit(path, truth.size)
    said = "\n".join([caught.value.problem, *caught.value.facts])
    assert all(word in said for word in words), said
    assert str(path) in said, said
    assert caught.value.hint and caught.value.problem[-1] != "."


@pytest.mark.parametrize("tool", [t for t, name in fits.FILES.items() if "." in name])
def test_damaged_files_are_refused(tmp_path, truth, whole, tool):
    path = fits.write(tool, whole[tool], tmp_path)
    data = path.read_bytes()
    for damaged in (b"", data[: len(data) // 2], b"hello", bytes(100)):
        path.write_bytes(damaged)
        with pytest.raises(StageError) as caught:
            read_smpl_fit(path, truth.size)
        assert str(path) in caught.value.problem and caught.value.hint, damaged[:10]


class Bomb:
    def __init__(self, sign):
        self.sign = sign

    def __reduce__(self):
        return os.system, (f"touch {self.sign}",)


@pytest.mark.parametrize("tool", ["PHALP", "GVHMR", "TRAM", "ROMP v1 video"])  # test_untrusted.py tries the others
def test_nothing_in_a_file_is_run(tmp_path, truth, whole, tool):
    sign = tmp_path / "ran"
    content = copy.deepcopy(whole[tool])
    target = content["camera"] if tool == "TRAM" else content
    target["bomb"] = np.array([Bomb(sign)], object) if tool == "plain" else Bomb(sign)
    path = fits.write(tool, content, tmp_path)
    with pytest.raises(StageError) as caught:
        read_smpl_fit(path, truth.size)
    assert "refused" in caught.value.facts[0] and not sign.exists()
    pickle.loads(pickle.dumps(Bomb(sign)))
    assert sign.exists()  # it would have worked


@pytest.mark.parametrize("kind", ["other pickle", "list", "one track of TRAM", "empty folder", "missing", "other npz"])
def test_what_is_no_fit_is_said_with_what_it_holds(tmp_path, truth, whole, kind):
    path = tmp_path / "thing"
    if kind == "other pickle":
        path.write_bytes(pickle.dumps({"weather": 3}))
    elif kind == "list":
        path.write_bytes(pickle.dumps([1, 2]))
    elif kind == "one track of TRAM":
        path = fits.write("TRAM", whole["TRAM"], tmp_path) / "hps" / "hps_track_0.npy"
    elif kind == "empty folder":
        path.mkdir()
    elif kind == "other npz":
        path = tmp_path / "thing.npz"
        np.savez(path, weather=3)
    with pytest.raises(StageError) as caught:
        read_smpl_fit(path, truth.size)
    said = "\n".join([caught.value.problem, *caught.value.facts, caught.value.hint])
    wanted = {"one track of TRAM": "camera.npy and hps/", "missing": "no file", "empty folder": "found nothing"}
    assert str(path) in said and wanted.get(kind, "weather" if "other" in kind else "no named values") in said


def test_a_fit_of_another_video_has_no_rows(truth, whole, tmp_path):
    for tool in ("WHAM", "GVHMR", "AMASS", "EasyMocap"):
        fit = read_smpl_fit(fits.write(tool, whole[tool], tmp_path), truth.size)
        names = [f"{n:06d}" for n in range(1000, 1040)]
        with pytest.raises(StageError, match="40 of 40 frames") as caught:
            join_frames(fit, fits.listed(names, np.arange(1000, 1040) / 30))
        assert holds(caught.value.facts[0], "001000", "001039", 40)
