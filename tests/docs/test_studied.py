"""Each command of the documents that trains many times is run on a small film: ablations, sweeps, data sets, fleets.

What is promised of it is looked for. Stages run as they are, at sizes below those of `ci`, in one work folder.
"""

import pytest

from tests.docs.promises import STUDIED
from tests.made import brought, documented
from tests.made.documented import Place

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    """A film, data sets, and a folder of clips of which one is noise."""
    made = documented.make(tmp_path_factory.mktemp("studied"))
    brought.data_sets(made.folder)
    brought.clips(made.folder)
    return made


@pytest.mark.parametrize("line", STUDIED, ids=list(STUDIED))
def test_a_command_does_what_its_document_says(place, line):
    """`costs` and fleets look at what those before them have made."""
    if line.startswith("hugs fleet"):
        place.gather()
    place.tried(line, STUDIED[line])
