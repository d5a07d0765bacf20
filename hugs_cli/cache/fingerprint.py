"""Digests of files, of folders, and of the code that a stage runs.

Code is the syntax tree without docstrings and comments, of the stage's module and of every module of the same top
package that it imports, directly or not, at the top of a file or inside a function; plus the data files of that
package that those modules name.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from hugs_cli.cache.whole import replace

FILE_NAME = re.compile(r"[\w./-]*\w\.\w{1,8}")
MODULE_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
FORMAT = f"1 {sys.version_info[0]}.{sys.version_info[1]}"  # of the remembered digests; Python's syntax trees differ
REMEMBERED = 1000  # modules; beyond it only those in use are kept


def digest(value: Any) -> str:
    """sha256 of a JSON value; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_under(path: Path) -> dict[str, Path]:
    """The files of a folder by relative name, without hidden ones. For a file: itself, named ''.

    Follows links to folders, as stages do, but enters no folder again inside itself.
    """
    if path.is_file():
        return {"": path}
    found = {}
    around: dict[str, set[tuple[int, int]]] = {}  # folder -> those that it lies in
    for folder, folders, files in os.walk(path, followlinks=True):
        lies_in = around.pop(folder, set()) | {identity(folder)}
        seen = (name for name in folders if not name.startswith("."))
        folders[:] = sorted(name for name in seen if identity(os.path.join(folder, name)) not in lies_in)
        around |= {os.path.join(folder, name): lies_in for name in folders}
        for name in sorted(files):
            if not name.startswith("."):
                found[(Path(folder) / name).relative_to(path).as_posix()] = Path(folder) / name
    return found


def identity(folder: str) -> tuple[int, int]:
    """What tells a folder from all others, by whatever name it is reached."""
    stat = os.stat(folder)
    return stat.st_dev, stat.st_ino


def content_digest(path: Path) -> str:
    """sha256 of a file's bytes, or of a folder's names and bytes."""
    return digest({name: file_digest(file) for name, file in files_under(path).items()})


def stat_digest(path: Path) -> str:
    """A cheap digest of names, and of which files they are, sizes and times: if it is the same, the content need not be read
    again. Times of content can be set, and two files share them; a file's own number and the time of its last change not."""
    stats = {name: file.stat() for name, file in files_under(path).items()}
    told = ("st_dev", "st_ino", "st_size", "st_mtime_ns", "st_ctime_ns")
    return digest({name: [getattr(stat, one) for one in told] for name, stat in stats.items()})


