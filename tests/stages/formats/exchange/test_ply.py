"""Gaussians as .ply: the layout that viewers read, and what cannot be written."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.avatar.splats.gaussians import finite_rows
from stages.contract import StageError
from stages.formats.exchange import ply
from stages.formats.exchange.ply import REQUIRED, read_ply, write_ply
from stages.records import Scene
from tests.made.said import holds


def scene(n=5, bases=4, **changes):
    rng = np.random.default_rng(0)
    parts = {
        "means": rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.01, 0.1, (n, 3)),
        "opacities": rng.uniform(0.1, 0.9, n),
        "sh0": rng.normal(size=(n, 3)),
        "shN": rng.normal(size=(n, bases - 1, 3)),
    }
    return Scene(**{k: v.astype(np.float32) for k, v in (parts | changes).items()})


def read(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))


def test_l07_l09_every_column_stands_where_viewers_look_for_it(tmp_path):
    splats = scene()
    assert write_ply(tmp_path / "a.ply", splats) == {}
    found = read(tmp_path / "a.ply")
    assert len(found) == 62, "degree 3: many viewers take nothing else"
    np.testing.assert_allclose(np.stack([found[c] for c in "xyz"], 1), splats.means)
    np.testing.assert_allclose(np.stack([found[f"rot_{i}"] for i in range(4)], 1), splats.quats)
    np.testing.assert_allclose(np.exp(np.stack([found[f"scale_{i}"] for i in range(3)], 1)), splats.scales, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found["opacity"])), splats.opacities, rtol=1e-5)
    rest = np.stack([found[f"f_rest_{i}"] for i in range(45)], 1).reshape(-1, 3, 15)
    np.testing.assert_allclose(rest[:, :, :3], splats.shN.transpose(0, 2, 1))
    assert (rest[:, :, 3:] == 0).all()


def test_l02_opacities_without_a_logit_are_bounded_and_counted(tmp_path):
    ((what, count),) = write_ply(tmp_path / "a.ply", scene(opacities=np.array([0, 1, 0.5, 0.5, 0.5]))).items()
    assert count == 2 and holds(what, "opacities", 15)
    assert read(tmp_path / "a.ply")["opacity"].tolist() == [-15, 15, 0, 0, 0]


def test_l10_a_scale_that_is_not_positive_is_refused_by_row(tmp_path):
    scales = np.full((5, 3), 0.1)
    scales[3, 1] = 0
    with pytest.raises(StageError) as refused:
        write_ply(tmp_path / "a.ply", scene(scales=scales))
    assert "row 3" in refused.value.facts[0] and not (tmp_path / "a.ply").exists()


def test_l01_an_opacity_out_of_range_is_refused_by_row(tmp_path):
    with pytest.raises(StageError) as refused:
        write_ply(tmp_path / "a.ply", scene(opacities=np.array([0.5, 0.5, 1.5, 0.5, np.nan])))
    assert "row 2" in refused.value.facts[0]


@pytest.mark.parametrize("degree", [0, 3])
def test_l04_rows_that_are_left_out_take_their_coefficients_along(tmp_path, degree):
    splats = scene(bases=(degree + 1) ** 2)
    splats.scales[2, 1] = np.nan
    parts = {name: part for name, part in vars(splats).items() if isinstance(part, np.ndarray)}
    kept = finite_rows(map(torch.as_tensor, parts.values())).numpy()
    assert kept.tolist() == [True, True, False, True, True]
    write_ply(tmp_path / "a.ply", Scene(**{name: part[kept] for name, part in parts.items()}))
    found = read(tmp_path / "a.ply")
    rest = np.stack([found[f"f_rest_{i}"] for i in range(45)], 1).reshape(-1, 3, 15)[:, :, : splats.shN.shape[1]]
    np.testing.assert_array_equal(rest, splats.shN[kept].transpose(0, 2, 1))


def test_l05_no_gaussians_is_a_valid_file(tmp_path):
    assert write_ply(tmp_path / "a.ply", scene(0)) == {}
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes() and len(read(tmp_path / "a.ply")["x"]) == 0


def test_l06_memory_does_not_grow_with_the_file(tmp_path, held):
    peaks = []
    for n in (100_000, 200_000):
        splats = scene(n)
        tracemalloc.start()
        write_ply(tmp_path / "a.ply", splats)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (tmp_path / "a.ply").stat().st_size > 200_000 * 248
    held((peaks[1] - peaks[0]) / 100_000, 40, "bytes a row of 248")


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_what_is_written_is_read(tmp_path, bases):
    splats = scene(1000, bases)
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    for name in ("means", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(back, name), getattr(splats, name))
    np.testing.assert_allclose(back.scales, splats.scales, rtol=2e-6)
    np.testing.assert_allclose(back.opacities, splats.opacities, atol=1e-6)
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(back.quats, unit, atol=1e-6)


def foreign(path, columns, n=4, kind="float", more="", rows=None):
    """A PLY as some other trainer writes it: these columns, in this order, 0.5 in all of them."""
    table = np.full((n, len(columns)), 0.5, {"float": "<f4", "double": "<f8"}[kind])
    for (row, name), value in (rows or {}).items():
        table[row, columns.index(name)] = value
    head = ["ply", "format binary_little_endian 1.0", "comment made elsewhere", f"element vertex {n}"]
    head += [f"property {kind} {name}" for name in columns]
    path.write_bytes(("\n".join([*head, *filter(None, [more]), "end_header"]) + "\n").encode() + table.tobytes())
    return path


@pytest.mark.parametrize(("kind", "degree"), [("float", 0), ("float", 2), ("double", 1)])
def test_other_trainers_columns_stand_in_other_orders(tmp_path, kind, degree):
    higher = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    columns = [*REQUIRED[::-1], "semantic_0", *higher]
    path = foreign(tmp_path / "a.ply", columns, kind=kind, rows={(2, "y"): -3, (1, "opacity"): np.inf})
    back = read_ply(path)
    assert back.means[2].tolist() == [0.5, -3, 0.5] and back.opacities[1] == 1
    assert back.shN.shape == (4, (degree + 1) ** 2 - 1, 3) and np.linalg.norm(back.quats[0]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"columns": REQUIRED[:-1]}, "missing: rot_3"),
        ({"columns": [*REQUIRED, *(f"f_rest_{i}" for i in range(10))]}, "unknown degree"),
        ({"columns": [*REQUIRED, "x"]}, "header"),
        ({"columns": ["packed_position"]}, "compressed"),
        ({"more": "property list uchar int faces"}, "header"),
        ({"rows": {(3, "z"): np.nan}}, "row 3"),
        ({"rows": {(1, "scale_0"): 1e4}}, "row 1"),
        ({"rows": {(2, f"rot_{i}"): 0 for i in range(4)}}, "row 2"),
        ({"rows": {(0, "x"): 1e300}, "kind": "double"}, "row 0"),
    ],
)
def test_what_is_no_set_of_gaussians_is_refused(tmp_path, change, said):
    path = foreign(tmp_path / "a.ply", **({"columns": list(REQUIRED)} | change))
    with pytest.raises(StageError) as refused:
        read_ply(path)
    assert said in f"{refused.value} {' '.join(refused.value.facts)}" and "a.ply" in str(refused.value)


@pytest.mark.parametrize(
    ("rows", "share"),
    [
        ({(17, "x"): np.nan, (60, "scale_1"): -np.inf}, "2 of 200"),
        ({(5, f"rot_{i}"): 0 for i in range(4)}, "1 of 200"),
        ({(i, "scale_2"): 1e4 for i in range(10)}, "10 of 200"),
        ({(i, "f_dc_1"): np.inf for i in range(11)}, None),
    ],
)
def test_a_few_rows_that_cannot_be_drawn_are_left_out_and_said(tmp_path, rows, share):
    path = foreign(tmp_path / "a.ply", list(REQUIRED), n=200, rows=rows | {(i, "y"): i for i in range(200)})
    wrong = sorted({row for row, _ in rows})
    if share is None:
        with pytest.raises(StageError, match="11 Gaussians of 200") as refused:
            read_ply(path)
        assert "5%" in refused.value.facts[-1]
        return
    back = read_ply(path)
    assert len(back.said) == 1 and holds(back.said[0], "a.ply", share, ", ".join(map(str, wrong)))
    np.testing.assert_array_equal(back.means[:, 1], np.delete(np.arange(200), wrong))


def as_written(path, table, form, newline="\n", comments=(), before=(), after=()):
    """A PLY of these columns in any form; `before` and `after` the vertices elements of two rows: (name, kind, values)."""

    def promised(name, kind, values):
        lists = ["property list uchar int n"] if kind == "list" else [f"property {kind} v"]
        return [f"element {name} {len(values)}", *lists]

    def content(kind, values):
        if form == "ascii":
            return "".join(
                f"{len(v)} {' '.join(map(str, v))}\n" if kind == "list" else f"{v}\n" for v in values
            ).encode()
        order = ">" if "big" in form else "<"
        if kind == "list":
            return b"".join(bytes([len(v)]) + np.array(v, f"{order}i4").tobytes() for v in values)
        return np.array(values, {"float": f"{order}f4", "uchar": "u1"}[kind]).tobytes()

    rows = np.stack(list(table.values()), 1)
    head = ["ply", f"format {form} 1.0", *(f"comment {text}" for text in comments)]
    head += [line for one in before for line in promised(*one)]
    head += [f"element vertex {len(rows)}", *(f"property float {name}" for name in table)]
    head += [line for one in after for line in promised(*one)]
    text = "".join(" ".join(repr(float(x)) for x in row) + newline for row in rows).encode()
    body = text if form == "ascii" else rows.astype(">f4" if "big" in form else "<f4").tobytes()
    parts = [content(kind, values) for _, kind, values in before] + [body]
    parts += [content(kind, values) for _, kind, values in after]
    path.write_bytes((newline.join([*head, "end_header"]) + newline).encode() + b"".join(parts))
    return path


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
FLOATS, SHORT, LISTS = (
    ("extrinsic", "float", [1.5, 2]),
    ("version", "uchar", [1, 13, 10]),
    ("face", "list", [[1, 2], [3]]),
)


def columns_of(n=300, names=REQUIRED):
    rng = np.random.default_rng(3)
    return {name: rng.normal(size=n).astype(np.float32) for name in names}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("before", "after"),
    [((), ()), ((), (FLOATS, SHORT)), ((SHORT, FLOATS), ()), ((FLOATS,), (LISTS, SHORT)), ((LISTS,), (SHORT,))],
)
def test_every_form_with_any_other_elements_is_read(tmp_path, form, newline, before, after):
    table = columns_of()
    path = as_written(tmp_path / "a.ply", table, form, newline, before=before, after=after)
    if before == (LISTS,) and form != "ascii":
        with pytest.raises(StageError, match="header") as refused:
            read_ply(path)
        assert "lists" in refused.value.facts[0]
        return
    if newline == "\r" and form == "ascii" and before:
        return  # lines that Python does not part are not skipped
    back = read_ply(path)
    for column, name in enumerate("xyz"):
        np.testing.assert_array_equal(back.means[:, column], table[name])
    np.testing.assert_allclose(back.scales[:, 2], np.exp(table["scale_2"]), rtol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_one_row_more_or_less_than_promised_is_refused_in_every_form(tmp_path, form):
    path = as_written(tmp_path / "a.ply", columns_of(), form)
    for count in (b"299", b"301", b"99999999999"):
        path.with_name("b.ply").write_bytes(path.read_bytes().replace(b"vertex 300", b"vertex " + count, 1))
        with pytest.raises(StageError, match=r"b\.ply.*length"):
            read_ply(path.with_name("b.ply"))


@pytest.mark.parametrize(
    ("comments", "antialias"),
    [
        ((), False),
        (("Exported from Brush", "SplatRenderMode: mip"), True),
        (("SPLATRENDERMODE:  MIP ",), True),
        (("SplatRenderMode: default",), False),
        (("antialiased 1",), True),
        (("antialiased 0",), False),
        (("postshot.anti_aliasing=1",), True),
        (("postshot.anti_aliasing=0",), False),
        (("SplatRenderMode: mip", "antialiased 0"), False),
        (("is not SplatRenderMode: mip",), False),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_a_comment_says_that_they_were_learned_with_antialiasing(tmp_path, comments, antialias, newline):
    path = as_written(tmp_path / "a.ply", columns_of(), "binary_little_endian", newline, comments)
    assert read_ply(path).antialias is antialias


def test_what_we_write_says_so_and_is_as_before_without(tmp_path):
    for antialias in (False, True):
        write_ply(tmp_path / "a.ply", replace(scene(), antialias=antialias))
        assert read_ply(tmp_path / "a.ply").antialias is antialias
        assert (b"comment SplatRenderMode: mip\n" in (tmp_path / "a.ply").read_bytes()) is antialias


def test_gaussians_with_a_filter_are_as_wide_and_faint_as_what_was_learned(tmp_path):
    """Mip-Splatting's smoothing, as a convolution on a grid: the same integral, and the width of both together."""
    table = columns_of() | {"filter_3D": np.full(300, 0.4, np.float32)}
    table |= {f"scale_{axis}": 0.3 * table[f"scale_{axis}"] for axis in range(3)}
    back = read_ply(as_written(tmp_path / "a.ply", table, "ascii"))
    x = np.linspace(-12, 12, 4801)
    assert back.antialias
    for row in (3, 70, 200):
        opacity = 1 / (1 + np.exp(-table["opacity"][row]))
        for axis in range(3):
            own = np.exp(-0.5 * (x / np.exp(table[f"scale_{axis}"][row])) ** 2)
            smooth = np.exp(-0.5 * (x / 0.4) ** 2)
            wide = np.convolve(own, smooth / smooth.sum(), "same")
            opacity *= wide.max()
            width = np.sqrt((wide * x**2).sum() / wide.sum())
            assert back.scales[row, axis] == pytest.approx(width, rel=2e-2)
        assert back.opacities[row] == pytest.approx(opacity, rel=2e-2)


