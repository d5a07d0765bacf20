"""Writes docs/reference.md from the docstrings of the package `hugs`: python -m tests.tools.reference"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hugs

FILE = Path(__file__).parents[2] / "docs" / "reference.md"
START = """# Reference: the package `hugs`

Every public name, made from its docstring by `python -m tests.tools.reference`. Where to begin: [From Python](python.md).
A `Pathish` is a str or a Path, a `Hear` is called with a `Progress`.
"""
WIDTH = 110


def page() -> str:
    """The whole document: functions first, then classes, then what is left, each by name."""
    names = sorted(hugs.__all__, key=lambda name: (rank(getattr(hugs, name)), name.lower()))
    return "\n".join([START, *(line for name in names for line in entry(name, getattr(hugs, name)))])


def rank(value: Any) -> int:
    return 0 if inspect.isfunction(value) else 1 if inspect.isclass(value) else 2


def entry(name: str, value: Any) -> Iterator[str]:
    """The lines of one name."""
    yield from (f"## hugs.{name}", "")
    if inspect.isfunction(value):
        yield from described(f"hugs.{name}", tree_of(value), inspect.getdoc(value))
    elif inspect.isclass(value):
        yield from (inspect.getdoc(value) or "", "")
        for title, text, node in members(value):
            if node is None:
                yield from (f"**`{title}`** {text}".strip(), "")
            else:
                yield from described(title, node, text)
    else:
        yield from (f"{len(value)} names: {', '.join(f'`{one}`' for one in value)}.", "")


def described(title: str, node: ast.FunctionDef, text: str | None) -> Iterator[str]:
    """A signature, and the text below it."""
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    taken = ast.unparse(node.args).removeprefix("self, ").removeprefix("cls, ").removeprefix("self")
    yield from ("```text", *textwrap.wrap(f"{title}({taken}){returns}", WIDTH, subsequent_indent="    "), "```", "")
    if text:
        yield from (text, "")


def members(kind: type) -> Iterator[tuple[str, str, ast.FunctionDef | None]]:
    """Public fields, properties and methods of a class of ours: name, text, and the tree of a method."""
    body = tree_of(kind).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and public(node.target.id):
            said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            yield f"{node.target.id}: {ast.unparse(node.annotation)}", inspect.cleandoc(str(said)), None
        elif isinstance(node, ast.FunctionDef) and public(node.name):
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            is_property = any("property" in mark for mark in marks)
            if "overload" in marks:
                continue
            returns = f": {ast.unparse(node.returns)}" if node.returns else ""
            title = f"{node.name}{returns}" if is_property else f"{kind.__name__}.{node.name}"
            yield title, ast.get_docstring(node) or "", None if is_property else node


def public(name: str) -> bool:
    return not name.startswith("_")


def tree_of(value: Any) -> Any:
    """The syntax tree of a function or class."""
    return ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]


if __name__ == "__main__":
    FILE.write_text(page(), "utf-8")