class Code:
    """Digests the code of stages. Remembers the digest of each source text in `memory`, a JSON file.

    `frozen`: each stage is looked at once.
    """

    def __init__(self, memory: Path | None = None, frozen: bool = False):
        self.memory = memory
        self.frozen: dict[str, dict[str, str]] | None = {} if frozen else None
        self.known: dict[str, Any] = {}
        self.used: dict[str, Any] = {}
        self.files: dict[str, dict[str, Path]] = {}
        self.texts: dict[str, tuple[tuple[int, ...], str]] = {}  # module -> its file's state, digest of what it holds
        if memory and memory.is_file():
            self.known = read_memory(memory)

    def digests(self, module: str) -> dict[str, str]:
        """Digest of each module and data file that `module` depends on: {'stages.train': ..., 'stages/x.npz': ...}."""
        if self.frozen and module in self.frozen:
            return self.frozen[module]
        root = package_folder(module.partition(".")[0])
        found: dict[str, str] = {}
        seen: set[str] = set()
        open_ = [module]
        for name in open_:
            if name in seen:
                continue
            seen.add(name)
            if (path := module_file(root, name)) is None:
                continue
            facts = self.read(name, path)
            found[name] = facts["digest"]
            open_ += [*parents(name), *facts["imports"]]
            for data in facts["names"]:
                if file := self.data_files(root).get(Path(data).name):
                    found[file.relative_to(root.parent).as_posix()] = file_digest(file)
        found = dict(sorted(found.items()))
        if self.frozen is not None:
            self.frozen[module] = found
        return found

    def read(self, name: str, path: Path) -> dict[str, Any]:
        """The digest of one module, its imports, and the file names in it; read again only where the file has changed."""
        stat = os.stat(path)
        state = (stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
        if self.texts.get(name, ((), ""))[0] != state:
            source = path.read_bytes()
            text = hashlib.sha256(f"{name} {path.name}\0".encode() + source).hexdigest()
            if text not in self.used:
                self.used[text] = self.known.get(text) or look_into(source, name, path.name == "__init__.py")
            self.texts[name] = state, text
        return self.used[self.texts[name][1]]

    def data_files(self, root: Path) -> dict[str, Path]:
        """The files of a package that are not code, by name."""
        key = str(root)
        if key not in self.files:
            every = files_under(root).values()
            self.files[key] = {p.name: p for p in every if p.suffix not in (".py", ".pyc", ".pyi")}
        return self.files[key]

    def save(self) -> None:
        """Write new digests to the memory. A folder that cannot be written only costs time."""
        if self.memory is None or set(self.used) <= set(self.known):
            return
        self.known = {**self.known, **self.used} if len(self.known) < REMEMBERED else dict(self.used)
        with suppress(OSError):
            replace(self.memory, json.dumps({"format": FORMAT, "modules": self.known}))


def read_memory(memory: Path) -> dict[str, Any]:
    """The digests that earlier runs wrote; empty if they cannot be read."""
    try:
        content = json.loads(memory.read_bytes())
        modules = content["modules"] if content["format"] == FORMAT else {}
        return {text: facts for text, facts in modules.items() if is_known(facts)}
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return {}


def is_known(facts: Any) -> bool:
    """Whether a value has the form that `look_into` returns."""
    if not isinstance(facts, dict) or not isinstance(facts.get("digest"), str):
        return False
    lists = [facts.get(name) for name in ("imports", "names")]
    return all(isinstance(one, list) and all(isinstance(name, str) for name in one) for one in lists)


def package_folder(top: str) -> Path:
    """The folder of a top-level package, found without importing it."""
    spec = importlib.util.find_spec(top)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"no package {top}", name=top)
    return Path(next(iter(spec.submodule_search_locations)))


def module_file(root: Path, name: str) -> Path | None:
    """The file of a dotted name under a package's folder; None if the name is an attribute."""
    path = os.path.join(root, *name.split(".")[1:])  # text: paths are slow, and there are a thousand
    for file in (os.path.join(path, "__init__.py"), f"{path}.py"):
        if os.path.isfile(file):
            return Path(file)
    return None


def parents(name: str) -> list[str]:
    """The packages that run when a module is imported: 'a.b.c' -> ['a', 'a.b']."""
    parts = name.split(".")
    return [".".join(parts[:i]) for i in range(1, len(parts))]


def look_into(source: bytes, name: str, is_package: bool) -> dict[str, Any]:
    """Digest, imports and named files of one module's source."""
    tree = ast.parse(source)
    package = name if is_package else name.rpartition(".")[0]
    imports: set[str] = set()
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, *([base] if base else [])])
            imports.add(base)
            imports.update(f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if MODULE_NAME.fullmatch(node.value):
                imports.add(node.value)  # importlib.import_module("stages.x")
            if FILE_NAME.fullmatch(node.value):
                names.add(node.value)
    top = name.partition(".")[0]
    own = sorted(i for i in imports if i == top or i.startswith(f"{top}."))
    tokens: list[str] = []
    flatten(tree, tokens)
    return {"digest": digest(tokens), "imports": own, "names": sorted(names)}


def flatten(node: Any, tokens: list[str]) -> None:
    """Write a syntax tree as a list of words, without statements that are only a string (docstrings)."""
    if isinstance(node, ast.AST):
        tokens.append(f"({type(node).__name__}")
        for field, value in ast.iter_fields(node):
            if value is not None and value != [] and field not in ("ctx", "type_comment", "kind"):
                tokens.append(field)
                flatten(value, tokens)
        tokens.append(")")
    elif isinstance(node, list):
        for item in node:
            if not (isinstance(item, ast.Expr) and is_text(item.value)):
                flatten(item, tokens)
        tokens.append(";")
    else:
        tokens.append(repr(node))


def is_text(node: ast.AST) -> bool:
    """True for a plain string literal."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
