"""Each command of the documents that runs a pipeline is run on a small film; what is promised of it is looked for.

Stages run as they are, at sizes below those of `ci`, in one work folder: a command makes again what its options change.
"""

import pytest

from tests.docs.promises import TRAINED
from tests.made import brought, documented
from tests.made.documented import Place

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    """A film and what belongs to it; in pair/, one of two people."""
    made = documented.make(tmp_path_factory.mktemp("trained"))
    brought.found(made.folder)
    brought.two_people(made.folder / "pair")
    return made


@pytest.mark.parametrize("line", TRAINED, ids=list(TRAINED))
def test_a_command_does_what_its_document_says(place, line):
    """`status` and `why` look at what those before them have made."""
    place.tried(line, TRAINED[line])
