"""Body models: every SMPL file is the same body, no pickle runs code, and the free body is a person."""

import copyreg
import pickle
import sys
import tracemalloc
import types

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.body_model import FREE_BODY, read_body_model, write_body_model
from stages.formats.tool_pickles import read_named
from tests.made.said import holds
from tests.made.skeleton import PARENTS

V = 40


def smpl_arrays(components=10, joints=24, vertices=V):
    rng = np.random.default_rng(0)
    parents = np.array(PARENTS) % 2**32
    weights, regressor = rng.random((vertices, joints)), rng.random((joints, vertices))
    regressor[regressor < 0.7] = 0
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "f": rng.integers(0, vertices, (2 * vertices, 3)).astype(np.uint32),
        "shapedirs": rng.normal(size=(vertices, 3, components)),
        "posedirs": rng.normal(size=(vertices, 3, 207)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(24)]).astype(np.uint32),
    }


@pytest.fixture
def chumpy(monkeypatch):
    """Classes that pickle under chumpy's and old scipy's names, present only while the test writes its pickle."""

    def module(name, *classes):
        made = types.ModuleType(name)
        for cls in classes:
            setattr(made, cls, type(cls, (), {"__module__": name}))
        monkeypatch.setitem(sys.modules, name, made)
        return made

    module("chumpy")
    return types.SimpleNamespace(
        Ch=module("chumpy.ch", "Ch").Ch,
        Select=module("chumpy.reordering", "Select").Select,
        csc=module("scipy.sparse.csc", "csc_matrix").csc_matrix,
        forget=lambda: [monkeypatch.delitem(sys.modules, m) for m in ("chumpy", "chumpy.ch", "chumpy.reordering")],
    )


def made(cls, **state):
    thing = cls()
    thing.__dict__.update(state)
    return thing


def dump(path, content, protocol=2):
    with open(path, "wb") as file:
        pickle.dump(content, file, protocol=protocol)
    return path


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_j09_reads_an_old_smpl_pickle_without_chumpy(tmp_path, chumpy, protocol):
    arrays = smpl_arrays(components=300)
    from scipy.sparse import csc_matrix

    sparse = csc_matrix(arrays["J_regressor"])
    old = dict(arrays, bs_type="lrotmin", bs_style="lbs")
    state = {"_dirty_vars": {"x"}, "_itr": None, "_make_dense": False}  # what chumpy's own __getstate__ leaves
    state["_depends_on_deps"] = {"J": {"deps": frozenset(["x"]), "value": None, "out_of_date": True}}
    old["shapedirs"] = made(chumpy.Ch, x=arrays["shapedirs"], **state)
    order = np.arange(V * 3)[::-1]
    shuffled = made(chumpy.Ch, x=arrays["v_template"].ravel()[::-1].copy())
    old["v_template"] = made(chumpy.Select, a=shuffled, idxs=order, preferred_shape=(V, 3))
    parts = {"data": sparse.data, "indices": sparse.indices, "indptr": sparse.indptr, "_shape": sparse.shape}
    old["J_regressor"] = made(chumpy.csc, format="csc", maxprint=50, **parts)
    path = dump(tmp_path / "basicModel_neutral.pkl", old, protocol)
    chumpy.forget()
    model = read_body_model(path)
    assert model.name == "basicModel_neutral" and model.parents[0] == -1 and model.parents[23] == 21
    assert model.shapedirs.shape == (V, 3, 10)
    for mine, theirs in (("v_template", "v_template"), ("J_regressor", "J_regressor"), ("lbs_weights", "weights")):
        assert np.allclose(getattr(model, mine), arrays[theirs], atol=1e-6), mine
    assert np.allclose(model.shapedirs, arrays["shapedirs"][..., :10], atol=1e-6)
    assert all(getattr(model, n).dtype == np.float32 for n in ("v_template", "shapedirs", "posedirs", "lbs_weights"))


@pytest.mark.parametrize("kind", ["csc", "csr", "coo", "dense"])
def test_j09_reads_every_form_of_the_joint_regressor(tmp_path, kind):
    import scipy.sparse

    arrays = smpl_arrays()
    stored = arrays["J_regressor"]
    if kind != "dense":
        stored = getattr(scipy.sparse, f"{kind}_matrix")(stored)
    path = dump(tmp_path / "SMPL.pkl", dict(arrays, J_regressor=stored))
    assert np.allclose(read_body_model(path).J_regressor, arrays["J_regressor"], atol=1e-6)


