"""Digests of code: what counts, what does not, and how imports are followed."""

from __future__ import annotations

import ast
import errno
import os
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hugs_cli.cache.fingerprint import Code, content_digest, digest, file_digest, files_under, look_into, stat_digest

BASE = '''
"""Doc."""
X = 1

def f(a, b=2):
    """Doc of f."""
    # comment
    return a + b * X
'''


def code(text: str) -> str:
    return look_into(text.encode(), "p.m", False)["digest"]


@pytest.mark.parametrize(
    "same",
    [
        BASE.replace("Doc of f.", "Another."),
        BASE.replace("# comment", "# more\n\n"),
        BASE.replace('"""Doc."""', ""),
        BASE.replace("a + b * X", "(a + (b * X))"),
        BASE.replace("X = 1", 'X = 1\n"""About X."""'),
    ],
)
def test_docstrings_comments_and_layout_do_not_count(same):
    assert code(same) == code(BASE)


@pytest.mark.parametrize(
    ("old", "new"),
    [("X = 1", "X = 2"), ("X = 1", "X = 1.0"), ("a + b", "a - b"), ("b=2", "b=3"), ("X = 1", "X = '1'"), ("f(", "g(")],
)
def test_everything_else_counts(old, new):
    assert code(BASE.replace(old, new)) != code(BASE)


names = st.sampled_from(["a", "b", "c"])
expressions = st.recursive(
    st.one_of(names, st.integers(0, 3).map(str), st.sampled_from(["''", "'x'", "()", "[]", "None"])),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
        st.lists(inner, max_size=3).map(lambda x: f"f({', '.join(x)})"),
        st.lists(inner, max_size=3).map(lambda x: f"[{', '.join(x)}]"),
    ),
    max_leaves=6,
)


