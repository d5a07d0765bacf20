"""Each command of the documents that trains is run on a small film; what is promised of it is looked for.

Stages run as they are, at sizes below those of `ci`, in one work folder: a command makes again what its options change.
"""

import pytest

from tests.docs.promises import TRAINED
from tests.made import brought, documented
from tests.made.documented import Place

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    """A film and what belongs to it; in pair/, one of two people; data sets; a folder of clips of which one is noise."""
    made = documented.make(tmp_path_factory.mktemp("trained"))
    brought.found(made.folder)
    brought.two_people(made.folder / "pair")
    brought.data_sets(made.folder)
    brought.clips(made.folder)
    return made


@pytest.mark.parametrize("line", TRAINED, ids=list(TRAINED))
def test_a_command_does_what_its_document_says(place, line):
    """`status`, `why`, `costs` and fleets look at what those before them have made."""
    if line.startswith("hugs fleet"):
        place.gather()
    place.tried(line, TRAINED[line])
