"""Makes small mistakes in one file of the product, one at a time, and lists those that no test of that file sees.

`make mutants FILE=stages/filming/standing.py` takes up to MOST of them, spread over the file. The tests are those that lie where
the file lies, and those that import it; the slow ones of them only where no other turns red.
"""

from __future__ import annotations

import ast
import re
import shutil
import tempfile
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from tests.tools.mutants import ROOT, copy_tree, ran

MOST = 40
SECONDS = 300  # a test that takes longer has seen the mistake: something does not end
TURNED = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in"}
TURNED |= {ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is"}
OTHER = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.BitAnd: "|", ast.BitOr: "&"}
BOUNDS = ("clamp", "clamp_min", "clamp_max", "clip", "abs", "detach")
EXTREMES = ("min", "max", "minimum", "maximum", "clip", "fmin", "fmax")


class Mistake(NamedTuple):
    """What is wrong in `line`, in words, and the whole `source` with it."""

    line: int
    what: str
    source: str


def mistakes(source: str) -> list[Mistake]:
    """All mistakes that are made in a module's source, in the order of its lines."""
    lines = source.splitlines(keepends=True)
    starts = list(accumulate(map(len, lines), initial=0))

    def place(line: int | None, column: int | None) -> int:
        """Where a line and its column in bytes are in the text."""
        assert line is not None
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    found = []
    for node, instead in _replacements(ast.parse(source)):
        start, end = place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)
        before = source[start:end]
        if before != instead:
            what = f"{' '.join(before.split())} -> {instead}"
            found.append(Mistake(node.lineno, what, source[:start] + instead + source[end:]))
    return sorted(found, key=lambda one: one.line)


def _replacements(tree: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Expressions and what stands instead; none in annotations, texts, and what is said to users."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list") or isinstance(tree, ast.JoinedStr | ast.Raise):
            continue
        for node in value if isinstance(value, list) else [value]:
            if isinstance(node, ast.expr):
                yield from ((node, f"({instead})") for instead in _instead(node))
            if isinstance(node, ast.AST):
                yield from _replacements(node)


def _instead(node: ast.expr) -> Iterator[str]:
    text = ast.unparse
    match node:
        case ast.Compare(left, [op, *_], [right]) if type(op) in TURNED:
            yield f"{text(left)} {TURNED[type(op)]} {text(right)}"
        case ast.Constant(bool() as value):
            yield str(not value)
        case ast.Constant(int() as value):
            yield str(value + 1)
        case ast.Constant(float() as value):
            yield repr(2 * value or 1.0)
        case ast.BinOp(left, op, right) if type(op) in OTHER and not any(map(_is_text, (left, right))):
            yield f"({text(left)}) {OTHER[type(op)]} ({text(right)})"
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert(), operand) if not isinstance(operand, ast.Constant):
            yield text(operand)
        case ast.BoolOp(op, values):
            yield (" or " if isinstance(op, ast.And) else " and ").join(f"({text(value)})" for value in values)
        case ast.Call(ast.Attribute(ast.Name("np" | "torch" | "math"), name), [first, *_]) if name in EXTREMES:
            yield text(first)
        case ast.Call(ast.Name(name), [first, _, *_]) if name in EXTREMES:
            yield text(first)
        case ast.Call(ast.Attribute(value, name)) if name in BOUNDS:
            yield text(value)
        case ast.Call(function, [first, second], []) if type(first) is type(second) is ast.Name:
            yield f"{text(function)}({text(second)}, {text(first)})"
        case ast.IfExp(_, body, other):
            yield text(other if isinstance(body, ast.Constant) else body)


def _is_text(node: ast.expr) -> bool:
    """Whether it is written as a text, as parts of paths are."""
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def guards(file: str, root: Path = ROOT) -> list[str]:
    """The test files of a module of the product: that which lies where it lies, that of its room, and those that import it; all
    of its room where there is none."""
    place, module = Path(file), ".".join(Path(file).with_suffix("").parts)
    package, _, name = module.rpartition(".")
    own = Path("tests", place.with_name(f"test_{place.name}"))
    room = Path("tests", place.parent.with_name(f"test_{place.parent.name}.py"))
    named = re.compile(rf"from {module} import|import {module}\b|from {package} import [^\n]*\b{name}\b")
    importing = [
        path.relative_to(root)
        for path in sorted((root / "tests").rglob("test_*.py"))
        if named.search(path.read_text("utf-8"))
    ]
    found = [path for path in dict.fromkeys([own, room, *importing]) if (root / path).is_file()]
    beside = [path.relative_to(root) for path in sorted((root / own.parent).glob("test_*.py"))]
    return [path.as_posix() for path in found or beside]


def seen_by(tree: Path, files: list[str]) -> str:
    """The test that turns red in the tree, quick ones first; "" if none does."""
    for which in ("not slow", "slow"):
        code, lines = ran(tree, SECONDS, "-m", which, *files)
        if code not in (0, 5):  # 5: no such test
            failed = [line.split()[1] for line in lines if line.startswith(("FAILED ", "ERROR "))]
            return failed[0] if failed else lines[-1]
    return ""


def main(file: str, most: int = MOST) -> int:
    """Print what no test sees of up to `most` mistakes in a file; exit code 1 if there is any."""
    source, files = (ROOT / file).read_text("utf-8"), guards(file)
    if not files:
        print(f"no test lies at {file} or imports it")
        return 1
    every = mistakes(source)
    chosen = [every[i * len(every) // min(most, len(every))] for i in range(min(most, len(every)))]
    with tempfile.TemporaryDirectory(prefix="hugs-mutants-") as scratch:
        tree = copy_tree(Path(scratch, "tree"))
        if red := seen_by(tree, files):
            print(f"the tests must pass before anything is changed: {red}")
            return 1
        unseen = 0
        for mistake in chosen:
            shutil.copy2(tree / file, tree / "whole")
            (tree / file).write_text(mistake.source, "utf-8")
            red = seen_by(tree, files)
            shutil.move(tree / "whole", tree / file)
            unseen += not red
            print(f"{'seen  ' if red else 'UNSEEN'} {file}:{mistake.line}  {mistake.what}  {red}", flush=True)
    print(f"\n{len(chosen)} of {len(every)} mistakes in {file}, {unseen} not seen by {', '.join(files)}")
    return int(unseen > 0)
