"""The film whose pictures are made is the one that docs/films.md shows; every example is shown; a row is of one height."""

from inspect import signature

import numpy as np
import yaml

from tests.docs.documents import ROOT
from tests.made.examples import EXAMPLES, example
from tests.tools.pictures import CLIPS, SHOWN, TALL, TWO, beside, shown_film


def test_the_films_are_of_the_three_clips():
    shown = yaml.safe_load(shown_film())
    assert [one["avatar"] for one in shown["people"]] == [f"work/{clip}/default" for clip in CLIPS]
    assert shown["camera"] == "hall.npz" and shown["out"].keys() == {"film", "page"}
    caption = (ROOT / "docs" / "films.md").read_text()
    two = yaml.safe_load(TWO)
    assert f"`camera: {two['camera']}`" in caption
    assert f"moved {-two['people'][0]['at'][0]} m to his right" in caption


def test_every_example_is_shown():
    assert SHOWN.keys() == {path.stem for path in EXAMPLES.glob("*.py")}
    for name, (function, arguments, paths) in SHOWN.items():
        called = signature(getattr(example(name), function)).parameters.values()
        assert sum(one.default is one.empty for one in called) == len(arguments) and paths


def test_a_row_is_of_one_height():
    drawn = beside("films", [np.zeros((864, 480, 3), np.uint8), np.zeros((100, 200, 3), np.uint8)])
    assert drawn.shape[0] == TALL["films"] and drawn.shape[1] == 288 + 1036 + 4
