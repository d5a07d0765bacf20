"""The documents, and what is in them: blocks of code, spans of code, links, commands."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`]+)`")
HINT = re.compile(r"`((?:hugs|pip|python|npx|ffmpeg|--[a-z]+)(?: [^`\n]+)?)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")


class Document(NamedTuple):
    """One document: its name in the repository, and its text."""

    name: str
    text: str

    def blocks(self, *languages: str) -> list[str]:
        """Blocks of code of these languages."""
        return [body for language, body in BLOCK.findall(self.text) if language in languages]

    def spans(self) -> list[str]:
        """Spans of code outside blocks, each on one line."""
        return [" ".join(span.split()) for span in SPAN.findall(BLOCK.sub("", self.text))]

    def links(self) -> list[str]:
        """Targets of links and pictures."""
        return LINK.findall(BLOCK.sub("", self.text))

    def anchors(self) -> set[str]:
        """The headings as links name them."""
        titles = re.findall(r"^#+ (.*)$", BLOCK.sub("", self.text), re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


LAB = "docs/lab/"
"""The notebook: what it says is of the day on which it was written, so only its links are looked at."""


def documents(lab: bool = False) -> list[Document]:
    """All documents at the root and in docs/, with or without the notebook."""
    paths = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
    found = [Document(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")) for path in paths]
    return [one for one in found if lab or not one.name.startswith(LAB)]


PROGRAMS = ("hugs ", "make ", "pip ", "python -m ", "pre-commit ")
CHEAP = {
    "hugs stages",
    "hugs stages export",
    "hugs stages train",
    "hugs doctor",
    "hugs doctor --json",
    "hugs --help",
    "hugs --version",
}
"""What is run as it stands."""
TAKEN = ("animate", "compose", "render", "export", "view", "status", "why", "accept", "gc")
"""Commands that take a finished run, or an avatar's file; those that name a variant take what a study has made."""


def lines() -> list[tuple[str, str]]:
    """(document, command) of each line of the blocks `console`, without comments."""
    whole = [(one.name, line) for one in documents() for block in one.blocks("console") for line in block.splitlines()]
    return [(name, command) for name, line in whole if (command := line.split(" #")[0].strip())]


def commands() -> list[tuple[str, str]]:
    """(document, command) of each line, and of each command in running text."""
    spans = [(one.name, span) for one in documents() for span in one.spans() if span.startswith(PROGRAMS)]
    return list(dict.fromkeys([*lines(), *spans]))


def of_finished_runs() -> list[str]:
    """The lines of TAKEN, each once; what makes a film's YAML comes before what films it."""
    taken = {line for _, line in lines() if line.startswith("hugs ") and line.split()[1] in TAKEN}
    return sorted((line for line in taken if "default." not in line), key=lambda line: (".yaml" in line, line))


@cache
def hints() -> dict[str, str]:
    """Each command in backticks in a text that the product may print -> the file; what is filled in reads as X."""
    found = {}
    for path in [path for package in ("stages", "hugs_cli", "hugs") for path in (ROOT / package).rglob("*.py")]:
        content = path.read_text("utf-8")
        if not HINT.search(content):
            continue
        tree = ast.parse(content)
        parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
        for node in ast.walk(tree):
            text = ""
            if isinstance(node, ast.JoinedStr):
                text = "".join(part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
                text = node.value
            found |= dict.fromkeys(HINT.findall(text), path.name)
    return found
