"""Results are never written among the files of a source."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugs_cli.cache.freshness import Session, lies_in
from hugs_cli.cache.workspace import Workspace
from hugs_cli.pipelines import Pipeline, UsageError


@pytest.mark.parametrize(
    ("folder", "source", "inside"),
    [
        ("pictures/work/clip", "pictures", True),
        ("pictures", "pictures", True),
        ("way/work/clip", "pictures", True),  # through a link
        ("pictures/work/clip", "way", True),
        ("work/clip", ".", True),
        ("work/clip", "pictures", False),
        ("pictures2/work", "pictures", False),
        ("pictures/.work/clip", "pictures", False),  # hidden ones are no part of a source
    ],
)
def test_a_folder_that_would_be_among_the_files_of_a_source(tmp_path, folder, source, inside):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "way").symlink_to("pictures")
    assert lies_in(tmp_path / folder, tmp_path / source) == inside


def test_a_work_folder_inside_the_source_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    (tmp_path / "pictures").mkdir()
    monkeypatch.chdir(tmp_path / "pictures")
    session = Session(Workspace(Path("."), Path("work"), "default"), Pipeline("default", "", {}), {"video": None})
    session.check_sources()
    with pytest.raises(UsageError, match="source") as error:
        session.pipeline.stages["a"] = type("Stage", (), {"needs": ("video",)})()
        session.sources["video"] = Path(".")
        session.check_sources()
    assert error.value.hint.endswith(f"`--work {tmp_path / 'work'}`") and not Path("work").exists()
