"""What is joined by number is of the film's own frames, or that is said."""

import pytest

from stages.contract import StageError
from stages.formats.facts import Frame, Listing, Video
from stages.formats.frame_names import check_numbers, join, without_word
from tests.made.said import holds

FILM = 100


@pytest.mark.parametrize(
    ("numbers", "outcome"),
    [
        (range(100), "fine"),
        (range(101), "refused"),  # one frame doubled
        (range(259), "refused"),
        ([*range(0, 100, 5)], "fine"),
        ([*range(0, 120, 5)], "refused"),
        ([7], "fine"),
        ([100], "refused"),
        ([], "fine"),
        (range(99), "said"),  # one frame dropped
        (range(1, 100), "said"),
        (range(34), "said"),  # ten a second of thirty
        (range(40, 90), "fine"),  # somebody who comes and goes
    ],
)
def test_numbers_that_count_other_pictures_than_the_film_has_frames(numbers, outcome):
    if outcome == "refused":
        with pytest.raises(StageError, match=r"\bmasks\b") as error:
            check_numbers(list(numbers), FILM, "masks", "v.mp4")
        assert holds(error.value.facts[0], f"{len(list(numbers))} masks", "100 frames")
        assert "`ffmpeg -i v.mp4 -fps_mode passthrough pictures/%05d.png`" in error.value.hint
    else:
        told = check_numbers(list(numbers), FILM, "masks", "v.mp4")
        assert bool(told) == (outcome == "said") and ("passthrough" in told) == bool(told)
    assert check_numbers(list(numbers), 0, "masks", "v.mp4") == ""


@pytest.mark.parametrize("source", ["", "a"])
def test_every_join_is_checked_but_that_of_pictures_with_names(source):
    frames = tuple(Frame(name=f"{i:06d}", index=i, time_s=i, source=source and f"{source}{i}") for i in range(3))
    listing = Listing(width=8, height=8, video=Video(path="v.mp4", frames=3), frames=frames)
    said = []
    assert join(listing, ["a0", "a1", "a2"], "cameras", said.append) == {f"{i:06d}": i for i in range(3)}
    if source:
        assert set(join(listing, ["a0", "a1", "a2", "a9"], "cameras", said.append).values()) == {0, 1, 2}
    else:
        with pytest.raises(StageError, match="other pictures"):
            join(listing, ["a0", "a1", "a2", "a9"], "cameras", said.append)
        join(listing, ["a0", "a1"], "cameras", said.append)
    assert len(said) == (not source)


def test_a_word_after_every_number_is_no_part_of_a_name():
    assert without_word(["f_01_mask", "f_02_mask"]) == ["f_01", "f_02"]
    for names in (["f_01_mask", "f_02"], ["left", "right"], ["a", "a"], ["01", "02"]):
        assert without_word(names) == names