@pytest.mark.parametrize("components", [10, 300])
@pytest.mark.parametrize("kind", ["1.0 with chumpy", "1.0 cleaned", "1.1", "npz"])
@pytest.mark.parametrize("name", ["SMPL_NEUTRAL", "SMPL_MALE", "basicModel_f_lbs_10_207_0_v1.0.0"])
def test_every_smpl_file_is_the_same_body(tmp_path, chumpy, kind, components, name):
    """The three bodies of SMPL 1.0 and 1.1, as they are downloaded and as people clean or repack them."""
    from scipy.sparse import csc_matrix

    arrays = smpl_arrays(components=components)
    path = tmp_path / f"{name}{'.npz' if kind == 'npz' else '.pkl'}"
    if kind == "npz":
        np.savez(path, **arrays, bs_style="lbs", bs_type="lrotmin", J=np.zeros((24, 3)))
    else:
        file = dict(arrays, bs_style="lbs", bs_type="lrotmin", J=np.zeros((24, 3)))
        file["J_regressor"] = csc_matrix(arrays["J_regressor"])
        file |= {"J_regressor_prior": file["J_regressor"], "weights_prior": arrays["weights"]}
        file |= {"vert_sym_idxs": np.arange(V), "pose_training_info": {"date": "x", "subjects": ["a", {"b": 1.5}]}}
        if "chumpy" in kind:
            wrapped = ("shapedirs", "posedirs", "v_template", "weights")
            file |= {key: made(chumpy.Ch, x=arrays[key], _dirty_vars=set()) for key in wrapped}
        dump(path, file, protocol=4 if kind == "1.1" else 2)
    chumpy.forget()
    model = read_body_model(path)
    assert model.name == name and model.shapedirs.shape == (V, 3, 10)
    pairs = (("v_template", "v_template"), ("posedirs", "posedirs"), ("lbs_weights", "weights"))
    for mine, theirs in (*pairs, ("J_regressor", "J_regressor")):
        np.testing.assert_allclose(getattr(model, mine), arrays[theirs], atol=1e-6)
    np.testing.assert_allclose(model.shapedirs, arrays["shapedirs"][..., :10], atol=1e-6)


class Bomb:
    def __init__(self, callable_, *args):
        self.reduced = callable_, args

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_j09_runs_nothing(tmp_path, protocol):
    import builtins
    import os
    import subprocess

    sign = tmp_path / "ran"
    attacks = [
        Bomb(os.system, f"touch {sign}"),
        Bomb(subprocess.check_call, ["touch", str(sign)]),
        Bomb(builtins.eval, f"open({str(sign)!r}, 'w')"),
        Bomb(builtins.getattr, os, "system") if protocol == 4 else Bomb(builtins.exec, f"open({str(sign)!r}, 'w')"),
        Bomb(np.load, str(sign)),
        Bomb(copyreg._reconstructor, pickle.Unpickler, object, None),
    ]
    for number, attack in enumerate(attacks):
        try:
            path = dump(tmp_path / f"{number}.pkl", dict(smpl_arrays(), v_template=attack), protocol)
        except TypeError:  # a module cannot be pickled: the attack cannot even be written
            continue
        with pytest.raises(StageError) as caught:
            read_body_model(path)
        assert "refused" in caught.value.facts[0] or "rebuilds" in caught.value.facts[0]
        assert str(path) in caught.value.problem
    assert not sign.exists()


def test_the_attack_would_have_worked(tmp_path):
    import os

    sign = tmp_path / "ran"
    with open(dump(tmp_path / "a.pkl", Bomb(os.system, f"touch {sign}")), "rb") as file:
        pickle.load(file)
    assert sign.exists()


@pytest.mark.parametrize("cut", [0, 10, 2000])
def test_j09_a_truncated_pickle_is_refused(tmp_path, cut):
    whole = dump(tmp_path / "a.pkl", smpl_arrays()).read_bytes()
    (tmp_path / "b.pkl").write_bytes(whole[:cut])
    with pytest.raises(StageError, match=r"b\.pkl"):
        read_body_model(tmp_path / "b.pkl")


def test_numbers_that_cannot_be_read_are_named(tmp_path, chumpy):
    path = dump(tmp_path / "a.pkl", dict(smpl_arrays(), shapedirs=made(chumpy.Ch, y=3)))
    with pytest.raises(StageError, match="shapedirs in"):
        read_body_model(path)