def test_flat_gaussians_are_thin_discs_across_their_third_axis_and_said(tmp_path):
    table = columns_of(names=[name for name in REQUIRED if name != "scale_2"])
    back = read_ply(as_written(tmp_path / "a.ply", table, "binary_little_endian"))
    assert holds(" ".join(back.said), "a.ply", "2D", "discs", "0.001")
    two = np.exp(np.stack([table["scale_0"], table["scale_1"]], 1))
    np.testing.assert_allclose(back.scales, np.column_stack([two, two.min(1) / 1000]), rtol=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"vertex 4", b"vertex 5", "another length"),
        (b"vertex 4", b"vertex 3", "another length"),
        (b"vertex 4", b"vertex 99999999999", "another length"),
        (b"vertex 4", b"vertex -4", "header"),
        (b"vertex 4", b"vertex " + b"9" * 5000, "header"),
        (b"vertex 4", b"vertices 4", "header"),
        (b"binary_little_endian", b"binary_middle_endian", "unknown form"),
        (b"binary_little_endian", b"ascii", "another length"),
        (b"end_header", b"endheader", "no PLY"),
        (b"ply\n", b"plx\n", "no PLY"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path, old, new, said):
    path = foreign(tmp_path / "a.ply", list(REQUIRED))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(StageError) as refused:
        read_ply(path)
    assert said in f"{refused.value} {' '.join(refused.value.facts)}"


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(StageError, match="cannot read"):
        read_ply(tmp_path / "a.ply")


def test_without_padding_it_has_the_columns_that_it_needs(tmp_path):
    for bases, columns in ((1, 17), (4, 26)):
        write_ply(tmp_path / "a.ply", scene(bases=bases), padded=False)
        assert len(read(tmp_path / "a.ply")) == columns
        np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").shN, scene(bases=bases).shN)


def test_opacities_at_their_bounds_are_counted_in_all_of_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK", 4)
    opacities = np.full(19, 0.5)
    opacities[[0, 3, 4, 17]] = [0, 1, 1, 0]
    assert list(write_ply(tmp_path / "a.ply", scene(19, opacities=opacities)).values()) == [4]
