"""The names of the package: there, typed, and imported when they are first used."""

import ast
import inspect
import subprocess
import sys
import textwrap
from pathlib import Path

import hugs

START = """
import sys, time
start = time.perf_counter()
import hugs
took = time.perf_counter() - start
assert not {"torch", "numpy", "pydantic"} & set(sys.modules), "something heavy is imported"
print(took)
"""


def test_the_package_is_there_at_once():
    took = min(float(subprocess.check_output([sys.executable, "-c", START])) for _ in range(3))
    assert took < 0.15


def test_type_checkers_see_what_is_there():
    tree = ast.parse(Path(hugs.__file__).read_text("utf-8"))
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    seen: dict[str, set[str]] = {}
    for one in checked.body:
        assert isinstance(one, ast.ImportFrom) and one.module and one.names[0].name == one.names[0].asname
        seen.setdefault(one.module, set()).update(alias.name for alias in one.names)
    assert seen == {home: set(names) for home, names in hugs.HOMES.items()}


def test_each_public_name_is_there():
    assert hugs.__all__ and set(hugs.__all__) <= set(dir(hugs))
    assert all(getattr(hugs, name) is not None for name in hugs.__all__)
    assert not hasattr(hugs, "nothing")


def test_each_public_function_and_class_has_an_example():
    for name in hugs.__all__:
        value = getattr(hugs, name)
        if callable(value):
            lines = (inspect.getdoc(value) or "").splitlines()
            example = textwrap.dedent("\n".join(line for line in lines if line.startswith("    ")))
            tree = ast.parse(example)
            assert tree.body, f"hugs.{name} has no example"
            for node in ast.walk(tree):
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "hugs":
                    assert node.attr in hugs.__all__, f"the example of hugs.{name} has hugs.{node.attr}"