def test_what_small_pickles_stand_for_is_made_once_and_within_a_budget(tmp_path, chumpy):
    """Names may share one object, lists one array, and a sparse matrix says any shape."""
    few = np.zeros(1 << 16)
    one = made(chumpy.Select, a=[1.0], idxs=np.zeros(1 << 20, np.int64))
    grown = [made(chumpy.Select, a=[1.0], idxs=few.astype(np.int64)) for _ in range(3)]
    data = {
        "shared": {f"k{i}": one for i in range(2000)},
        "apart": {f"k{i}": made(chumpy.Select, a=[1.0], idxs=made(chumpy.Ch, x=grown)) for i in range(2)},
        "listed": {"k": [few] * 4000},
        "nested": {"k": made(chumpy.Ch, x=[[few] * 60] * 60)},
        "letters": {"k": made(chumpy.csc, data=np.zeros(1, "S9999"), indices=[0], indptr=[0, 1], _shape=(4096, 4096))},
        "dense": {f"k{i}": made(chumpy.csc, data=np.zeros(1), indices=[0], indptr=[0, 1], _shape=(1 << 12, 1 << 12))
                  for i in range(12)},
        "texts": {"k": made(chumpy.csc, data=np.zeros(1, "S3"), indices=[0], indptr=[0, 1, 1], _shape=(2, 2))},
        "words": {"k": made(chumpy.Ch, x=np.array(["a" * 99]))},
    }  # fmt: skip
    paths = {name: dump(tmp_path / f"{name}.pkl", content) for name, content in data.items()}
    chumpy.forget()
    found = read_named(paths.pop("shared"))
    assert len(found) == 2000 and len({id(array) for array in found.values()}) == 1
    tracemalloc.start()
    for name, path in paths.items():
        with pytest.raises(StageError, match=r"memory|read") as refused:
            read_named(path)
        assert name not in ("listed", "nested", "dense") or "memory" in refused.value.problem
        assert tracemalloc.get_traced_memory()[1] < 1.3e9, name
    tracemalloc.stop()


def broken(**changes):
    return {k: v for k, v in (smpl_arrays() | changes).items() if v is not None}


def with_parent(joint, parent):
    table = smpl_arrays()["kintree_table"]
    table[0, joint] = parent
    return table


