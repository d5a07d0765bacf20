"""The libraries are those that npm serves, to the byte."""

import gzip
import hashlib

import pytest

from stages.formats.viewer.libraries import FILES, LICENCES, ROOM, licences, packed
from tests.docs.documents import ROOT

DIGESTS = {  # of three@0.187.0 and @sparkjsdev/spark@2.2.0
    "three.core.js.gz": "613e370f76638fdef83926642bf256dc9615684922de1ce1f63a8583e5d78578",
    "three.module.js.gz": "104f56145899722094556490d787aae0617cc2fc3382f31df02d724ea1aee341",
    "OrbitControls.js.gz": "e7fca2fe9e7670a828af9b28084669a5909445b7f36f1f26cee9bf8f2961c32c",
    "Pass.js.gz": "444b409c235ead986893c472e720da1b779a56985c7d10b279c7944b52bd61c5",
    "spark.module.min.js.gz": "96869fab4f2164d5d267b1df1e1b636c05e6499973cb8dddec23387919b38526",
}


@pytest.mark.parametrize("file", sorted(FILES.values()))
def test_a_library_is_what_npm_serves(file):
    assert hashlib.sha256(gzip.decompress((ROOM / file).read_bytes())).hexdigest() == DIGESTS[file]


def test_nothing_else_is_shipped():
    assert {path.name for path in ROOM.iterdir()} == {*FILES.values(), *LICENCES.values()}
    assert set(packed()) == set(FILES)


def test_licences_go_with_the_page_and_the_package():
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    assert licences().count("Permission is hereby granted, free of charge") == len(LICENCES) == 2
    assert "three.js 0.187.0" in notice and "Spark 2.2.0" in notice and "stages/formats/viewer/libraries" in notice
