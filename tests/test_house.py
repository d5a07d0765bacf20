"""The shape of the house: who imports whom, where tests lie, which parameters have types, how long a file is."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("stages", "hugs_cli", "hugs")
HOUSES = ("avatar", "training", "estimators", "formats", "synthetic", "filming")
BELOW = ("commands", "records", "gestures", "contract")  # what stages may import beside the houses
LONGEST = 350  # lines
TABLES: set[str] = set()  # files that are long because they are lists
KERNELS = ("njit", "jit", "intrinsic", "overload", "vectorize")  # decorators of functions that numba gives their types
ELSEWHERE = {  # a test file that is called after no module of its folder: why
    "hugs_cli/test_hints.py": "what all commands say helps",
    "hugs_cli/test_trouble.py": "what the world does to whole runs",
    "stages/avatar/effects/test_antialias.py": "a flag that goes from training to every picture",
    "stages/avatar/rasterize/test_machine.py": "all kernels, on whatever machine",
    "stages/avatar/rasterize/test_needles.py": "one kind of Gaussian, through projection and blend",
    "stages/formats/given_fits/test_malformed_fits.py": "every reader of the room",
    "stages/formats/given_fits/test_tool_fits.py": "every reader of the room",
    "stages/test_datasets.py": "the stages neuman and zju alike",
    "stages/test_native.py": "libraries that all stages load",
    "stages/test_render_films.py": "the films of stage render",
    "stages/training/test_ablations.py": "a switch of whole trainings",
    "stages/training/test_defects.py": "defects of the released code, each in a whole training",
    "stages/training/test_effects_in_training.py": "effects in whole trainings",
    "stages/training/test_training_hard.py": "hard cases that only whole trainings show",
}


def sources() -> dict[str, Path]:
    """Every module of the packages: dotted name -> file."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    named = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    return {name.removesuffix(".__init__"): path for name, path in sorted(named.items())}


SOURCES = sources()
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}


def imported(tree: ast.Module) -> Iterator[str]:
    """All that a module imports, at its top or inside a function: dotted names of modules, or of things in them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, "imports have whole names"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def graph() -> dict[str, set[str]]:
    """Module -> the modules of the packages that it imports."""
    found: dict[str, set[str]] = {}
    for name in SOURCES:
        parts = {one if one in SOURCES else one.rpartition(".")[0] for one in imported(TREES[name])}
        found[name] = (parts & set(SOURCES)) - {name}
    return found


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules each of which reaches all others of its group."""
    reach = {name: set(targets) for name, targets in edges.items()}
    while True:
        more = {name: known.union(*(reach[one] for one in known)) for name, known in reach.items()}
        if more == reach:
            break
        reach = more
    groups = {tuple(sorted(other for other in reach[name] if name in reach[other])) for name in edges}
    return sorted(list(group) for group in groups if group)


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]
    assert graph()["stages.formats.cameras"] >= {"stages.records"}


def test_nobody_imports_in_a_circle():
    found = circles(graph())
    assert not found, "\n".join(map(str, found))


def is_stage(name: str) -> bool:
    """A stage of the flow or of a command: what stands on top of the houses."""
    house, _, module = name.replace("stages.commands.", "stages.").partition(".")
    return house == "stages" and bool(module) and "." not in module and module not in (*HOUSES, *BELOW)


def test_nobody_imports_a_stage():
    """Stages exchange files, and are loaded by name."""
    assert sum(map(is_stage, SOURCES)) > 15 and is_stage("stages.train") and is_stage("stages.commands.views")
    assert [(name, one) for name, targets in graph().items() for one in targets if is_stage(one)] == []


def test_the_product_imports_no_test():
    assert [name for name in SOURCES if any(one.partition(".")[0] == "tests" for one in imported(TREES[name]))] == []


def test_tests_lie_where_the_modules_lie_that_they_test():
    """test_x.py tests the module x, or the room x, of the folder that is called like its own, or is about its room x."""
    lost = []
    for path in (path for package in PACKAGES for path in (ROOT / "tests" / package).rglob("test_*.py")):
        place = path.relative_to(ROOT / "tests").with_name(path.stem.removeprefix("test_"))
        known = (ROOT / place).is_dir() or (ROOT / place).with_suffix(".py").is_file() or place.name == path.parent.name
        if not known:
            lost.append(path.relative_to(ROOT / "tests").as_posix())
    assert sorted(lost) == sorted(ELSEWHERE)


def test_test_files_hold_tests_only_and_lend_each_other_nothing():
    """Helpers stand in tests/made, what is run by hand in tests/tools and tests/benchmarks."""
    found = []
    for path in (ROOT / "tests").rglob("*.py"):
        place = path.relative_to(ROOT / "tests")
        if place.parts[0] in PACKAGES and not path.name.startswith(("test_", "conftest.")):
            found.append(f"{place} is no test")
        names = {one.rpartition(".")[0] for one in imported(ast.parse(path.read_text("utf-8")))}
        lent = [one for one in names if one.startswith("tests.") and ".test_" in one]
        found += [f"{place} imports {one}" for one in sorted(lent)]
    assert not found, "\n".join(found)


def unclear(tree: ast.Module) -> Iterator[str]:
    """Parameters of public functions and methods without a type, or with `Any` for one."""
    scopes: list[tuple[str, list[ast.stmt]]] = [("", tree.body)]
    for prefix, body in scopes:
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                scopes.append((f"{node.name}.", node.body))
            if not isinstance(node, ast.FunctionDef) or (node.name.startswith("_") and node.name != "__init__"):
                continue
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            if any(word in mark for mark in marks for word in KERNELS):
                continue
            given = node.args
            rows = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            if prefix and not any(mark == "staticmethod" for mark in marks):
                rows = rows[1:]  # self, cls
            for row in filter(None, rows):
                kind = ast.unparse(row.annotation) if row.annotation else ""
                if not kind or "Any" in kind.split(" | "):
                    yield f"{prefix}{node.name}({row.arg})"


def test_parameters_without_a_type_are_found():
    text = "def f(a, b: Any, c: dict[str, Any], d: int): ...\nclass C:\n  def g(self, e): ...\ndef _h(x): ..."
    assert list(unclear(ast.parse(text))) == ["f(a)", "f(b)", "C.g(e)"]


@pytest.mark.parametrize("house", HOUSES)
def test_public_parameters_have_types(house):
    inside = [name for name in SOURCES if f"{name}.".startswith(f"stages.{house}.")]
    assert inside
    unknown = [f"{name}.{found}" for name in inside for found in unclear(TREES[name])]
    assert not unknown, "\n".join(unknown)


def test_no_file_is_long_unless_it_is_a_table():
    lines = {path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines()) for path in SOURCES.values()}
    long = {name: count for name, count in lines.items() if count > LONGEST}
    assert set(long) == TABLES, long