def bad_number(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    "arrays,words",
    [
        (broken(posedirs=None), ["no posedirs", "v_template"]),
        (broken(posedirs=np.zeros((V, 3, 459))), ["posedirs", f"{V}x3x459", f"{V}x3x207"]),
        (broken(shapedirs=np.zeros((V, 3, 4))), ["shapedirs", f"{V}x3x4", f"{V}x3x10"]),
        (broken(weights=np.zeros((V, 24))), ["weights", "vertex 0", "0.0000"]),
        (broken(J_regressor=np.zeros((16, V))), ["MANO", "16 joints", "SMPL_NEUTRAL.pkl"]),
        (broken(kintree_table=with_parent(5, 9)), ["kintree_table", "joint 5", "parent 9"]),
        (broken(kintree_table=with_parent(0, 1)), ["kintree_table", "joint 0", "parent 1"]),
        (broken(f=np.full((3, 3), V)), ["faces", f"{V} vertices"]),
        (broken(v_template=bad_number(smpl_arrays()["v_template"], (3, 1), np.nan)), ["v_template", "[3, 1]", "nan"]),
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_j09_refuses_by_key_and_shape(tmp_path, arrays, words, suffix):
    path = tmp_path / f"model{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        dump(path, arrays)
    with pytest.raises(StageError) as caught:
        read_body_model(path)
    said = "\n".join([caught.value.problem, *caught.value.facts, caught.value.hint])
    assert all(word in said for word in [*words, str(path)]), said


def test_j09_k06_refuses_missing_files_and_pickled_npz(tmp_path):
    with pytest.raises(StageError, match="no body model"):
        read_body_model(tmp_path / "none.pkl")
    np.savez(tmp_path / "a.npz", **dict(smpl_arrays(), v_template=np.array([{"a": 1}], dtype=object)))
    with pytest.raises(StageError, match="'v_template'"):
        read_body_model(tmp_path / "a.npz")


@pytest.mark.parametrize("joint, parent", [(5, 9), (0, 1), (7, 7), (9, 2**32 - 1)])
def test_e15_only_a_tree_with_each_parent_before_its_child_is_read(tmp_path, joint, parent):
    """The root's parent is stored as 4294967295, which is -1 in uint32."""
    np.savez(tmp_path / "model.npz", **smpl_arrays())
    assert (
        smpl_arrays()["kintree_table"][0, 0] == 2**32 - 1 and read_body_model(tmp_path / "model.npz").parents[0] == -1
    )
    np.savez(tmp_path / "model.npz", **broken(kintree_table=with_parent(joint, parent)))
    with pytest.raises(StageError, match="kintree_table") as refused:
        read_body_model(tmp_path / "model.npz")
    assert holds(*refused.value.facts, f"joint {joint}", f"parent {-1 if parent > 23 else parent}")


def test_written_models_come_back(tmp_path):
    model = read_body_model(dump(tmp_path / "SMPL_NEUTRAL.pkl", smpl_arrays()))
    write_body_model(tmp_path / "body_model.npz", model)
    again = read_body_model(tmp_path / "body_model.npz")
    for name in ("v_template", "faces", "shapedirs", "posedirs", "J_regressor", "lbs_weights", "parents"):
        assert np.allclose(getattr(again, name), getattr(model, name), atol=1e-7), name
    assert again.name == "SMPL_NEUTRAL" and again.keypoint_regressor is None
    names, matrix = again.landmark_regressor()
    assert names[names.index("left_knee")] == "left_knee" and matrix.shape == (14, V)
    assert np.array_equal(matrix[names.index("left_knee")], again.J_regressor[4])


def test_the_free_body_is_a_person():
    model = read_body_model()
    assert model.v_template.shape == (6890, 3) and model.faces.shape == (13776, 3)
    assert FREE_BODY.stat().st_size <= 1_000_000
    height = np.ptp(model.v_template[:, 1])
    assert 1.65 < height < 1.95
    names, matrix = model.landmark_regressor()
    assert {"nose", "left_ear", "right_wrist", "left_heel", "right_big_toe"} <= set(names)
    points = dict(zip(names, matrix @ model.v_template, strict=True))
    assert points["left_wrist"][0] > 0.5 and points["right_wrist"][0] < -0.5  # T-pose, its left at +x
    assert points["nose"][2] > points["left_ear"][2] + 0.05  # facing +z
    assert points["left_heel"][1] < points["left_knee"][1] < points["left_hip"][1] < points["nose"][1]
    joints = model.J_regressor @ model.v_template
    for part, joint in (("knee", 4), ("ankle", 7), ("shoulder", 16), ("elbow", 18), ("wrist", 20)):
        assert np.linalg.norm(points[f"left_{part}"] - joints[joint]) < 0.05, part
    assert np.allclose(model.J_regressor.sum(1), 1, atol=1e-3) and np.allclose(matrix.sum(1), 1, atol=1e-3)
    edges = np.sort(model.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert (counts == 2).all()  # closed


def test_the_free_body_is_built_as_its_reference(clips):
    """An earlier bake of the same recipe: joints agree to some cm once both are as tall."""
    ours, theirs = read_body_model(), read_body_model(clips / "body" / "free_body_smpl.npz")
    joints = [m.J_regressor @ m.v_template / np.ptp(m.v_template[:, 1]) * 1.7 for m in (ours, theirs)]
    off = np.linalg.norm(joints[0] - joints[1], axis=1)
    assert np.delete(off, [10, 11]).max() < 0.03  # the feet's joint was moved to the ball of the foot
    assert set(ours.keypoint_names) == set(theirs.keypoint_names)


@pytest.mark.parametrize("change", [-8, 8])
def test_an_array_that_is_longer_or_shorter_than_its_shape_is_refused_before_numpy_sees_it(tmp_path, change):
    data = pickle.dumps({"f": np.arange(4.0)}, 2)
    content = np.arange(4.0).tobytes().decode("latin1").encode()
    assert data.count(content) == 1
    longer = (np.arange(4 + change // 8) * 1.0).tobytes().decode("latin1").encode()
    size = lambda text: len(text).to_bytes(4, "little")  # noqa: E731
    lie = data.replace(size(content) + content, size(longer) + longer)
    (tmp_path / "a.pkl").write_bytes(lie)
    with pytest.raises(StageError) as refused:
        read_named(tmp_path / "a.pkl")
    assert len(refused.value.facts) == 1 and holds(refused.value.facts[0], 32, "float64 (4,)", 32 + change)
