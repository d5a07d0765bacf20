"""The documents, and what is in them: blocks of code, spans of code, links."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`]+)`")
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


def documents() -> list[Document]:
    """README, CHANGELOG and all of docs/."""
    paths = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [Document(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")) for path in paths]
