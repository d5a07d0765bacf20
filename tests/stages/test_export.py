"""Files for other programs, read back without our reader."""

from dataclasses import replace

import numpy as np
import pytest

from stages import export
from stages.contract import Job
from stages.formats.splats import read_avatar, write_splats
from stages.records import Clothes


def read(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    return np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))


def test_person_and_scene_are_written_for_viewers(tiny, tmp_path):
    said = []
    export.run(Job(tmp_path, emit=lambda e: said.append(e["text"])), export.Params(), train=tiny["train"])
    avatar, person, scene = (
        read_avatar(tmp_path / "avatar.npz"),
        read(tmp_path / "avatar.ply"),
        read(tmp_path / "scene.ply"),
    )
    assert len(person) == len(avatar) and person["y"].max() - person["y"].min() > 1.2, "canonical pose, metres, y up"
    np.testing.assert_array_equal(np.stack([person[c] for c in "xyz"], 1), avatar.means)
    assert scene["z"].min() > 4.4 and said == [f"avatar {len(person)} Gaussians, scene {len(scene)}"]
    assert (tmp_path / "avatar.npz").read_bytes() == (tiny["train"] / "avatar.npz").read_bytes()


def test_a_person_only_has_no_scene_file(tiny_human, tmp_path):
    export.run(Job(tmp_path), export.Params(), train=tiny_human["train"])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["avatar.npz", "avatar.ply"]


def test_what_a_viewer_cannot_show_is_said(tiny, tmp_path):
    avatar, said = read_avatar(tiny["train"] / "avatar.npz"), []
    clothes = Clothes(*(np.zeros(s) for s in ((2, 3), 69, (69, 1), 1)), np.array([2.0]), np.full((2, 3, 1), 0.01))
    write_splats(tmp_path / "avatar.npz", replace(avatar, antialias=True, clothes=clothes))
    out = tmp_path / "out"
    out.mkdir()
    export.run(Job(out, emit=lambda e: said.append(e["text"])), export.Params(), train=tmp_path)
    assert "up to 3.5 cm" in said[1] and "anti-aliasing" in said[2]
    assert read_avatar(out / "avatar.npz").clothes.largest == pytest.approx(clothes.largest)
