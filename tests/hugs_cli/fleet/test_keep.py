"""What is left of a finished clip, and when it still counts as done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from hugs_cli.cache import garbage
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.report import PAGE
from hugs_cli.cache.workspace import STAMP
from hugs_cli.fleet import keep
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.history import History
from hugs_cli.fleet.plan import verdict
from hugs_cli.options import RunOptions
from hugs_cli.pipelines import UsageError
from hugs_cli.times import Times

RESULT = {"seconds": 3.0, "picture": "", "pages": [PAGE, "export/viewer.html"]}


@pytest.fixture
def open_(made, monkeypatch) -> Callable[..., Session]:
    """`open_()`: the session of a finished clip of four stages, with other settings or sources where they are given."""
    monkeypatch.syspath_prepend(str(made.folder))

    def session(*settings: str, **sources: object) -> Session:
        options = RunOptions(list(settings), work=made.work, pipelines_file=made.folder / "pipelines.yaml")
        found = options.session(made.video)
        return replace(found, sources=found.sources | sources)

    return session


def stages_there(made) -> set[str]:
    """The stages of results in the store."""
    return {path.name.partition("-")[0] for path in made.store.iterdir() if path.name[0] != "."}


def planned(session: Session, *kept: str):
    """The plan for the clip."""
    row = Row(session.video, session.workspace.work, "default")
    return verdict(row, session, History({}), Times([]), False, kept)


def test_only_what_is_kept_stays_and_counts_as_done(made, open_):
    (made.store / "two-01234567").mkdir()  # of other settings: nothing links to it
    (made.store / "two-01234567" / "old").write_text("x" * 5000)
    whole, session = made.text("four"), open_()
    assert (
        planned(session, "four").state == "todo" and not planned(session, "four").todo
    )  # all is there, too much of it
    result = keep.let_go(session, ["four"], RESULT)
    assert stages_there(made) == {"four"} and made.text("four") == whole
    assert result["kept"] == ["four"] and result["freed"] > 5000 and result["pages"] == []
    found = planned(session, "four")
    assert found.state == "fresh" and found.result == result and planned(session).state == "fresh"
    assert planned(session, "four", "two").todo == ["one", "two", "three", "four"]  # that is more than there is
    assert made.ran().keys() == {"one", "two", "three"}  # `hugs run` makes the rest again, and finds what was kept
    with pytest.raises(UsageError, match="no stage 'tow'"):
        planned(session, "tow")


def test_another_source_or_setting_or_a_damaged_result_makes_it_anew_and_code_does_not(made, open_):
    keep.let_go(open_(), ["four"], RESULT)
    assert keep.record(open_(), ["four"])["result"]["seconds"] == 3.0
    assert not keep.record(open_("one.word=b"), ["four"])
    masks = made.folder / "masks"
    masks.write_text("white")
    assert not keep.record(open_(mask_files=masks), ["four"])
    made.edit("one", "run(job", "run( job")
    made.edit("helper", "{name}", "{name}!")
    assert keep.record(open_(), ["four"])
    file = made.work / "clip/default/four/out.txt"
    text = file.read_text()
    file.write_text("x")
    assert not keep.record(open_(), ["four"])
    file.write_text(text)
    assert keep.record(open_(), ["four"])
    made.video.write_text("other pixels")
    assert not keep.record(open_(), ["four"])


def test_what_the_page_links_and_other_pipelines_have_stays(made, open_):
    links = made.work / "clip/default"
    (links / PAGE).write_text(
        '<a href="two/out.txt">two</a><img src="data:image/png;base64,xx"><a href="../x.html">x</a>'
    )
    first = next(made.store.glob("one-*"))
    other = made.work / "clip/other"
    other.mkdir()
    (other / "one").symlink_to(first)
    session = open_()
    three = next(made.store.glob("three-*")).name
    result = keep.let_go(session, ["four"], RESULT | {"picture": f"{three}/out.txt"})
    assert result["pages"] == [PAGE] and stages_there(made) == {"one", "two", "three", "four"}
    assert (first / STAMP).exists()  # whole
    for name in ("two", "three"):
        assert (links / name / "out.txt").exists() and not (links / name / STAMP).exists()
    assert made.ran().keys() == {"two", "three"}


def test_who_is_killed_in_between_lets_the_rest_go_with_the_next_call(made, open_, monkeypatch):
    session = open_()
    with monkeypatch.context() as killed:
        killed.setattr(garbage, "garbage", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            keep.let_go(session, ["four"], RESULT)
    found = planned(session, "four")
    assert found.state == "todo" and not found.todo
    keep.let_go(session, ["four"], found.result)
    assert planned(session, "four").state == "fresh"
