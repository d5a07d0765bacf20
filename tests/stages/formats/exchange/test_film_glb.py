"""A film as glTF: people with a motion and a size of their own."""

import numpy as np

from stages.avatar.drawing.rig import rig_of
from stages.avatar.motion.takes import made_takes
from stages.formats.body_model import read_body_model
from stages.formats.exchange.film_glb import write_film_glb
from stages.formats.exchange.glb import Glb
from tests.made.gltf import array
from tests.made.meshes import body_mesh
from tests.made.tiny import make_avatar, make_scene

MODEL = read_body_model()


def test_in_a_film_each_person_has_a_motion_and_a_size_of_their_own(tmp_path):
    rig, mesh = rig_of(make_avatar(MODEL, every=20)), body_mesh(MODEL)
    takes = made_takes(rig.joints[0])[:2]
    places, quat = ([0.5, 0.0, 1.0], [-2.0, 0.0, 0.0]), [0.0, 0.0, 0.0, 1.0]
    figures = [(f"p{k}", rig, mesh, take, (places[k], quat, 1.0 + k)) for k, take in enumerate(takes)]
    write_film_glb(tmp_path / "a.glb", figures, make_scene())
    glb = Glb(tmp_path / "a.glb")
    (moves,), nodes = glb.content["animations"], glb.content["nodes"]
    for k, take in enumerate(takes):
        (stand,) = (node for node in nodes if node["name"] == f"p{k}")
        assert stand["translation"] == places[k] and stand["scale"] == [1.0 + k] * 3
        (root,) = (c for c in moves["channels"] if c["target"] == {"node": stand["children"][0], "path": "translation"})
        sampler = moves["samplers"][root["sampler"]]
        np.testing.assert_allclose(array(glb, sampler["output"]), take.pelvis, atol=1e-6)
        np.testing.assert_allclose(array(glb, sampler["input"])[:, 0], take.times, atol=1e-6)
    assert [mesh["name"] for mesh in glb.content["meshes"]] == ["p0 body", "p1 body", "scene"]
    assert len({skin["skeleton"] for skin in glb.content["skins"]}) == 2
