"""Tables and marked numbers of the documents are those of docs/benchmarks/table.json."""

import json

import pytest

from tests.benchmarks import page
from tests.docs.documents import documents

TABLE = json.loads(page.TABLE.read_bytes())


@pytest.mark.parametrize("document", documents(), ids=lambda d: d.name)
def test_a_document_says_what_the_table_says(document):
    assert page.fill(document.text, TABLE) == document.text, "python -m tests.benchmarks.page writes it"


def test_the_plot_is_of_the_tables_commit():
    assert TABLE["commit"] in page.PLOT.read_text()