@given(expressions, expressions)
def test_digests_are_equal_exactly_where_the_trees_are(first, second):
    first, second = f"x = {first}", f"x = {second}"
    assert (code(first) == code(second)) == (ast.dump(ast.parse(first)) == ast.dump(ast.parse(second)))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package `pkg` in which `pkg.stage` comes to other modules in every way there is."""
    files = {
        "pkg/__init__.py": "'doc'",
        "pkg/stage.py": "import os\nfrom pkg import a\ndef run():\n    from .sub import b\n    import pkg.sub.deep.c\n",
        "pkg/a.py": "import numpy\n",
        "pkg/other.py": "",
        "pkg/sub/__init__.py": "from . import d as e\n",
        "pkg/sub/b.py": "from ..late import value\nimport importlib\nx = importlib.import_module('pkg.named')\n",
        "pkg/sub/d.py": "from pkg.a import thing\nDATA = 'table.npz'\n",
        "pkg/sub/deep/__init__.py": "",
        "pkg/sub/deep/c.py": "from . import nothing_there\n",
        "pkg/late.py": "value = 1\n",
        "pkg/named.py": "import pkg.stage\n",
        "pkg/table.npz": "1",
        "pkg/unused.npz": "1",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_imports_are_followed_wherever_they_stand_and_named_data_files_count(package):
    found = Code().digests("pkg.stage")
    assert list(found) == [
        "pkg",
        "pkg.a",
        "pkg.late",
        "pkg.named",
        "pkg.stage",
        "pkg.sub",
        "pkg.sub.b",
        "pkg.sub.d",
        "pkg.sub.deep",
        "pkg.sub.deep.c",
        "pkg/table.npz",
    ]
    (package / "pkg/table.npz").write_text("2")
    (package / "pkg/unused.npz").write_text("2")
    (package / "pkg/late.py").write_text("value = 2\n")
    (package / "pkg/other.py").write_text("x = 1\n")
    new = Code().digests("pkg.stage")
    assert {name for name in found if found[name] != new[name]} == {"pkg/table.npz", "pkg.late"}


def test_remembered_digests_are_the_same_and_a_broken_memory_does_no_harm(package, tmp_path):
    memory = tmp_path / "code.json"
    first = Code(memory)
    found = first.digests("pkg.stage")
    first.save()
    second = Code(memory)
    assert second.digests("pkg.stage") == found and second.known
    (package / "pkg/late.py").write_text("value = 3\n")
    assert Code(memory).digests("pkg.stage")["pkg.late"] != found["pkg.late"]
    memory.write_text("{half")
    assert set(Code(memory).digests("pkg.stage")) == set(found)


def test_digests_of_folders_follow_names_and_bytes(tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    (folder / "a.png").write_text("a")
    (folder / "b.png").write_text("b")
    content, stat = content_digest(folder), stat_digest(folder)
    (folder / ".DS_Store").write_text("x")
    assert (content_digest(folder), stat_digest(folder)) == (content, stat)
    (folder / "a.png").rename(folder / "c.png")
    assert content_digest(folder) != content and stat_digest(folder) != stat
    (folder / "c.png").rename(folder / "a.png")
    assert content_digest(folder) == content


def exchanged(one: Path, other: Path) -> None:
    one.rename(one.with_name("aside"))
    other.rename(one)
    one.with_name("aside").rename(other)


def written_over(one: Path, other: Path) -> None:
    file = next(one.rglob("*.npy"))
    time = file.stat().st_mtime_ns
    file.write_text("EDIT")
    os.utime(file, ns=(time, time))


CHANGES = {
    "folders exchanged by mv": exchanged,
    "folders below exchanged by mv": lambda one, other: exchanged(one / "deep", other / "deep"),
    "files exchanged by mv": lambda one, other: exchanged(one / "deep/0.npy", other / "deep/0.npy"),
    "written over, time set back": written_over,
    "unpacked again, as tar, zip and rsync do": lambda one, other: (shutil.rmtree(one), shutil.copytree(other, one)),
    "a hard link in its place": lambda one, other: (
        (one / "deep/0.npy").unlink(), (one / "deep/0.npy").hardlink_to(other / "deep/0.npy")),
    "a link in its place": lambda one, other: (
        (one / "deep/0.npy").unlink(), (one / "deep/0.npy").symlink_to((other / "deep/0.npy").absolute())),
}  # fmt: skip


@pytest.mark.parametrize("how", [*CHANGES, "a link that leads elsewhere"])
def test_other_content_of_equal_sizes_and_times_is_read_again(tmp_path, how):
    """What only looks the same: npy and bmp have one size, and zip, tar, rsync and git set times."""
    one, other, link = tmp_path / "008", tmp_path / "010", tmp_path / "masks"
    for folder, text in ((one, "AAAA"), (other, "BBBB")):
        (folder / "deep").mkdir(parents=True)
        (folder / "deep/0.npy").write_text(text)
        os.utime(folder / "deep/0.npy", ns=(10**18, 10**18))
    link.symlink_to(one)
    before, same = (stat_digest(link), content_digest(link)), stat_digest(link)
    assert same == before[0]
    if how in CHANGES:
        CHANGES[how](one, other)
    else:
        link.unlink()
        link.symlink_to(other)
    assert content_digest(link) != before[1] and stat_digest(link) != before[0]


@pytest.fixture
def pool(tmp_path):
    """A data set whose folder `images` is a link to a folder elsewhere, with one more inside."""
    for name in ("pool/deep/2.png", "pool/1.png", "set/cameras.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "set/images").symlink_to("../pool")
    return tmp_path


def test_files_behind_linked_folders_count(pool):
    folder = pool / "set"
    assert sorted(files_under(folder)) == ["cameras.txt", "images/1.png", "images/deep/2.png"]
    for name in ("pool/1.png", "pool/deep/2.png"):
        content, stat = content_digest(folder), stat_digest(folder)
        (pool / name).write_text("other pixels")
        assert content_digest(folder) != content and stat_digest(folder) != stat
    (pool / "linked").symlink_to("set")
    assert content_digest(pool / "linked") == content_digest(folder)


def test_a_linked_folder_is_digested_as_a_copy_and_others_as_they_always_were(pool):
    shutil.copytree(pool / "set", pool / "copy")
    assert content_digest(pool / "copy") == content_digest(pool / "set")
    plain = {"1.png": file_digest(pool / "pool/1.png"), "deep/2.png": file_digest(pool / "pool/deep/2.png")}
    assert content_digest(pool / "pool") == digest(plain)


def test_links_that_lead_back_end_and_two_names_of_one_folder_both_count(pool):
    (pool / "pool/deep/up").symlink_to("..")
    (pool / "pool/self").symlink_to(".")
    (pool / "pool/deep/set").symlink_to("../../set")
    (pool / "set/again").symlink_to("../pool/deep")
    assert sorted(files_under(pool / "set")) == [
        "again/2.png",
        "again/up/1.png",
        "cameras.txt",
        "images/1.png",
        "images/deep/2.png",
    ]
    content = content_digest(pool / "set")
    (pool / "set/again").unlink()
    (pool / "set/again").symlink_to("../pool")
    assert content_digest(pool / "set") != content


def test_a_memory_that_cannot_be_written_costs_time_only(package, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    code = Code(tmp_path / "file/code.json")
    assert code.digests("pkg.stage")
    code.save()

    def refuse(*args, **options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    code = Code(tmp_path / "code.json")
    assert code.digests("pkg.stage")
    monkeypatch.setattr(Path, "write_text", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    code.save()
