"""Links between documents lead somewhere, files that they name exist, and the front door stays small."""

import re

import pytest

from tests.benchmarks.page import BLOCK
from tests.docs.documents import ROOT, documents

DOCUMENTS = documents(lab=True)
IDS = [document.name for document in DOCUMENTS]
PATH = re.compile(
    r"(?:stages|hugs_cli|hugs|tests|docs|examples)/[\w./*-]*|[A-Za-z]+\.(?:toml|yaml)|NOTICE|CHANGELOG\.md"
)


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_links_lead_somewhere(document):
    folder = (ROOT / document.name).parent
    known = {(ROOT / one.name).resolve(): one for one in DOCUMENTS}
    for link in document.links():
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = (folder / path).resolve() if path else (ROOT / document.name).resolve()
        assert target.exists(), link
        assert not anchor or anchor in known[target].anchors(), link


@pytest.mark.parametrize("document", [d for d in documents() if d.name != "CHANGELOG.md"], ids=lambda d: d.name)
def test_files_that_are_named_exist(document):
    new = "stages/sheet.py", "tests/stages/test_sheet.py"  # the stage that architecture.md adds
    for span in document.spans():
        if PATH.fullmatch(span) and span not in new:
            assert list(ROOT.glob(span.rstrip("/"))), span


def test_every_document_is_listed():
    """In the README.md of its folder, or of the one above."""
    known = {ROOT / one.name: {(ROOT / one.name).parent / link for link in one.links()} for one in DOCUMENTS}
    for path in (path for path in known if path.parent != ROOT and path.name != "README.md"):
        indices = (folder / "README.md" for folder in path.parents[:2])
        assert any(path in known.get(index, ()) for index in indices), path


def test_the_front_door_is_small():
    """Tables that are made, and the reference, do not count."""
    words = {document.name: len(re.findall(r"\S*\w\S*", BLOCK.sub("", document.text))) for document in documents()}
    assert words["README.md"] <= 700
    assert sum(words.values()) - words["docs/reference.md"] <= 16_000, "the reference is made from docstrings"
    assert (ROOT / "docs" / "pictures" / "strip.webp").stat().st_size < 2e6
    assert (ROOT / "docs" / "pictures" / "report.webp").stat().st_size < 4e5
    assert (ROOT / "docs" / "pictures" / "examples.webp").stat().st_size < 1.2e5
