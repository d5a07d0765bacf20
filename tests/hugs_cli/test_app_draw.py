"""The commands that draw: whose result they take."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugs_cli.app_draw import finished
from hugs_cli.pipelines import UsageError
from tests.made.flow import Flow
from tests.made.said import holds


@pytest.fixture
def two_films(flow: Flow, monkeypatch: pytest.MonkeyPatch) -> Flow:
    """`b/clip.mp4` was run after `clip.mp4`, into the same work folder."""
    monkeypatch.chdir(flow.folder)
    flow.hugs("two")
    (flow.folder / "b").mkdir()
    (flow.folder / "b/clip.mp4").write_text("others")
    return flow


def run_other(flow: Flow, *stages: str) -> None:
    """Run stages of `b/clip.mp4`."""
    flow.video.rename(flow.folder / "kept")
    (flow.folder / "b/clip.mp4").rename(flow.video)
    flow.hugs(*stages)
    flow.video.rename(flow.folder / "b/clip.mp4")
    (flow.folder / "kept").rename(flow.video)


@pytest.mark.slow
def test_the_result_of_another_film_of_the_same_name_is_not_taken(two_films):
    (folder,) = finished(Path("clip.mp4"), Path("work"), "default", "two")
    assert folder.resolve() == Path("work/clip/default/two").resolve()
    run_other(two_films, "two")
    with pytest.raises(UsageError) as caught:
        finished(Path("clip.mp4"), Path("work"), "default", "two")
    assert holds(caught.value.problem, "two", "not made from", "clip.mp4")
    assert caught.value.hint.startswith("`hugs run clip.mp4`") and "`--work`" in caught.value.hint
    assert caught.value.facts[0].startswith("digest of clip.mp4: ") and len(set(caught.value.facts)) == 2
    (folder,) = finished(Path("b/clip.mp4"), Path("work"), "default", "two")
    assert "others" in (folder / "out.txt").read_text()


def test_the_command_that_helps_can_be_pasted_whatever_the_names_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my dance.mp4").write_text("pixels")
    with pytest.raises(UsageError, match="no finished train") as caught:
        finished(Path("my dance.mp4"), Path("my work"), "draft", "train")
    assert caught.value.hint == "`hugs run 'my dance.mp4' --pipeline draft --work 'my work'`"


@pytest.mark.slow
def test_a_result_is_its_films_although_a_stage_before_it_was_run_on_another(two_films):
    run_other(two_films, "one")
    (folder,) = finished(Path("clip.mp4"), Path("work"), "default", "two")
    assert "pixels" in (folder / "out.txt").read_text()
    with pytest.raises(UsageError, match=r"\bone\b"):
        finished(Path("clip.mp4"), Path("work"), "default", "two", "one")


@pytest.mark.slow
def test_films_that_give_the_same_frames_share_the_result(two_films):
    two_films.edit("one", "[video])", "[])")
    two_films.hugs("two")
    run_other(two_films, "two")
    for film in ("clip.mp4", "b/clip.mp4"):
        assert finished(Path(film), Path("work"), "default", "two")


@pytest.mark.slow
def test_a_result_whose_film_cannot_be_told_is_not_taken(two_films):
    run_other(two_films, "one")
    two_films.hugs(command="gc")
    with pytest.raises(UsageError) as caught:
        finished(Path("clip.mp4"), Path("work"), "default", "two")
    assert holds(caught.value.facts[1], "unknown", "gone")


def test_a_film_that_is_gone_is_said(two_films):
    two_films.video.unlink()
    with pytest.raises(UsageError, match="no video at"):
        finished(Path("clip.mp4"), Path("work"), "default", "two")
